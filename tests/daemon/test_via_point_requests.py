"""Requests for via-points: checked, answered, saved, and carried out through the inbox."""

from __future__ import annotations

import stat
from typing import Any

import pytest

from service.client import RefusedError
from service.core.skill.skill import Skill
from service.daemon.queryables import SavedViaPoints
from service.learning.skill_file import StoredSkill
from service.learning.via_points import adapted
from support.request_cell import PLACES, Cell

HANDOVER = PLACES[0]


def point(**change: Any) -> dict[str, Any]:
    """A place as a client writes it; None leaves a field out."""
    whole = {"name": "a", "left": HANDOVER.left, "right": HANDOVER.right, "tool": HANDOVER.tool} | change
    return {name: value for name, value in whole.items() if value is not None}


def add(*points: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"op": "add", "points": points, **more}


def test_places_are_added_listed_replaced_removed_and_cleared(cell: Cell) -> None:
    assert cell.client.places() == ()
    points = cell.client.add(PLACES).points
    assert points is not None
    assert [taught.name for taught in points] == ["handover", "glass", "soldering"]
    assert all(taught.missed_by_m < 0.003 for taught in points)
    assert cell.client.places() == points

    moved = cell.client.ask(
        "via_points", add(point(name="glass", left=PLACES[1].left, right=PLACES[1].right, tool=[0.5, 0.1, 0.3]))
    )
    assert {taught["name"]: taught["tool"] for taught in moved["points"]}["glass"] == [0.5, 0.1, 0.3]
    assert len(moved["points"]) == 3

    assert [taught.name for taught in cell.client.remove("glass").points or ()] == ["handover", "soldering"]
    assert cell.client.clear().points == ()
    assert cell.kinds() == ["skill"] * 4
    assert cell.taken[0].value.via_points == PLACES


def test_a_reply_warns_of_a_place_that_is_missed_and_only_then(cell: Cell) -> None:
    assert cell.client.add(PLACES).warnings == ()
    at = [HANDOVER.tool[0], HANDOVER.tool[1] + 0.2, HANDOVER.tool[2]]
    reply = cell.client.ask("via_points", add(point(name="loose", tool=at, std=0.2)))
    missed = next(taught["missed_by_m"] for taught in reply["points"] if taught["name"] == "loose")
    assert missed > 0.1
    assert reply["warnings"][0].startswith(f"via-point 'loose' is missed by {1000 * missed:.0f} mm")


def test_what_the_loop_adopts_is_what_a_recording_keeps(cell: Cell, skill: StoredSkill) -> None:
    cell.client.add(PLACES, tolerance=0.04)
    (event,) = cell.taken
    wanted = adapted(skill, PLACES, tolerance=0.04)
    assert event.payload == cell.kept[0] == wanted.file
    assert type(event.value) is Skill  # without its file, which a recording has beside it
    assert event.value.digest == wanted.digest


def test_what_is_taught_is_in_force_again_after_a_restart(cell: Cell, skill: Skill) -> None:
    cell.client.add(PLACES[:2], tolerance=0.04)
    assert SavedViaPoints(cell.settings).read(skill) == (PLACES[:2], 0.04)
    cell.client.ask("via_points", {"op": "clear"})
    restored = SavedViaPoints(cell.settings).read(skill)
    assert restored is not None
    assert restored[0] == ()


def test_what_is_taught_is_its_users_alone(cell: Cell) -> None:
    cell.client.add(PLACES)
    saved = cell.folder / "state" / cell.settings.cell
    assert stat.S_IMODE(next(saved.glob("places-*.json")).stat().st_mode) == 0o600
    assert stat.S_IMODE(saved.stat().st_mode) == 0o700


