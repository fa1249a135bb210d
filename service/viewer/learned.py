"""What the viewer draws of a skill: its demonstrations and reference as faint lines and points, and
the taught places, each with the neighbourhood of hands for which it holds.

Read leniently, straight from the arrays of the skill's file: what is not there is not drawn.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from service import palette
from service.contract.requests import ViaPoint
from service.demonstrations.files import read_demonstration
from service.learning.demonstration import Demonstration, fingerprint
from service.recording.mcap_file import RecordingError

MOST_CORNERS = 300  # of a line
MOST_FILES, MOST_FOLDERS = 60, 20
Points = NDArray[np.float64]
Point = tuple[float, float, float]
Column = Callable[..., rr.chunk.Chunk]


class Place(NamedTuple):
    """A place with a name: where hands and tool are at it [m], and for hands how far off it holds;
    without a radius of its own it was demonstrated, not taught.
    """

    name: str
    left: Point
    right: Point
    tool: Point
    radius: float = 0.0
    follow: str = "demonstrated"


class Taught(NamedTuple):
    """What a skill's file says: reference points of the tool (N, 3) [m], places with names, the
    deviation above which it holds [m], what was found in learning.
    """

    name: str
    learned_from: str
    reference: Points
    places: tuple[Place, ...]
    threshold: float
    figures: dict[str, Any]


def taught(skill: bytes) -> Taught:
    """What is to be drawn of the skill in the bytes of an .npz file. Raises ValueError."""
    try:
        with np.load(io.BytesIO(skill), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        reference = np.asarray(arrays.get("base_mean", np.empty((0, 3))), np.float64)
        is_tool = "outputs: tool x y z [m]" in str(arrays.get("units", "")) and reference.shape[1:] == (3,)
        places = {place.name: place for place in _demonstrated(arrays)}
        places |= {
            place.name: Place(place.name, place.left, place.right, place.tool, place.radius, place.follow)
            for place in msgspec.json.decode(str(arrays.get("places", "[]")), type=tuple[ViaPoint, ...])
        }
        return Taught(
            str(arrays.get("name", "")),
            str(arrays.get("learned_from", "")),
            reference if is_tool else np.empty((0, 3)),
            tuple(places.values()),
            float(arrays.get("threshold", np.inf)),
            msgspec.json.decode(str(arrays["figures"])) if "figures" in arrays else {},
        )
    except (
        OSError,
        KeyError,
        TypeError,
        EOFError,
        ValueError,
        zipfile.BadZipFile,
        msgspec.DecodeError,
        msgspec.ValidationError,
    ) as error:
        raise ValueError(f"a skill of which nothing can be drawn: {error}") from None


def _demonstrated(arrays: dict[str, Any]) -> Iterator[Place]:
    """The places that a skill knows from its demonstrations."""
    if "names" in arrays and "nominal" in arrays:
        names = msgspec.json.decode(str(arrays["names"]), type=tuple[str, ...])
        for name, at in zip(names, np.asarray(arrays["nominal"], np.float64).reshape(-1, 3, 3).tolist(), strict=True):
            left, right, tool = ((x, y, z) for x, y, z in at)
            yield Place(name, left, right, tool)


def demonstrations(skill: Taught, folder: Path) -> list[Demonstration]:
    """The demonstrations that a skill was learned from, where they are in a folder or one below it;
    else none.

    They are found by the names in the skill's figures, or among the folder's files in their order,
    and are known by their hash.
    """
    names = [str(row.get("name")) for row in skill.figures.get("demonstrations", ())]
    below = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    for place in (folder, *below[:MOST_FOLDERS]):
        paths = [place / f"{name}.mcap" for name in names] or sorted(place.glob("demonstration-*.mcap"))[:MOST_FILES]
        found: list[Demonstration] = []
        with contextlib.suppress(RecordingError, OSError):
            for path in paths if all(path.is_file() for path in paths) else ():
                found.append(read_demonstration(path))
                if len(found) >= len(names) and fingerprint(found) == skill.learned_from:
                    return found
    return []


def drawn(skill: Taught, shown: list[Demonstration], at: Column) -> Iterator[rr.chunk.Chunk]:
    """The chunks that show a skill; `at` makes one of a path and columns of one row."""
    for name, colour in (("left", palette.LEFT), ("right", palette.RIGHT), ("tool", palette.TOOL)):
        ways = [getattr(one, name)[:, :3] for one in shown]
        lines = [way[:: 1 + len(way) // MOST_CORNERS].astype(np.float32) for way in ways]
        look = {"colors": [palette.faint(colour, 0.22)] * len(lines), "radii": [0.001] * len(lines)}
        yield at(f"/skill/demonstrations/{name}", *_one(rr.LineStrips3D, len(lines), strips=lines, **look))
    count = len(skill.reference)
    look = {"colors": [palette.faint(palette.TOOL, 0.4)] * count, "radii": [0.0022] * count}
    yield at("/skill/reference", *_one(rr.Points3D, count, positions=skill.reference, **look))
    places, count = skill.places, len(skill.places)
    look = {"colors": [palette.PLACE] * count, "radii": [0.01] * count, "labels": [place.name for place in places]}
    yield at("/skill/places/tool", *_one(rr.Points3D, count, positions=[place.tool for place in places], **look))
    for side, colour in (("left", palette.LEFT), ("right", palette.RIGHT)):
        centres = [getattr(place, side) for place in places]
        half = [[max(place.radius, 0.004)] * 3 for place in places]
        look = {"colors": [palette.faint(colour, 0.5)] * count, "line_radii": [0.0004] * count}
        look |= {"fill_mode": [rr.components.FillMode.MajorWireframe] * count}
        yield at(f"/skill/places/{side}", *_one(rr.Ellipsoids3D, count, half_sizes=half, centers=centres, **look))
    lines = [[place.left, place.tool, place.right] for place in places]
    look = {"colors": [palette.faint(palette.PLACE, 0.25)] * count, "radii": [0.0006] * count}
    yield at("/skill/places/belong", *_one(rr.LineStrips3D, count, strips=lines, **look))
    text = about(skill, len(shown))
    yield at("/about/skill", *rr.TextDocument.columns(text=[text], media_type=["text/markdown"]))


def _one(kind: Any, count: int, **columns: Any) -> Any:
    """Columns of one row with so many of a kind; with none of them what was there is gone."""
    if not count:
        key = next(iter(columns))
        flat = kind.columns(**{key: np.empty((0, 2, 3) if key == "strips" else (0, 3))})
        return flat.partition([0])
    return kind.columns(**columns).partition([count])


def about(skill: Taught, shown: int) -> str:
    """What is known of a skill, as Markdown."""
    rows = skill.figures.get("demonstrations", ())
    lines = [f"# {skill.name or 'skill'}", ""]
    if len(skill.reference):
        lines.append(f"{len(skill.reference)} reference points of the tool (faint points).")
    lines.append(f"Learned from {shown} demonstrations (faint lines)." if shown else "Its demonstrations are not here.")
    lines.append(f"It holds where it is off what it knows by more than {1000 * skill.threshold:.0f} mm.")
    lines += ["", "## Places", ""]
    if skill.places:
        lines += ["| place | tool x, y, z [m] | within [mm] of the hands | goes with |", "|---|---|---|---|"]
        for place in skill.places:
            at = ", ".join(f"{value:.3f}" for value in place.tool)
            lines.append(f"| {place.name} | {at} | {1000 * place.radius:.0f} | {place.follow} |")
    else:
        lines.append("None.")
    if rows:
        lines += ["", "## Held out", "", "| demonstration | error [mm] | worst [mm] | within 95 % [%] |"]
        lines.append("|---|---|---|---|")
        for row in rows:
            cells = [str(row.get("name")), *(f"{row.get(key, 0):.1f}" for key in ("error_mm", "worst_mm", "within_95"))]
            lines.append(f"| {' | '.join(cells)} |")
        lines += [f"- {text}" for text in skill.figures.get("warnings", ())]
    return "\n".join(lines)
