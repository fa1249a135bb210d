"""A skill in the scene: demonstrations as faint lines, the reference as points, and via-points with
the radius of their neighbourhood.

The skill is read from the arrays of its file; missing ones are not drawn.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np
import rerun as rr

from thirdhand.contract.explain import in_words
from thirdhand.contract.printable import as_markdown, printable, printable_values
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.settings import palette
from thirdhand.viewer.scene_objects import Column, row

MAX_LINE_POINTS = 300
Point = tuple[float, float, float]


class MarkedViaPoint(NamedTuple):
    """A via-point with a name: positions of hands and tool [m], and the radius of the hands'
    neighbourhood [m]. Without a radius, it was demonstrated, not taught.
    """

    name: str
    left: Point
    right: Point
    tool: Point
    radius: float = 0.0
    follow: str = "demonstrated"


class SkillContents(NamedTuple):
    """The contents of a skill's file: reference points of the tool (N, 3) [m], via-points, the
    deviation above which the arm holds [m], the figures of its learning, and its demonstrations.
    """

    name: str
    reference: Vector
    via_points: tuple[MarkedViaPoint, ...]
    threshold: float
    figures: dict[str, Any]
    demonstrations: list[Vector]


def skill_contents(skill: bytes) -> SkillContents:
    """The contents of a skill that can be drawn, from its .npz file's bytes. Raises ValueError."""
    try:
        with np.load(io.BytesIO(skill), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        reference = np.asarray(arrays.get("base_mean", np.empty((0, 3))), np.float64)
        is_tool = "outputs: tool x y z [m]" in str(arrays.get("units", "")) and reference.shape[
            1:
        ] == (3,)
        via_points = {point.name: point for point in _demonstrated(arrays)}
        via_points |= {
            point.name: MarkedViaPoint(
                point.name, point.left, point.right, point.tool, point.radius, point.follow
            )
            for point in msgspec.json.decode(
                str(arrays.get("via_points", "[]")), type=tuple[ViaPoint, ...]
            )
        }
        return SkillContents(
            printable(str(arrays.get("name", ""))),
            reference if is_tool else np.empty((0, 3)),
            tuple(via_points.values()),
            float(arrays.get("threshold", np.inf)),
            printable_values(msgspec.json.decode(str(arrays["figures"])))
            if "figures" in arrays
            else {},
            demonstrations(arrays["demonstrations"].tobytes())
            if "demonstrations" in arrays
            else [],
        )
    except (OSError, KeyError, TypeError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"a skill that cannot be drawn: {in_words(error)}") from None


def _demonstrated(arrays: dict[str, Any]) -> Iterator[MarkedViaPoint]:
    """The named via-points in a skill's demonstrations."""
    if "names" in arrays and "nominal" in arrays:
        names = map(printable, msgspec.json.decode(str(arrays["names"]), type=tuple[str, ...]))
        for name, positions in zip(
            names, np.asarray(arrays["nominal"], np.float64).reshape(-1, 3, 3).tolist(), strict=True
        ):
            left, right, tool = ((x, y, z) for x, y, z in positions)
            yield MarkedViaPoint(name, left, right, tool)


def demonstrations(archive: bytes) -> list[Vector]:
    """The positions (T, 9) [m] of left hand, right hand and tool in each of the demonstrations that
    a skill's file holds; see `skills.stored_demonstrations`.
    """
    with np.load(io.BytesIO(archive), allow_pickle=False) as arrays:
        samples = [about["samples"] for about in msgspec.json.decode(arrays["about"].tobytes())]
        positions = arrays["poses"].reshape(-1, 3, 7)[:, :, :3].reshape(-1, 9)
    return np.split(positions, np.cumsum(samples)[:-1])


def skill_chunks(skill: SkillContents, at: Column) -> Iterator[rr.chunk.Chunk]:
    """The chunks that show a skill; `at` makes a chunk of one row from a path and columns."""
    for first, (name, colour) in enumerate(palette.BY_TRACK.items()):
        columns = slice(3 * first, 3 * first + 3)
        lines = [
            track[:: 1 + len(track) // MAX_LINE_POINTS, columns] for track in skill.demonstrations
        ]
        style = {
            "colors": [palette.faint(colour, 0.12)] * len(lines),
            "radii": [rr.Radius.ui_points(0.5)] * len(lines),
        }
        yield at(
            f"/skill/demonstrations/{name}",
            *row(rr.LineStrips3D, len(lines), strips=lines, **style),
        )
    count = len(skill.reference)
    style = {"colors": [palette.faint(palette.TOOL, 0.4)] * count, "radii": [0.0022] * count}
    yield at("/skill/reference", *row(rr.Points3D, count, positions=skill.reference, **style))
    points = skill.via_points
    count = len(skill.via_points)
    style = {
        "colors": [palette.VIA_POINT] * count,
        "radii": [0.01] * count,
        "labels": [point.name for point in points],
    }
    yield at(
        "/skill/via_points/tool",
        *row(rr.Points3D, count, positions=[point.tool for point in points], **style),
    )
    for side, colour in (("left", palette.LEFT), ("right", palette.RIGHT)):
        centres = [getattr(point, side) for point in points]
        half = [[max(point.radius, 0.004)] * 3 for point in points]
        style = {"colors": [palette.faint(colour, 0.5)] * count, "line_radii": [0.0004] * count}
        style |= {"fill_mode": [rr.components.FillMode.MajorWireframe] * count}
        yield at(
            f"/skill/via_points/{side}",
            *row(rr.Ellipsoids3D, count, half_sizes=half, centers=centres, **style),
        )
    triples = [[point.left, point.tool, point.right] for point in points]
    style = {"colors": [palette.faint(palette.VIA_POINT, 0.25)] * count, "radii": [0.0006] * count}
    yield at("/skill/via_points/belong", *row(rr.LineStrips3D, count, strips=triples, **style))
    text = about(skill)
    yield at("/about/skill", *rr.TextDocument.columns(text=[text], media_type=["text/markdown"]))


def about(skill: SkillContents) -> str:
    """A description of the skill, as Markdown."""
    count = len(skill.demonstrations)
    lines = [f"# {as_markdown(skill.name or 'skill')}", ""]
    if len(skill.reference):
        lines.append(f"{len(skill.reference)} reference points of the tool (faint points).")
    lines.append(
        f"Learned from {count} demonstrations (faint lines)."
        if count
        else "Its file holds no demonstrations."
    )
    lines.append(
        "The arm holds if the deviation from what the skill knows exceeds "
        f"{1000 * skill.threshold:.0f} mm."
    )
    lines += ["", "## Via-points", "", *_via_point_lines(skill), *_error_lines(skill.figures)]
    return "\n".join(lines)


def _via_point_lines(skill: SkillContents) -> Iterator[str]:
    """The table of the via-points, line by line."""
    if not skill.via_points:
        yield "None."
        return
    yield "| via-point | tool x, y, z [m] | radius of the hands [mm] | moves with |"
    yield "|---|---|---|---|"
    for point in skill.via_points:
        position_text = ", ".join(f"{value:.3f}" for value in point.tool)
        yield (
            f"| {as_markdown(point.name)} | {position_text} | {1000 * point.radius:.0f} | "
            f"{point.follow} |"
        )


def _error_lines(figures: Mapping[str, Any]) -> Iterator[str]:
    """The table of the held-out errors, with warnings and residual risk, line by line."""
    rows = figures.get("demonstrations", ())
    if not rows:
        return
    yield from ("", "## Held-out errors", "")
    yield "| demonstration | error [mm] | worst [mm] | within the 95 % region [%] |"
    yield "|---|---|---|---|"
    for judged in rows:
        cells = [
            as_markdown(str(judged.get("name"))),
            *(f"{judged.get(key, 0):.1f}" for key in ("error_mm", "worst_mm", "within_95")),
        ]
        yield f"| {' | '.join(cells)} |"
    for text in figures.get("warnings", ()):
        yield f"- {as_markdown(text)}"
    for text in figures.get("residual", ()):
        yield f"- residual risk: {as_markdown(text)}"
