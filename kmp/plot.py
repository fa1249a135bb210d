"""Pictures of a primitive by Matplotlib: outputs over the input, or one output over another."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import Array, brief, check_kind, numbers, parts_of, whole
from kmp.gaussians import Gaussians

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.path import Path

_QUERIES = 200  # number of queries along the input, if none are given
_REGIONS = ((2, 0.18, "2 deviations"), (1, 0.35, "1 deviation"))  # multiple, opacity; back to front
_REFERENCE: dict[str, Any] = {
    "color": "0.55",
    "markersize": 3,
    "linestyle": "",
    "marker": ".",
    "zorder": 3,
}
_VIA_POINT: dict[str, Any] = {
    "color": "0.1",
    "markersize": 5,
    "linestyle": "",
    "marker": "o",
    "zorder": 5,
}
_CIRCLE = np.linspace(0, 2 * np.pi, 49)  # [rad] the points of an ellipse


class Points(NamedTuple):
    """Inputs (N, I), and a normal at each."""

    inputs: Array
    normals: Gaussians


class Shown(NamedTuple):
    """The points that are drawn with the predictions, and the kernel's channels and period."""

    references: Points
    via_points: Points
    channels: int
    period: float | None


class Plotted:
    """Primitives that can be drawn: `KMP` and `LocalKMP` inherit it."""

    @abstractmethod
    def predict(self, queries: ArrayLike) -> Gaussians:
        """M normals at queries (M, I)."""

    @abstractmethod
    def _to_plot(self) -> Shown:
        """The points that are drawn with the predictions."""

    def plot(
        self,
        queries: ArrayLike | None = None,
        *,
        plane: Sequence[int] | None = None,
        axes: Axes | Sequence[Axes] | NDArray[np.object_] | None = None,
        label: str = "mean",
        outputs: Sequence[str] | None = None,
        input_unit: str = "",
        output_unit: str = "",
    ) -> list[Axes]:
        """Draw the predictions at queries (M, I) with Matplotlib, the extra `plot`.

        The mean, the regions of 1 and 2 deviations, the references, and the via-points with 2
        deviations. Derivatives are left out. Over the input, one axes per output; with `plane`
        (i, j) output j over output i in one axes, where the regions are the ellipses of all
        queries. For a single input the queries default to the range of the references, or one
        period. For more inputs a path is required, and without `plane` the x axis is its index.

        The drawing uses `axes`, whose labels it keeps, or new axes of pyplot; it returns them.
        `label` is the mean's in the legend, `outputs` (O,) are the outputs' names, and the units
        follow the names.

        Raises ModuleNotFoundError without Matplotlib, and ValueError if the shape of the queries
        differs, a number is not finite, or the number of axes, names or outputs is wrong.
        """
        try:
            from matplotlib import pyplot as plt
            from matplotlib.axes import Axes
        except ModuleNotFoundError as error:
            message = "plot draws with Matplotlib, which is not installed: pip install matplotlib"
            raise ModuleNotFoundError(message, name=error.name) from None
        for name, text in (
            ("label", label),
            ("input_unit", input_unit),
            ("output_unit", output_unit),
        ):
            check_kind(name, text, str, "a text")
        plot_data = self._to_plot()
        s = (
            _along(plot_data)
            if queries is None
            else numbers("queries", queries, "M", plot_data.references.inputs.shape[1])
        )
        titles = _titles(outputs, plot_data, input_unit, output_unit)
        chosen = (
            None
            if plane is None
            else [whole("plane", i, least=0, most=len(titles) - 1) for i in _two(plane)]
        )
        axes_count = len(titles) if chosen is None else 1
        if axes is None:
            size = (6.4, 1.0 + 1.9 * axes_count) if chosen is None else (6.4, 5.0)
            axes = plt.subplots(
                axes_count, 1, sharex=True, squeeze=False, figsize=size, layout="constrained"
            )[1]
        into: list[Any] = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(into) != axes_count:
            raise ValueError(f"axes: {len(into)} given, {axes_count} needed.")
        for i, ax in enumerate(into):
            check_kind(f"axes[{i}]", ax, Axes, "pyplot.subplots makes them")
        prediction = self.predict(s)
        if chosen is None:
            for i, ax in enumerate(into):
                _draw_over_input(ax, s, prediction, plot_data, i, label)
                ax.set_ylabel(ax.get_ylabel() or titles[i])
            title = _named("input", input_unit) if s.shape[1] == 1 else "query"
            into[-1].set_xlabel(into[-1].get_xlabel() or title)
        else:
            _draw_plane(into[0], prediction, plot_data, chosen, label)
            into[0].set_xlabel(into[0].get_xlabel() or titles[chosen[0]])
            into[0].set_ylabel(into[0].get_ylabel() or titles[chosen[1]])
        _add_legend(into[0])
        return into


