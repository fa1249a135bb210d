"""Objects on the bench as Rerun chunks: boxes, ellipsoids and cylinders, each in its own frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import rerun as rr

from service import palette
from service.contract.messages import BASE, SceneObject
from service.contract.printable import printable

LABEL_OFFSET_M = (
    0.06  # of an object's name: above it, clear of via-points' names; toward the arm where the tool holds it
)
Column = Callable[..., rr.chunk.Chunk]


def object_chunks(
    objects: Iterable[SceneObject], before: Iterable[str], labelled: Iterable[str], at: Column
) -> Iterator[rr.chunk.Chunk]:
    """The chunks that show the objects, and clear those in `before` that are gone.

    Names that are `labelled` already are not shown again. `at` makes a chunk of one row from a path
    and columns.
    """
    names, labelled = set(), set(labelled)
    for found in objects:
        path = _path(found.name)
        names.add(found.name)
        colour = [round(255 * value) for value in found.colour]
        style: dict[str, Any] = {"colors": [colour], "fill_mode": [rr.components.FillMode.Solid]}
        pose = {"centers": [found.position], "quaternions": [found.orientation]}
        half = [tuple(size / 2 for size in found.size)]
        frame = "tf#/" if found.frame_id == BASE else found.frame_id
        yield at(path, *rr.CoordinateFrame.columns(frame=[frame]))
        if found.shape == "cylinder":
            radius = (found.size[0] + found.size[1]) / 4
            yield at(path, *row(rr.Cylinders3D, 1, lengths=[found.size[2]], radii=[radius], **pose, **style))
        else:
            kind = rr.Boxes3D if found.shape == "box" else rr.Ellipsoids3D
            yield at(path, *row(kind, 1, half_sizes=half, **pose, **style))
        x, y, z = found.position
        label_at = (x, y, z + (LABEL_OFFSET_M if found.frame_id == BASE else -LABEL_OFFSET_M))
        label = {"labels": [printable(found.name)], "show_labels": [found.name not in labelled]}
        label |= {"colors": [palette.light(colour)]}
        yield at(f"{path}/name", *rr.CoordinateFrame.columns(frame=[frame]))
        yield at(f"{path}/name", *row(rr.Points3D, 1, positions=[label_at], radii=[0.0], **label))
    for name in set(before) - names:
        yield at(_path(name), *rr.Clear.columns(is_recursive=[True]))


def row(kind: Any, count: int, **columns: Any) -> Any:
    """Columns of one row with `count` elements; 0 removes those that were shown."""
    if not count:
        key = next(iter(columns))
        columns = {key: np.empty((0, 2, 3) if key == "strips" else (0, 3))}
    return kind.columns(**columns).partition([count])


def _path(name: str) -> str:
    return f"/scene/things/{rr.escape_entity_path_part(name)}"
