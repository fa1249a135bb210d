"""Picture of a skill's evidence: errors of held-out demonstrations and their predicted deviations,
regions, the gate, and the segments of one demonstration.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.core.skill.model import LEVELS
from thirdhand.settings import palette
from thirdhand.workbench.learning.gate import every_few, nonsense
from thirdhand.workbench.learning.records import Evidence, HeldOut

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TOOL_INK, TARGET_INK, OFF_INK, GATE_INK = map(
    palette.written, (palette.TOOL, palette.TARGET, palette.OFF, palette.GATE)
)
GREYS = {"wrong: swapped": "0.7", "wrong: both beside": "0.5", "wrong: one beside": "0.3"}
BANDS = [
    palette.written(colour)
    for colour in (palette.SKY, palette.ORANGE, palette.YELLOW, palette.GREY)
]
MOST_NAMED = 12  # segments in the legend
LEAST_BAND = 0.02  # a segment's band has its number if it lasts for this share of the time


def draw(evidence: Evidence, path: Path) -> None:
    """Write the picture as a PNG file. Raises OSError if the file cannot be written."""
    import matplotlib as mpl  # loads slowly, and few need it

    with mpl.rc_context({"text.parse_math": False}):  # names may contain dollar signs
        drawn(evidence).savefig(path, format="png")


def drawn(evidence: Evidence) -> Figure:
    """The picture; for a segmented skill with the segments of one demonstration."""
    from matplotlib.figure import Figure  # loads slowly, and few need it

    held_out = evidence.held_out
    is_segmented = held_out[0].belief is not None
    mosaic = "ae;rg;ss" if is_segmented else "ae;rg"
    figure = Figure(figsize=(11, 3.75 * len(mosaic.split(";"))), layout="constrained", dpi=110)
    parts = figure.subplot_mosaic(mosaic)
    if is_segmented:
        _draw_segments(evidence, parts["s"])
    _draw_from_above(held_out, parts["a"])
    _draw_errors(held_out, parts["e"])
    _draw_regions(evidence, parts["r"])
    _draw_gate(evidence, parts["g"])

    overall = evidence.figures.all
    count = len(held_out)
    basis = (
        f"{count} demonstrations, each predicted from the others with an error of "
        f"{overall.error_mm:.0f} mm rms"
        if count > 1
        else f"one demonstration, none held out: error of {overall.error_mm:.0f} mm rms in what "
        "was learned"
    )
    figure.suptitle(
        f"{evidence.skill.name}: {basis}, {overall.predicted_mm:.0f} mm expected as calibrated"
    )
    return figure


def _draw_from_above(held_out: Sequence[HeldOut], axes: Axes) -> None:
    """Draw the tool's demonstrated and predicted paths."""
    axes.set(title="the tool from above", xlabel="x [m]", ylabel="y [m]")
    for i, result in enumerate(held_out):
        tool = result.take.position
        predicted = tool - result.errors
        for path, colour, label in (
            (tool, TOOL_INK, "demonstrated"),
            (predicted, TARGET_INK, "predicted from the others"),
        ):
            axes.plot(path[:, 0], path[:, 1], color=colour, lw=1, label=None if i else label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False)


def _draw_errors(held_out: Sequence[HeldOut], axes: Axes) -> None:
    """Draw the errors over the share of the time, and those that were expected."""
    grid = np.linspace(0.0, 1.0, 200)
    lengths = np.array([_along(np.linalg.norm(result.errors, axis=1), grid) for result in held_out])
    expected = np.array([_along(_deviation(result), grid) for result in held_out])
    axes.plot(grid, 1000 * lengths.T, color="0.6", lw=0.8)
    axes.plot([], [], color="0.6", lw=0.8, label="each demonstration, held out")
    axes.plot(
        grid,
        1000 * np.sqrt((lengths**2).mean(axis=0)),
        color=TOOL_INK,
        lw=2,
        label="root mean square of all",
    )
    expected_mm = 1000 * np.sqrt((expected**2).mean(axis=0))
    axes.plot(
        grid, expected_mm, color=TARGET_INK, ls="--", lw=2, label="expected before calibration"
    )
    axes.set(
        title="error of the predicted tool",
        xlabel="share of the demonstration's time",
        ylabel="[mm]",
    )
    axes.set(xlim=(0, 1), ylim=(0, None))
    axes.legend(frameon=False)


