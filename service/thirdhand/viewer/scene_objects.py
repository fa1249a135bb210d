"""Objects on the bench as Rerun chunks: boxes, ellipsoids and cylinders, each in its own frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr

from thirdhand.contract.messages import BASE, SceneObject
from thirdhand.contract.printable import printable
from thirdhand.settings import palette

LABEL_OFFSET_M = 0.06  # names of objects stand above them; names of held objects, toward the arm
Column = Callable[..., rr.chunk.Chunk]


def object_chunks(
    objects: Iterable[SceneObject], before: Iterable[str], labelled: Iterable[str], at: Column
) -> Iterator[rr.chunk.Chunk]:
    """The chunks that show the objects, and clear those in `before` that have disappeared.

    Names that are already `labelled` are not shown again. `at` makes a chunk of one row from a path
    and columns.
    """
    names = set()
    labelled = set(labelled)
    for scene_object in objects:
        path = _path(scene_object.name)
        names.add(scene_object.name)
        colour = [round(255 * value) for value in scene_object.colour]
        style: dict[str, Any] = {"colors": [colour], "fill_mode": [rr.components.FillMode.Solid]}
        pose = {"centers": [scene_object.position], "quaternions": [scene_object.orientation]}
        half = [tuple(size / 2 for size in scene_object.size)]
        frame = "tf#/" if scene_object.frame_id == BASE else scene_object.frame_id
        yield at(path, *rr.CoordinateFrame.columns(frame=[frame]))
        if scene_object.shape == "cylinder":
            radius = (scene_object.size[0] + scene_object.size[1]) / 4
            yield at(
                path,
                *row(
                    rr.Cylinders3D,
                    1,
                    lengths=[scene_object.size[2]],
                    radii=[radius],
                    **pose,
                    **style,
                ),
            )
        else:
            kind = rr.Boxes3D if scene_object.shape == "box" else rr.Ellipsoids3D
            yield at(path, *row(kind, 1, half_sizes=half, **pose, **style))
        label = {
            "labels": [printable(scene_object.name)],
            "show_labels": [scene_object.name not in labelled],
        }
        label |= {"colors": [palette.light(colour)]}
        yield at(f"{path}/name", *rr.CoordinateFrame.columns(frame=[frame]))
        yield at(
            f"{path}/name",
            *row(rr.Points3D, 1, positions=[_label_at(scene_object)], radii=[0.0], **label),
        )
    for name in set(before) - names:
        yield at(_path(name), *rr.Clear.columns(is_recursive=[True]))


def are_the_same(before: tuple[SceneObject, ...], after: tuple[SceneObject, ...]) -> bool:
    """True if objects have only moved: names, shapes, sizes and colours are as before."""
    return [_look(scene_object) for scene_object in before] == [
        _look(scene_object) for scene_object in after
    ]


def moved_chunks(
    rows: Sequence[Sequence[SceneObject]], index: list[rr.TimeColumn]
) -> Iterator[rr.chunk.Chunk]:
    """The chunks that move objects which are already shown, a row for each time of the index."""
    count = len(rows)
    for moves in zip(*rows, strict=True):
        first = moves[0]
        path = _path(moves[0].name)
        frames = ["tf#/" if move.frame_id == BASE else move.frame_id for move in moves]
        kind: Any = {"cylinder": rr.Cylinders3D, "box": rr.Boxes3D}.get(
            first.shape, rr.Ellipsoids3D
        )
        centers = [move.position for move in moves]
        turns = [move.orientation for move in moves]
        labels = [_label_at(move) for move in moves]
        poses = kind.columns(centers=centers, quaternions=turns).partition([1] * count)
        names = rr.Points3D.columns(positions=labels).partition([1] * count)
        for where, columns in ((path, poses), (f"{path}/name", names)):
            yield rr.chunk.Chunk.from_columns(
                where, index, [*rr.CoordinateFrame.columns(frame=frames), *columns]
            )


def _look(found: SceneObject) -> tuple[object, ...]:
    return found.name, found.shape, found.size, found.colour


def _label_at(found: SceneObject) -> tuple[float, float, float]:
    x, y, z = found.position
    return x, y, z + (LABEL_OFFSET_M if found.frame_id == BASE else -LABEL_OFFSET_M)


def row(kind: Any, count: int, **columns: Any) -> Any:
    """Columns of one row with `count` elements; 0 removes those that were shown."""
    if not count:
        key = next(iter(columns))
        columns = {key: np.empty((0, 2, 3) if key == "strips" else (0, 3))}
    return kind.columns(**columns).partition([count])


def _path(name: str) -> str:
    return f"/scene/things/{rr.escape_entity_path_part(name)}"