def _two(plane: Sequence[int]) -> list[int]:
    if len(indices := parts_of("plane", plane)) != 2:
        raise ValueError(f"plane: {brief(indices)} given, the numbers of two outputs needed.")
    return indices


def _along(shown: Shown) -> Array:
    inputs = shown.references.inputs
    if inputs.shape[1] != 1:
        raise ValueError(f"queries: none given, a path (M, {inputs.shape[1]}) needed.")
    low, high = (inputs.min(), inputs.max()) if shown.period is None else (0.0, shown.period)
    return np.linspace(low, high, _QUERIES)[:, None]


def _named(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _titles(outputs: Sequence[str] | None, shown: Shown, input_unit: str, unit: str) -> list[str]:
    """The label of each output's axis; outputs of the second channel are rates."""
    count = shown.references.normals.outputs
    values = count // shown.channels
    names = [f"output {i}" if i < values else f"rate of output {i - values}" for i in range(count)]
    if outputs is not None:
        names = parts_of("outputs", outputs, str, "a name")
    if len(names) != count:
        raise ValueError(f"outputs: {len(names)} names given, {count} needed.")
    rate = f"{unit}/{input_unit}" if unit and input_unit else ""
    return [_named(name, unit if i < values else rate) for i, name in enumerate(names)]


def _draw_over_input(
    axes: Axes, s: Array, found: Gaussians, shown: Shown, i: int, label: str
) -> None:
    alone = s.shape[1] == 1
    x = s[:, 0] if alone else np.arange(len(s))
    mean = found.mean[:, i]
    deviation = np.sqrt(found.covariance[:, i, i])
    [line] = axes.plot(x, mean, label=label, zorder=4)
    for times, style in _regions(line):
        axes.fill_between(x, mean - times * deviation, mean + times * deviation, **style)
    if alone:  # with more inputs, no axis shows their position
        references = shown.references
        via = shown.via_points
        axes.plot(
            references.inputs[:, 0], references.normals.mean[:, i], label="reference", **_REFERENCE
        )
        if len(via.normals):
            error_bar = 2 * np.sqrt(via.normals.covariance[:, i, i])
            axes.errorbar(
                via.inputs[:, 0],
                via.normals.mean[:, i],
                error_bar,
                label="via-point",
                capsize=3,
                **_VIA_POINT,
            )


def _regions(line: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    """The deviations of each region around a mean's line, and its style."""
    for times, opacity, label in _REGIONS:
        style = {"color": line.get_color(), "alpha": opacity, "linewidth": 0, "zorder": 2}
        yield times, style | {"label": label}


def _draw_plane(axes: Axes, found: Gaussians, shown: Shown, plane: list[int], label: str) -> None:
    from matplotlib.patches import PathPatch

    [line] = axes.plot(*found.mean[:, plane].T, label=label, zorder=4)
    for times, style in _regions(line):
        axes.add_patch(PathPatch(_ellipses(found, plane, times), **style))
    via = shown.via_points.normals
    axes.plot(*shown.references.normals.mean[:, plane].T, label="reference", **_REFERENCE)
    if len(via):
        axes.plot(*via.mean[:, plane].T, label="via-point", **_VIA_POINT)
        axes.add_patch(
            PathPatch(_ellipses(via, plane, 2), fill=False, edgecolor=_VIA_POINT["color"], zorder=5)
        )
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")


def _ellipses(normals: Gaussians, plane: list[int], times: int) -> Path:
    """All ellipses as one path, so that overlaps are not more opaque."""
    from matplotlib.path import Path

    values, vectors = np.linalg.eigh(normals.covariance[:, plane][:, :, plane])
    # All ellipses have the same sense of rotation.
    vectors = vectors * np.sign(np.linalg.det(vectors))[:, None, None] ** np.array([1, 0])
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    around = normals.mean[:, None, plane] + times * (
        np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], 1) @ root.mT
    )
    return Path.make_compound_path(*(Path(ellipse, closed=True) for ellipse in around))


def _add_legend(axes: Axes) -> None:
    """Add the legend above the axes; a label that occurs twice is shown once."""
    handles, labels = axes.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))
    axes.legend(
        list(named.values()),
        list(named),
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=4,
        frameon=False,
        fontsize="small",
        columnspacing=1.2,
        handlelength=1.4,
    )
