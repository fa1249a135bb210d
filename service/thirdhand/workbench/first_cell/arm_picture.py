"""A picture of an arm's first cell: the arm from the side and from above, its reach, and the tool
positions of the demo.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle, Wedge
from scipy.spatial import ConvexHull

from thirdhand.core.frame import Vector
from thirdhand.core.geometry import place
from thirdhand.settings import palette
from thirdhand.workbench.first_cell.first_cell import DEMO_TOOL_M, Proposal

VIEWS = (("from the side", 0, 2, "x [m]", "z [m]"), ("from above", 1, 0, "y [m]", "x [m]"))
CIRCLE = np.linspace(0.0, 2.0 * math.pi, 40)
AROUND_M = 0.15  # margin around the drawing


def draw(proposal: Proposal, path: Path) -> None:
    """Write the picture to a .png file."""
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    settings = proposal.settings
    body = proposal.body
    placed = np.empty((len(body.capsules), 2, 3))
    place(np.array(settings.arm.posture), body.frames, body.axes, body.capsules, placed)
    for number, (title, across, up, label, other) in enumerate(VIEWS):
        axes = figure.add_subplot(1, 2, number + 1)
        _reach(axes, proposal, across, up)
        _table(axes, proposal, across, up)
        order = np.argsort(placed.mean(axis=1)[:, 3 - across - up])
        for i in order:
            outline = _outline(placed[i][:, [across, up]], float(body.capsules["radius"][i]))
            is_tool = body.capsules["link"][i] == len(settings.joints.names)
            colour = palette.TOOL if is_tool else palette.GREY
            axes.add_patch(
                Polygon(
                    outline, facecolor=_rgb(colour), edgecolor="black", linewidth=0.6, alpha=0.8
                )
            )
        for name, point_m in DEMO_TOOL_M.items():
            colour = palette.VERMILLION if name in proposal.unmet else palette.BLUE
            axes.plot(point_m[across], point_m[up], "o", color=_rgb(colour), markersize=7, zorder=5)
            axes.annotate(
                name,
                (point_m[across], point_m[up]),
                (6, 5),
                textcoords="offset points",
                fontsize=9,
                zorder=6,
            )
        axes.plot(0.0, 0.0, "k+", markersize=12, zorder=5)
        axes.annotate(
            "frame base", (0.0, 0.0), (6, -12), textcoords="offset points", fontsize=9, zorder=6
        )
        axes.set(title=title, xlabel=label, ylabel=other, aspect="equal")
        points_m = np.vstack(
            (
                placed[:, :, [across, up]].reshape(-1, 2),
                [(point_m[across], point_m[up]) for point_m in DEMO_TOOL_M.values()],
            )
        )
        low = points_m.min(axis=0) - AROUND_M
        high = points_m.max(axis=0) + AROUND_M
        centre = proposal.shell.centre
        outer = proposal.shell.outer
        sideways = centre[across] - outer if across == 1 else -AROUND_M
        axes.set_xlim(min(low[0], sideways), max(high[0], centre[across] + outer))
        axes.set_ylim(min(low[1], -AROUND_M), max(high[1], centre[up] + outer))
        if across == 1:
            axes.invert_xaxis()  # y to the left, as seen by the arm
    figure.suptitle(
        f"{Path(settings.arm.urdf).name}: posture and reach, {proposal.shell.inner:.2f} to "
        f"{proposal.shell.outer:.2f} m. Green: links behind the last joint; red: positions of the "
        "demo out of reach"
    )
    figure.savefig(path, dpi=110)


def _reach(axes: Axes, proposal: Proposal, across: int, up: int) -> None:
    """The shell around the shoulder, cut by min_x and min_z."""
    shell = proposal.shell
    reach = proposal.settings.reach
    centre_m = (shell.centre[across], shell.centre[up])
    colour = _rgb(palette.SKY)
    ring = Wedge(
        centre_m, shell.outer, 0, 360, width=shell.outer - shell.inner, facecolor=colour, alpha=0.25
    )
    axes.add_patch(ring)
    lowest = {0: reach.min_x, 2: reach.min_z}
    size = 2.0 * shell.outer
    corner = [centre_m[0] - size, centre_m[1] - size]
    end = [centre_m[0] + size, centre_m[1] + size]
    for i, axis in enumerate((across, up)):
        if axis in lowest:
            corner[i] = max(corner[i], lowest[axis])
    ring.set_clip_path(
        Rectangle(
            (corner[0], corner[1]), end[0] - corner[0], end[1] - corner[1], transform=axes.transData
        )
    )


def _table(axes: Axes, proposal: Proposal, across: int, up: int) -> None:
    table = proposal.settings.table
    half = (*table.half_size, 0.0)
    low = [table.centre[i] - half[i] for i in (across, up)]
    size = [2.0 * half[i] for i in (across, up)]
    if up == 2:
        low[1] = table.centre[2] - 0.03
        size[1] = 0.03
    axes.add_patch(
        Rectangle(
            (low[0], low[1]), size[0], size[1], facecolor="none", edgecolor="sienna", hatch="//"
        )
    )
    axes.annotate(
        "table", (low[0] + size[0], low[1]), (-34, 6), textcoords="offset points", fontsize=9
    )


def _outline(ends: Vector, radius: float) -> Vector:
    """The outline (N, 2) of a capsule between ends (2, 2)."""
    circle = radius * np.column_stack((np.cos(CIRCLE), np.sin(CIRCLE)))
    points = np.vstack((ends[0] + circle, ends[1] + circle))
    return points[ConvexHull(points).vertices]


def _rgb(colour: palette.Colour) -> tuple[float, float, float]:
    red, green, blue = (value / 255.0 for value in colour)
    return red, green, blue
