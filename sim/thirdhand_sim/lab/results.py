"""Results of an experiment: PNG figures, one JSON of its numbers, a Rerun recording, and progress
on standard error.
"""

from __future__ import annotations

import io
import json
import logging
import math
import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from thirdhand.contract.explain import ExplainedError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

# Okabe and Ito's colours, which people with colour vision deficiencies distinguish. As in the
# paper, the left hand is red, the right one blue, and the robot green.
LEFT_COLOUR = "#D55E00"
RIGHT_COLOUR = "#0072B2"
TOOL_COLOUR = "#009E73"
ADAPTED = "#D55E00"
OTHER = "#0072B2"
DESIRED = "#CC79A7"
REFERENCE = "#7F7F7F"
DPI = 110
COLOURS = 256
ROW = re.compile(r"\[\s+([-+.\de,\s]+?)\s+\]")  # a list of numbers in JSON, put into one line


class ExperimentError(ExplainedError):
    """An experiment cannot be made; the message has the remedy."""


@dataclass(frozen=True)
class Options:
    """Options of the command line."""

    letters: Path | None = None  # a folder of recorded letters, for experiments on letters
    # a folder of recorded hands, for `motion`, and for `people` to choose parameters
    hands: Path | None = None
    data: Path | None = None  # a folder of recorded takes of hands and a third hand, for `partners`
    group: Literal["tuning", "test"] = "test"  # the people of `people`
    workers: str = "1"  # see `thirdhand.process.parallel.spread`
    share: float = 1.0  # share of the full size; less for a quick look
    seed_offset: int = 0  # added to the numbers of evaluation, to repeat it with other seeds
    arm: str = "wam"  # for `faults` and `motion`: a shipped cell, or a file of settings


@dataclass
class Results:
    """One experiment's results in `folder`: files are named after the experiment."""

    folder: Path
    name: str
    said: bool = True
    # commit, date, machine, seeds, options, digests
    origin: dict[str, Any] = field(default_factory=dict)
    figures: list[str] = field(default_factory=list)
    began_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)

    def say(self, line: str) -> None:
        """Print a line of progress."""
        if self.said:
            print(
                f"[{self.name} {time.monotonic() - self.began_s:5.1f} s] {line}",
                file=sys.stderr,
                flush=True,
            )

    def figure(self, figure: Figure, suffix: str = "") -> Path:
        """The path of a figure, saved as PNG."""
        path = self.folder / f"{self.name}{suffix and '-' + suffix}.png"
        from PIL import Image

        whole = io.BytesIO()
        figure.savefig(whole, dpi=DPI, bbox_inches="tight")
        picture = Image.open(whole).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        picture.save(path, optimize=True)  # a third of the size
        figure.clear()
        self.figures.append(path.name)
        self.say(f"{path}")
        return path

    def numbers(self, numbers: dict[str, Any]) -> Path:
        """The path of the JSON file of the numbers, their origin, and the figures' names."""
        path = self.folder / f"{self.name}.json"
        whole = {
            "experiment": self.name,
            **self.origin,
            "figures": self.figures,
            "seconds": round(time.monotonic() - self.began_s, 1),
            **numbers,
        }
        text = json.dumps(_plain(whole), indent=2)
        text = ROW.sub(lambda row: f"[{' '.join(row[1].split())}]", text)
        new_path = path.with_suffix(".new")
        new_path.write_text(text + "\n", encoding="utf-8")
        new_path.replace(path)
        self.say(f"{path}")
        return path

    def measured(self) -> dict[str, Any]:
        """The numbers in the experiment's JSON of an earlier run."""
        numbers: dict[str, Any] = json.loads(
            (self.folder / f"{self.name}.json").read_text(encoding="utf-8")
        )
        return numbers

    def series(
        self, values: Mapping[str, Sequence[Any]], timeline: str, styles: Mapping[str, Any] = {}
    ) -> None:
        """Record numbers by path, one for each step of a timeline; a path may have a style of its
        own.
        """
        stream = self.recording()
        for path, numbers in values.items():
            if path in styles:
                stream.log(path, styles[path], static=True)
            steps = [rr.TimeColumn(timeline, sequence=np.arange(len(numbers)))]
            stream.send_columns(path, steps, rr.Scalars.columns(scalars=np.array(numbers)))
        stream.disconnect()

    def recording(self) -> rr.RecordingStream:
        """A Rerun stream into the experiment's .rrd file; `disconnect` ends it."""
        stream = rr.RecordingStream(f"thirdhand-{self.name}")
        stream.save(self.folder / f"{self.name}.rrd")
        return stream


def pyplot() -> Any:
    """Matplotlib's pyplot that draws into files. Raises ExperimentError."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise ExperimentError(
            "the experiments draw with Matplotlib, which is not installed: pip install "
            "'thirdhand[experiments]'"
        ) from None
    mpl.use("Agg")
    # Matplotlib warns of limits that equal scales change
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    from matplotlib import pyplot as plt

    plt.rcParams.update(
        {
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "figure.constrained_layout.use": True,
        }
    )
    return plt


def brief(value: Any) -> str:
    """Numbers in one line of progress, by name, with three significant digits."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {brief(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return f"({' '.join(map(brief, value))})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green, blue (0 to 255) of #RRGGBB."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def equal_box(axes: Any, points: Array) -> None:
    """Set equal scales of 3-D axes around points (N, 3)."""
    low = points.min(axis=0)
    high = points.max(axis=0)
    half = 0.55 * (high - low).clip(min=1e-3)
    middle = (low + high) / 2
    axes.set(
        **{f"{name}lim": (middle[i] - half[i], middle[i] + half[i]) for i, name in enumerate("xyz")}
    )
    axes.set_box_aspect(half, zoom=1.1)


def legend_below(figure: Figure, handles: Sequence[Any], *, columns: int) -> None:
    """Add a legend of labelled artists below all panels of a figure."""
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=8,
    )


def ellipse(axes: Axes, mean: Array, covariance: Array, **style: Any) -> None:
    """Draw the ellipse of one standard deviation of a 2-D normal (2,), (2, 2)."""
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(values)
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    axes.add_patch(Ellipse((mean[0], mean[1]), width, height, angle=angle, **style))


def _plain(value: Any) -> Any:
    """JSON's own types, numbers with five significant digits; infinite ones and NaN as text."""
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.5g}") if math.isfinite(value) else str(value)
    return value