def _draw_regions(evidence: Evidence, axes: Axes) -> None:
    """Draw the share of the samples inside each region over the one that it should contain."""
    axes.plot((0, 100), (0, 100), color="0.6", lw=1, label="exact")
    inside = 100 * evidence.inside
    axes.plot(
        100 * np.array(LEVELS),
        inside,
        "o-",
        color=TARGET_INK,
        ms=4,
        label="held-out demonstrations",
    )
    axes.set(title="share of the samples inside each predicted region")
    axes.set(xlabel="the region should contain [%]", ylabel="samples inside [%]")
    axes.set(xlim=(0, 100), ylim=(0, 100))
    axes.legend(frameon=False)


def _draw_gate(evidence: Evidence, axes: Axes) -> None:
    """Draw the distances of held-out hands and of wrong ones as distributions, and the gate."""
    from matplotlib.ticker import LogFormatter

    skill = evidence.skill
    held_out = evidence.held_out
    hands = np.concatenate([every_few(result.take.hands) for result in held_out])
    curves = {"held-out hands": (np.concatenate([result.gate_m for result in held_out]), OFF_INK)}
    for (name, colour), wrong in zip(GREYS.items(), nonsense(hands), strict=True):
        curves[name] = skill.model.gates_m(wrong), colour
    for name, (values, colour) in curves.items():
        axes.plot(
            1000 * np.sort(values), 100 * np.linspace(0, 1, len(values)), color=colour, label=name
        )
    axes.axvline(
        1000 * skill.threshold,
        color=GATE_INK,
        ls="--",
        lw=1,
        label=f"gate, {1000 * skill.threshold:.0f} mm",
    )
    axes.set(title="the arm holds right of the gate", ylabel="samples up to this distance [%]")
    axes.set(xlabel=f"{skill.model.measure} [mm]", xscale="log", ylim=(0, 100))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _draw_segments(evidence: Evidence, axes: Axes) -> None:
    """Draw the held-out demonstration with the median error over time: its most probable segments
    as bands, and the tool's error.
    """
    names = evidence.skill.model.names
    rows = evidence.figures.demonstrations
    h = int(np.argsort([row.error_mm for row in rows])[len(rows) // 2])
    result = evidence.held_out[h]
    assert result.belief is not None
    most = result.belief.argmax(axis=1)
    times = result.take.demonstration.period_s * np.arange(len(most))
    changes = np.flatnonzero(np.diff(most)) + 1
    labelled: set[int] = set()
    for first, end in zip([0, *changes], [*changes, len(most)], strict=True):
        k = int(most[first])
        until = float(times[min(end, len(times) - 1)])
        colour = BANDS[k % len(BANDS)]
        label = (
            None
            if k in labelled or k >= MOST_NAMED
            else f"{k + 1}: {names[k]} \N{RIGHTWARDS ARROW} {names[k + 1]}"
        )
        axes.axvspan(float(times[first]), until, color=colour, alpha=0.3, lw=0, label=label)
        if until - times[first] > LEAST_BAND * times[-1]:
            middle = 0.5 * (float(times[first]) + until)
            axes.text(
                middle,
                0.97,
                str(k + 1),
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="top",
            )
        labelled.add(k)
    off_mm = 1000 * np.linalg.norm(result.errors, axis=1)
    predicted_mm = 1000 * _deviation(result)
    axes.plot(times, off_mm, color=TOOL_INK, lw=2, label="error of the predicted tool")
    axes.plot(
        times, predicted_mm, color=TARGET_INK, ls="--", lw=1.5, label="expected before calibration"
    )
    # the first predictions are uncertain
    highest_mm = max(float(off_mm.max()), float(np.percentile(predicted_mm, 98)))
    axes.set(
        title=f"{rows[h].name}, held out: its most probable segment, and the error",
        xlabel="[s]",
        ylabel="[mm]",
    )
    axes.set(xlim=(0, times[-1]), ylim=(0, 1.15 * highest_mm))
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=4)


def _deviation(one: HeldOut) -> Vector:
    """The predicted distances (T,) [m] between tool and target, root mean square."""
    return np.asarray(np.sqrt(np.trace(one.covariance, axis1=1, axis2=2)))


def _along(values: Vector, grid: Vector) -> Vector:
    """Values (T,) that are even in time, interpolated at shares of the time (M,)."""
    return np.interp(grid, np.linspace(0.0, 1.0, len(values)), values)