def test_places_that_cannot_be_saved_are_not_taught(cell: Cell) -> None:
    (cell.folder / "state").write_text("a file where a folder is needed")
    with pytest.raises(RefusedError, match="via-points"):
        cell.client.add(PLACES)
    assert cell.kinds() == []
    assert cell.names() == []


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (add(point(left=[1.0, 2.0])), "$.points[0].left: 2 numbers, 3 needed"),
        (add(point(), point(name="b", tool=[0.1] * 4)), "$.points[1].tool: 4 numbers, 3 needed"),
        (add(point(left=[0.1, "x", 0.3])), "$.points[0].left[1]: 'x' given; -10 to 10 m accepted"),
        (add(point(left=[0.1, 0.2, 10.5])), "$.points[0].left[2]: 10.5 given; -10 to 10 m accepted"),
        (add(point(left="here")), "$.points[0].left: 'here' given; 3 numbers needed"),
        (add(point(right=None)), "$.points[0]: field `right` is missing"),
        (
            add(point(nam="b")),
            "$.points[0]: unknown field 'nam'; known are name, left, right, tool, std, radius, follow",
        ),
        (add(point(name="")), "$.points[0].name: '' given; 1 to 64 letters"),
        (add(point(name="a/b")), "$.points[0].name: "),
        (add(point(name="x" * 65)), "$.points[0].name: '"),
        (add(point(std=0.0)), "$.points[0].std: 0.0 given; a number from 1e-05 to 1 accepted"),
        (add(point(radius=0.3)), "$.points[0].radius: 0.3 given; a number from 0 to 0.2 accepted"),
        (add(point(follow="both")), "$.points[0].follow: 'both' given; left, none, right accepted"),
        (add(point(), point(name="b"), point()), "$.points[2].name: 'a' given twice, names once each needed"),
        (add(point(tool=[3.0, 0.0, 0.0])), "$.points[0].tool: [3.0, 0.0, 0.0] outside the skill's workspace, ("),
        (
            add(point(tool=[0.2, 0.0, 0.3])),
            "$.points[0].tool: [0.2, 0.0, 0.3] out of the arm's reach by 0.145 m: 0.35 to 0.88 m from the",
        ),
        (add(point(tool=[0.6, 0.0, 0.01])), "$.points[0].tool: [0.6, 0.0, 0.01] out of the arm's reach by 0.010 m"),
        (add(), "$.points: none given, 1 to 100 needed"),
        (add(*(point(name=f"p{i}") for i in range(101))), "$.points: 101 given, 1 to 100 needed"),
        (add(point(), tolerance=-1.0), "$.tolerance: -1.0 given; a number from 0 to 10 accepted"),
        ({"op": "add"}, "$: field `points` is missing"),
        (
            {"op": "remove", "names": ["nothing"]},
            "$.names[0]: no via-point 'nothing'; in force: handover, glass, soldering",
        ),
        (
            {"op": "remove", "names": ["glass", "nothing"]},
            "$.names[1]: no via-point 'nothing'; in force: handover, glass, soldering",
        ),
        ({"op": "remove", "names": ["glass", "glass"]}, "$.names[1]: 'glass' given twice"),
        ({"op": "remove", "names": []}, "$.names: none given, 1 to 100 needed"),
        ({"op": "lst"}, "$.op: 'lst' given; add, remove, clear, list accepted"),
        ({}, "$: field `op` is missing"),
        ([], "$: [] given; an object with its fields needed"),
        (b'{"op":', "not JSON: Input data was truncated"),
        (b'{"op": "list"}}', "not JSON: JSON is malformed: trailing characters"),
        (b"\xff\xfe", "not JSON: JSON is malformed"),
        (b"[" * 100_000, "not JSON: maximum recursion depth"),
        (b" " * 262_145, "a request of 262145 bytes, at most 262144 accepted"),
    ],
    ids=lambda value: str(value)[:60] if isinstance(value, str) else "",
)
def test_a_request_for_places_is_refused_whole_and_with_a_reason(
    taught_cell: Cell, request_: Any, message: str
) -> None:
    assert taught_cell.refusal("via_points", request_).startswith(message)
