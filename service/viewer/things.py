"""Things on the bench as chunks: boxes, balls and cylinders, each in the frame that carries it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import rerun as rr

from service import palette
from service.contract.messages import BASE, Thing

ABOVE_M = 0.06  # a thing is its name, clear of those of places below; of what the tool holds, toward the arm
Column = Callable[..., rr.chunk.Chunk]


def drawn(things: Iterable[Thing], before: Iterable[str], at: Column) -> Iterator[rr.chunk.Chunk]:
    """The chunks that show things, and take away those that are no longer among them; `at` makes
    one of a path and columns of one row.
    """
    names = set()
    for thing in things:
        path = _path(thing.name)
        names.add(thing.name)
        colour = [round(255 * value) for value in thing.colour]
        look: dict[str, Any] = {"colors": [colour], "fill_mode": [rr.components.FillMode.Solid]}
        place = {"centers": [thing.position], "quaternions": [thing.orientation]}
        half = [tuple(size / 2 for size in thing.size)]
        frame = "tf#/" if thing.frame_id == BASE else thing.frame_id
        yield at(path, *rr.CoordinateFrame.columns(frame=[frame]))
        if thing.shape == "cylinder":
            radius = (thing.size[0] + thing.size[1]) / 4
            yield at(path, *_row(rr.Cylinders3D, lengths=[thing.size[2]], radii=[radius], **place, **look))
        else:
            kind = rr.Boxes3D if thing.shape == "box" else rr.Ellipsoids3D
            yield at(path, *_row(kind, half_sizes=half, **place, **look))
        x, y, z = thing.position
        over = (x, y, z + (ABOVE_M if thing.frame_id == BASE else -ABOVE_M))
        said = {"labels": [thing.name], "show_labels": [True], "colors": [palette.light(colour)]}
        yield at(f"{path}/name", *rr.CoordinateFrame.columns(frame=[frame]))
        yield at(f"{path}/name", *_row(rr.Points3D, positions=[over], radii=[0.0], **said))
    for name in set(before) - names:
        yield at(_path(name), *rr.Clear.columns(is_recursive=[True]))


def _row(kind: Any, **columns: Any) -> Any:
    return kind.columns(**columns).partition([1])


def _path(name: str) -> str:
    return f"/scene/things/{rr.escape_entity_path_part(name)}"
