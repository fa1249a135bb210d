"""`python docs/frames_picture.py` draws frames.png: every coordinate frame of a cell, with the
shipped arm in its posture, a camera as the tracker, and a tool of 15 cm.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl

mpl.use("Agg")

import msgspec
import numpy as np
from matplotlib import pyplot as plt
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.geometry import place, rotation
from thirdhand.core.separation.body import body_of
from thirdhand.settings import palette
from thirdhand.settings.config import Settings, robot_description

PICTURE = Path(__file__).with_name("frames.png")
TRACKER = (1.2, 0.0, 0.9, 0.683, 0.683, -0.183, -0.183)  # `base_from_tracker` of first-tracker.md
PLATE_FROM_TOOL = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 1.0)
# [m] the person faces the arm
HANDS = {
    "left hand": (0.78, -0.22, 0.10),
    "right hand": (0.78, 0.22, 0.10),
}
AXIS_M = 0.13
ELBOW_M = 0.18
COLOURS = ("tab:red", "tab:green", "tab:blue")  # x, y, z
DPI = 90
LABEL = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}

Vector = NDArray[np.float64]


class CoordinateFrame(NamedTuple):
    """A frame at an origin (3,) [m], with its axes as columns (3, 3)."""

    name: str
    origin: Vector
    axes: Vector
    label_m: tuple[float, float, float] = (0.0, 0.0, 0.03)  # offset of the label


def frame_of(
    name: str, pose: tuple[float, ...], label_m: tuple[float, float, float]
) -> CoordinateFrame:
    """The frame of a pose in frame `base`."""
    return CoordinateFrame(
        name, np.array(pose[:3]), rotation((pose[3], pose[4], pose[5], pose[6])), label_m
    )


def with_tool(settings: Settings, plate_from_tool: tuple[float, ...]) -> Settings:
    """The settings with another tool."""
    return msgspec.structs.replace(
        settings, tool=msgspec.structs.replace(settings.tool, plate_from_tool=plate_from_tool)
    )


def tool_frame(
    name: str, settings: Settings, label_m: tuple[float, float, float]
) -> CoordinateFrame:
    """The frame of the tool in the posture of the settings."""
    here = ArmStage(settings, robot_description(settings)).at(np.array(settings.arm.posture))
    return CoordinateFrame(
        name, np.array(here.position), np.array(here.record["rotation"][0]), label_m
    )


def draw_frame(axes: Axes3D, frame: CoordinateFrame) -> None:
    """Three arrows, and the name."""
    for i, colour in enumerate(COLOURS):
        axes.quiver(
            *frame.origin,
            *(AXIS_M * frame.axes[:, i]),
            color=colour,
            linewidth=2.2,
            arrow_length_ratio=0.25,
        )
        axes.text(
            *(frame.origin + 1.2 * AXIS_M * frame.axes[:, i]), "xyz"[i], color=colour, fontsize=9
        )
    axes.text(*(frame.origin + frame.label_m), frame.name, fontsize=11, weight="bold", zorder=20)


def draw_arm(axes: Axes3D, settings: Settings) -> None:
    """The capsules of the arm's links as thick lines, joined in the order of the chain."""
    body = body_of(settings, robot_description(settings))
    placed = np.empty((len(body.capsules), 2, 3))
    place(np.array(settings.arm.posture), body.frames, body.axes, body.capsules, placed)
    axes.plot(
        *np.vstack([np.zeros((1, 3)), placed.reshape(-1, 3)]).T,
        color="0.62",
        linewidth=4,
        alpha=0.5,
        zorder=1,
    )
    for ends, radius in zip(placed, body.capsules["radius"], strict=True):
        axes.plot(
            *ends.T,
            color="0.62",
            linewidth=300 * radius,
            solid_capstyle="round",
            alpha=0.45,
            zorder=1,
        )


def draw_hand(axes: Axes3D, name: str, at: tuple[float, ...], colour: palette.Colour) -> None:
    """A tracked point, with the capsule toward the elbow that separation assumes."""
    rgb = tuple(value / 255 for value in colour)
    elbow = np.add(at, (ELBOW_M, 0.0, 0.0))
    axes.plot(*np.array([at, elbow]).T, color=rgb, linewidth=15, solid_capstyle="round", alpha=0.3)
    axes.plot(*np.array(at)[:, None], "o", color=rgb, markersize=9)
    axes.text(at[0] + 0.05, at[1], at[2] - 0.07, name, fontsize=11, weight="bold")


def draw_transform(
    axes: Axes3D, begin: Vector, end: Vector, name: str, share: float, offset: Vector
) -> None:
    """A dashed line between the origins of two frames, with the setting that relates them."""
    axes.plot(*np.array([begin, end]).T, color="0.25", linestyle="--", linewidth=1.1)
    axes.text(
        *(begin + share * (end - begin) + offset),
        name,
        fontsize=9,
        family="monospace",
        zorder=30,
        bbox=LABEL,
    )


def main() -> None:
    """Writes the picture beside this file."""
    settings = Settings()
    base = CoordinateFrame("base", np.zeros(3), np.eye(3), (-0.12, -0.10, -0.06))
    plate = tool_frame("plate", settings, (0.03, 0.08, 0.055))
    tool = tool_frame("tool", with_tool(settings, PLATE_FROM_TOOL), (0.05, 0.10, -0.055))
    tracker = frame_of("tracker", TRACKER, (-0.05, 0.0, 0.08))
    figure = plt.figure(figsize=(9.6, 6.6))
    axes = figure.add_axes((-0.1, -0.22, 1.2, 1.52), projection="3d")
    assert isinstance(axes, Axes3D)
    corners = [(0.15, -0.6, 0.0), (1.25, -0.6, 0.0), (1.25, 0.6, 0.0), (0.15, 0.6, 0.0)]
    axes.add_collection3d(
        Poly3DCollection([corners], facecolor="burlywood", alpha=0.25, edgecolor="sienna")
    )
    axes.text(1.1, 0.48, 0.0, "table", fontsize=9, color="sienna")
    draw_arm(axes, settings)
    for (name, at), colour in zip(HANDS.items(), (palette.LEFT, palette.RIGHT), strict=True):
        draw_hand(axes, name, at, colour)
    for frame in (base, plate, tool, tracker):
        draw_frame(axes, frame)
    above = np.array([0.0, 0.0, 0.02])
    draw_transform(
        axes,
        base.origin,
        tracker.origin,
        "[hands] base_from_tracker",
        0.62,
        np.array([-0.2, 0.0, 0.23]),
    )
    draw_transform(
        axes,
        plate.origin,
        tool.origin,
        "[tool] plate_from_tool",
        0.5,
        np.array([0.03, 0.05, 0.015]),
    )
    for at in HANDS.values():
        draw_transform(axes, tracker.origin, np.array(at), "", 0.5, above)
    axes.text(
        1.06,
        0.06,
        0.46,
        "hands/left, hands/right:\nposes in the tracker's frame",
        fontsize=9,
        color="0.15",
    )
    axes.set(xlim=(0.0, 1.2), ylim=(-0.6, 0.6), zlim=(0.0, 0.9), box_aspect=(1.2, 1.2, 0.9))
    axes.set_axis_off()
    axes.view_init(elev=22, azim=-52)
    figure.savefig(PICTURE, dpi=DPI)


if __name__ == "__main__":
    main()
