"""What the viewer shows and never changes: the arm and its ghost, table, reach, names and colours.

Millimetres, microseconds and degrees of transparency are chosen here, in `chunks` and
`arrangement`, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from service import palette
from service.config import Reach, Settings
from service.contract.records import SIDES, Mode, Reason
from service.core.frame import STAGES
from service.viewer.banner import HEIGHT, WIDTH
from service.viewer.blueprint import EYE, LOOK_AT, UP

GHOST = "measured/"  # before the names of its frames
ARC_STEPS = 48
BANNER_AT, BANNER_WIDTH = (0.55, 0.66, -0.44), 0.74  # right of, above and before where the camera looks, by how far
_SHAPES = (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)


class Trees:
    """The arm as commanded and as measured: the same URDF twice, under names of their own."""

    def __init__(self, urdf: Path) -> None:
        self.commanded = rr.urdf.UrdfTree.from_file_path(urdf, entity_path_prefix="arm")
        self.measured = rr.urdf.UrdfTree.from_file_path(
            urdf, entity_path_prefix="measured", frame_prefix=GHOST, static_transform_entity_path="/measured/tf_static"
        )


def log_fixed(stream: rr.RecordingStream, trees: Trees, settings: Settings) -> None:
    """Logs what never changes."""

    def fix(path: str, *what: Any) -> None:
        stream.log(path, *what, static=True)

    _log_arm(stream, trees.commanded, "/arm", ghost=False)
    _log_arm(stream, trees.measured, "/measured", ghost=True)
    fix("/scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    fix("/scene/base", rr.Transform3D(parent_frame="tf#/", child_frame=trees.commanded.root_link().name))
    fix("/scene/ghost_base", rr.Transform3D(parent_frame="tf#/", child_frame=GHOST + trees.measured.root_link().name))
    _log_surroundings(fix, settings)
    fix("/scene/tool", rr.TransformAxes3D(0.07))
    for name, colour, radius in (
        ("left_hand", palette.LEFT, 0.022),
        ("right_hand", palette.RIGHT, 0.022),
        ("setpoint", palette.TOOL, 0.008),
    ):
        words = [name.replace("_", " ")]
        ball = rr.Points3D.from_fields(colors=[colour], radii=[radius], labels=words, show_labels=radius > 0.01)
        fix(f"/scene/{name}", ball)
    wires = rr.components.FillMode.TransparentFillMajorWireframe
    region = rr.Ellipsoids3D.from_fields(
        colors=[palette.TARGET], line_radii=[0.0006], fill_mode=wires, labels=["target, 2 sigma"], show_labels=False
    )
    fix("/scene/target", region)
    for name, colour in (("left", palette.LEFT), ("right", palette.RIGHT), ("tool", palette.TOOL)):
        fix(f"/scene/{name}_trail", rr.LineStrips3D.from_fields(colors=[colour], radii=[0.002]))
    fix("/scene/nearest", rr.LineStrips3D.from_fields(colors=[palette.NEAREST], radii=[0.0015], show_labels=True))
    _log_names(fix, settings)


def _log_arm(stream: rr.RecordingStream, tree: rr.urdf.UrdfTree, path: str, *, ghost: bool) -> None:
    """The shapes of the arm: solid, or as a ghost that one sees through."""
    fill = rr.components.FillMode.TransparentFillMajorWireframe if ghost else rr.components.FillMode.Solid
    colour = palette.faint(palette.MEASURED, 0.35)
    for chunk in tree.stream(include_joint_transforms=False):
        if "/collision_geometries/" in chunk.entity_path:
            continue
        stream.send_chunks(chunk)
        names = chunk.to_record_batch().schema.names
        for shape in _SHAPES:
            if any(name.startswith(f"{shape.__name__}:") for name in names):
                lines = "radii" if shape is rr.Boxes3D else "line_radii"
                look: dict[str, Any] = {"colors": [colour], lines: [0.0005]} if ghost else {}
                stream.log(chunk.entity_path, shape.from_fields(fill_mode=fill, **look), static=True)
        if ghost and any(name.startswith("Asset3D:") for name in names):
            stream.log(chunk.entity_path, rr.Asset3D.from_fields(albedo_factor=colour), static=True)
    for joint in tree.joints():
        if joint.joint_type == "fixed":
            stream.log(f"{path}/joints/{joint.child_link}", joint.compute_transform(0.0), static=True)


def _log_surroundings(fix: Any, settings: Settings) -> None:
    """Table, boxes, and how far the arm reaches."""
    (x, y, top), (half_x, half_y) = settings.table.centre, settings.table.half_size
    solid = rr.components.FillMode.Solid
    half = [(half_x, half_y, 0.0095)]
    fix(
        "/scene/table",
        rr.Boxes3D(centers=[(x, y, top - 0.01)], half_sizes=half, colors=[palette.TABLE], fill_mode=solid),
    )
    edge = [(x + a * half_x, y + b * half_y, top) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    fix("/scene/table/edge", rr.LineStrips3D([edge], colors=[palette.GREY], radii=[0.0015]))
    if boxes := settings.obstacles.boxes:
        fix(
            "/scene/obstacles",
            rr.Boxes3D(
                centers=[box.centre for box in boxes],
                half_sizes=[box.half_size for box in boxes],
                colors=[palette.TABLE],
                fill_mode=solid,
            ),
        )
    faint, thin = palette.faint(palette.GREY, 0.08), rr.Radius.ui_points(0.5)  # else thick where it nears the eye
    fix("/scene/reach", rr.LineStrips3D(list(reach_lines(settings.reach)), colors=[faint], radii=thin))


def reach_lines(reach: Reach) -> Iterator[NDArray[np.float64]]:
    """Lines (P, 3) [m] on the outer shell of the reach: around at two heights, and up and down at
    three bearings.
    """
    centre = np.array(reach.centre)
    lowest = max(np.arcsin(np.clip((reach.min_z - centre[2]) / reach.outer, -1.0, 1.0)), -np.pi / 2)
    around, up = np.linspace(-np.pi / 2, np.pi / 2, ARC_STEPS), np.linspace(lowest, np.pi / 2, ARC_STEPS)
    arcs = [(around, np.full(ARC_STEPS, height)) for height in (lowest, 0.0)]
    arcs += [(np.full(ARC_STEPS, bearing), up) for bearing in (-np.pi / 3, 0.0, np.pi / 3)]
    for bearing, height in arcs:
        way = np.stack([np.cos(bearing) * np.cos(height), np.sin(bearing) * np.cos(height), np.sin(height)], axis=1)
        points = centre + reach.outer * way
        points = points[points[:, 0] >= reach.min_x]
        if len(points) > 1:
            yield points


def _log_names(fix: Any, settings: Settings) -> None:
    """Names, units and colours of the curves, and the words and colours of the modes."""
    joints = [name.rpartition("/")[2].removesuffix("_joint").replace("_", " ") for name in settings.joints.names]
    several: list[tuple[str, list[str], str, tuple[palette.Colour, ...]]] = [
        (f"/joints/{what}", joints, unit, palette.JOINTS)
        for what, unit in (("position", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s²"))
    ]
    several += [
        ("/timing/stages", list(STAGES), "µs", palette.JOINTS),
        ("/age", [f"{side} hand" for side in SIDES], "ms", (palette.LEFT, palette.RIGHT)),
    ]
    for path, names, unit, colours in several:
        look: dict[str, Any] = {
            "colors": [colours[i % len(colours)] for i in range(len(names))],
            "widths": [1.5] * len(names),
        }
        fix(path, rr.SeriesLines(names=[f"{name} [{unit}]" for name in names], **look, **_drawn_as(path)))
    for path, name, colour in (
        ("/error/target", "tool to target [mm]", palette.TOOL),
        ("/turn/target", "turned from the target [°]", palette.TOOL),
        ("/turn/std", "target's standard deviation [°]", palette.TARGET),
        ("/gripper/predicted", "predicted [%]", palette.TARGET),
        ("/gripper/commanded", "commanded [%]", palette.TOOL),
        ("/deviation/target", "target's standard deviation [mm]", palette.TARGET),
        ("/deviation/hands", "hands off what is known [mm]", palette.OFF),
        ("/deviation/gate", "holds above [mm]", palette.GATE),
        ("/speed/tool", "tool [m/s]", palette.TOOL),
        ("/speed/left", "left hand [m/s]", palette.LEFT),
        ("/speed/right", "right hand [m/s]", palette.RIGHT),
        ("/separation/distance", "distance [m]", palette.NEAREST),
        ("/separation/limit", "allowed [m/s]", palette.SKY),
        ("/joints/error", "largest [rad]", palette.MEASURED),
        ("/latency/hand", "hand's stamp to command [ms]", palette.LATENCY),
        ("/timing/lateness", "late by [µs]", palette.LATENESS),
        ("/timing/work", "work [µs]", palette.WORK),
    ):
        fix(path, rr.SeriesLines(names=name, colors=colour, widths=1.5, **_drawn_as(path)))
    for path, words, numbers in (
        ("/mode/mode", [mode.name.lower() for mode in Mode], [palette.packed(palette.MODES[mode]) for mode in Mode]),
        ("/mode/reason", [reason.name.lower() for reason in Reason], [palette.packed(palette.GREY)] * len(Reason)),
    ):
        labels = [word.replace("_", " ") for word in words]
        fix(path, rr.StateConfiguration(values=words, labels=labels, colors=np.array(numbers, np.uint32)))
    fix("/scene/banner", _sign())


def _drawn_as(path: str) -> dict[str, Any]:
    """Where a curve has more values than the screen has dots, the worst of them count."""
    worst = path.startswith(("/timing", "/latency", "/age"))
    return {"aggregation_policy": rr.components.AggregationPolicy.Max} if worst else {}


def _sign() -> rr.Mesh3D:
    """The board behind the arm on which mode and reason are written: it faces the camera."""
    far = np.linalg.norm(np.subtract(EYE, LOOK_AT))
    toward = np.subtract(EYE, LOOK_AT) / far
    right = np.cross(UP, toward) / np.linalg.norm(np.cross(UP, toward))
    up = np.cross(toward, right)
    centre = LOOK_AT + np.stack([right, up, toward], axis=1) @ (far * np.array(BANNER_AT))
    right, up = 0.5 * far * BANNER_WIDTH * right, 0.5 * far * BANNER_WIDTH * HEIGHT / WIDTH * up
    corners = [centre - right - up, centre + right - up, centre + right + up, centre - right + up]
    return rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[(0, 1, 2), (0, 2, 3)],
        vertex_texcoords=[(0, 1), (1, 1), (1, 0), (0, 0)],
        vertex_normals=[(0, 0, 0)] * 4,
    )
