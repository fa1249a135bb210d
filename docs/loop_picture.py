"""`python docs/loop_picture.py` draws loop.png, the loop of a cell with signals, units and rates,
and processes.png, its processes and the messages between them.

Rates of messages are those of the table of channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


PROCESSES = {
    "clients": Box(0.0, 4.8, "any language, ROS 2", OUTSIDE),
    "trackers": Box(0.0, 2.7, "any; sim, play, hands", OUTSIDE),
    "driver": Box(0.0, 0.6, "moves the arm", OUTSIDE),
    "requests": Box(4.2, 4.8, "threads: check, reply", STAGE),
    "inbox": Box(8.1, 4.8, "orders, new skills", STAGE),
    "status": Box(12.0, 4.8, "a thread: 10 Hz, log", STAGE),
    "subscribers": Box(4.2, 2.7, "the newest samples", STAGE),
    "core": Box(8.1, 2.7, "decides a frame", STAGE),
    "publishers": Box(6.15, 0.6, "command, target, ...", STAGE),
    "skill worker": Box(16.2, 4.8, "process: adapts skills", OUTSIDE),
    "scribe": Box(16.2, 2.7, "process: records", OUTSIDE),
    "fork server": Box(16.2, 0.6, "process: starts both", OUTSIDE),
}
MESSAGES = (
    Arrow("clients", "requests", "JSON: via_points,\nhold, resume, ..."),
    Arrow("requests", "inbox", "checked"),
    Arrow("inbox", "core", "events of a tick", 0.75, 0.0),
    Arrow("trackers", "subscribers", "hands/left,\nhands/right"),
    Arrow("driver", "subscribers", "joints/state", 0.5, -0.35),
    Arrow("subscribers", "core", "samples"),
    Arrow("core", "publishers", "messages", 0.55, 0.0),
    Arrow("publishers", "driver", "joints/command"),
    Arrow("core", "status", "copies", 0.5, 0.0),
    Arrow("status", "skill worker", "searches"),
    Arrow("core", "scribe", "tick and frame, sent without waiting", -1.0),
    Arrow("fork server", "scribe", "", 0.0, 0.0),
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


def draw_arrow(axes: Axes, boxes: Mapping[str, Box], arrow: Arrow) -> None:
    """An arrow from edge to edge, and its text."""
    end = boxes[arrow.end]
    begin = boxes.get(arrow.begin, Box(CORE_RIGHT - WIDTH / 2, end.y, "", STAGE))
    start = edge(begin, end)
    stop = edge(end, begin)
    axes.annotate(
        "", stop, start, arrowprops={"arrowstyle": "-|>", "color": "0.2", "linewidth": 1.2}
    )
    middle = ((start[0] + stop[0]) / 2 + arrow.dx, (start[1] + stop[1]) / 2 + arrow.dy)
    axes.text(*middle, arrow.text, ha="center", va="center", fontsize=8.5, bbox=LABEL)


def draw(name: str, title: str, boxes: Mapping[str, Box], arrows: Sequence[Arrow]) -> None:
    """Write a picture: boxes and arrows, with a frame of this title around the middle columns."""
    figure = plt.figure(figsize=(13.6, 6.2))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    frame = FancyBboxPatch(
        (CORE_LEFT + 0.1, -0.25),
        CORE_RIGHT - CORE_LEFT - 0.2,
        5.9,
        boxstyle="round,pad=0.1",
        facecolor="none",
        edgecolor="#3a6ea5",
        linestyle="--",
    )
    axes.add_patch(frame)
    axes.text(8.1, 5.95, title, ha="center", fontsize=11, color="#3a6ea5")
    for label, box in boxes.items():
        draw_box(axes, label, box)
    for arrow in arrows:
        draw_arrow(axes, boxes, arrow)
    axes.set(xlim=(-1.3, 17.5), ylim=(-0.6, 6.95))
    axes.set_axis_off()
    figure.savefig(PICTURE.with_name(name), dpi=DPI)
    plt.close(figure)


def main() -> None:
    """Writes the pictures beside this file."""
    period_ms = 1000 / Settings().rate_hz
    draw(PICTURE.name, f"the core: one tick every {period_ms:g} ms", BOXES, ARROWS)
    draw("processes.png", "the control process", PROCESSES, MESSAGES)


if __name__ == "__main__":
    main()
