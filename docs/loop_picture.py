"""`python docs/loop_picture.py` draws loop.png: the loop of a cell with signals, units and rates.

Rates of messages are those of the table of channels.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl

mpl.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from thirdhand.contract.channels import BY_KEY
from thirdhand.settings.config import Settings

PICTURE = Path(__file__).with_name("loop.png")
# of a box
WIDTH = 1.9
HEIGHT = 0.8
CORE = "core"
CORE_LEFT = 2.65
CORE_RIGHT = 13.55
STAGE = "#d6e6f4"
OUTSIDE = "#eeeeee"
DPI = 90
LABEL = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}


class Box(NamedTuple):
    """A program or a stage: its centre, and the text below its name."""

    x: float
    y: float
    about: str
    colour: str


class Arrow(NamedTuple):
    """A signal between two boxes, or from the core, and the offset of its text from its middle."""

    begin: str
    end: str
    text: str
    dx: float = 0.0
    dy: float = 0.28


BOXES = {
    "client": Box(0.0, 6.3, "requests", OUTSIDE),
    "tracker": Box(0.0, 4.8, "measures the hands", OUTSIDE),
    "driver": Box(0.0, 0.6, "moves the arm", OUTSIDE),
    "scribe": Box(16.2, 0.6, "records and draws", OUTSIDE),
    "viewers": Box(16.2, 4.8, "show the cell", OUTSIDE),
    "intake": Box(4.2, 4.8, "estimates hands, arm", STAGE),
    "skill": Box(8.1, 4.8, "predicts the tool", STAGE),
    "decision": Box(12.0, 4.8, "follow, hold, fault", STAGE),
    "separation": Box(4.2, 2.7, "limits near people", STAGE),
    "setpoint": Box(12.0, 0.6, "can always stop", STAGE),
    "arm": Box(8.1, 0.6, "inverse kinematics", STAGE),
    "limiter": Box(4.2, 0.6, "keeps joint limits", STAGE),
}
ARROWS = (
    Arrow("tracker", "intake", f"poses [m]\n{BY_KEY['hands/left'].rate}"),
    Arrow("driver", "intake", f"joints [rad, rad/s]\n{BY_KEY['joints/state'].rate}", -0.95, 0.25),
    Arrow("client", "intake", "JSON, to the stage\nthat it concerns", 0.0, 0.0),
    Arrow("intake", "skill", "hands: p, v, a\n[m, m/s, m/s²]"),
    Arrow("skill", "decision", "deviation [m]"),
    Arrow("skill", "setpoint", "target: p, v, a\n[m, m/s, m/s²]", -1.1, 0.0),
    Arrow("decision", "setpoint", "mode, reason\n(to the limiter\ntoo)", 0.75, 0.0),
    Arrow("intake", "separation", "hands", 0.42, 0.0),
    Arrow("separation", "arm", "rows: row · q' ≤ limit [m/s]", 0.95, 0.45),
    Arrow("separation", "limiter", "", 0.0, 0.0),
    Arrow("setpoint", "arm", "setpoint: p, v, a\n[m, m/s, m/s²]"),
    Arrow("arm", "limiter", "q', q''\n[rad/s, rad/s²]"),
    Arrow(
        "limiter",
        "driver",
        f"command q, q'\n[rad, rad/s]\n{BY_KEY['joints/command'].rate}",
        0.0,
        -0.5,
    ),
    Arrow(CORE, "scribe", "frame\nevery tick"),
    Arrow(CORE, "viewers", f"status [JSON]\n{BY_KEY['status'].rate.split(',')[0]}", 0.1),
)


def draw_box(axes: Axes, name: str, box: Box) -> None:
    """A box with its name and what it does."""
    corner = (box.x - WIDTH / 2, box.y - HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(
            corner, WIDTH, HEIGHT, boxstyle="round,pad=0.08", facecolor=box.colour, edgecolor="0.3"
        )
    )
    axes.text(box.x, box.y + 0.14, name, ha="center", va="center", fontsize=11, weight="bold")
    axes.text(box.x, box.y - 0.2, box.about, ha="center", va="center", fontsize=8.5)


def edge(begin: Box, end: Box) -> tuple[float, float]:
    """The point where the line to another box leaves this one."""
    dx = end.x - begin.x
    dy = end.y - begin.y
    share = min(
        (WIDTH / 2 + 0.12) / abs(dx) if dx else float("inf"),
        (HEIGHT / 2 + 0.12) / abs(dy) if dy else float("inf"),
    )
    return begin.x + share * dx, begin.y + share * dy


def draw_arrow(axes: Axes, arrow: Arrow) -> None:
    """An arrow from edge to edge, and its text."""
    end = BOXES[arrow.end]
    begin = BOXES.get(arrow.begin, Box(CORE_RIGHT - WIDTH / 2, end.y, "", STAGE))
    start = edge(begin, end)
    stop = edge(end, begin)
    axes.annotate(
        "", stop, start, arrowprops={"arrowstyle": "-|>", "color": "0.2", "linewidth": 1.2}
    )
    middle = ((start[0] + stop[0]) / 2 + arrow.dx, (start[1] + stop[1]) / 2 + arrow.dy)
    axes.text(*middle, arrow.text, ha="center", va="center", fontsize=8.5, bbox=LABEL)


def main() -> None:
    """Writes the picture beside this file."""
    figure = plt.figure(figsize=(13.6, 6.2))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    core = FancyBboxPatch(
        (CORE_LEFT + 0.1, -0.25),
        CORE_RIGHT - CORE_LEFT - 0.2,
        5.9,
        boxstyle="round,pad=0.1",
        facecolor="none",
        edgecolor="#3a6ea5",
        linestyle="--",
    )
    axes.add_patch(core)
    rate_hz = Settings().rate_hz
    axes.text(
        8.1,
        5.95,
        f"the core: one tick every {1000 / rate_hz:g} ms",
        ha="center",
        fontsize=11,
        color="#3a6ea5",
    )
    for name, box in BOXES.items():
        draw_box(axes, name, box)
    for arrow in ARROWS:
        draw_arrow(axes, arrow)
    axes.set(xlim=(-1.3, 17.5), ylim=(-0.6, 6.95))
    axes.set_axis_off()
    figure.savefig(PICTURE, dpi=DPI)


if __name__ == "__main__":
    main()
