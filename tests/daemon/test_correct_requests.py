"""Requests to correct the tool: refused with a reason, carried out only in a hold, and undone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from support.request_cell import VIA_POINTS, Cell
from thirdhand.client import RefusedError
from thirdhand.contract.records import Mode
from thirdhand.core.codes import HELD_SEEN, HELD_UNSEEN
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.via_points import adapted

ADD = {"op": "add"}


@pytest.fixture(scope="module")
def taught(skill: Skill) -> Skill:
    """The cell's skill: the shipped one with the via-points of the nominal scene."""
    return adapted(skill, VIA_POINTS, tolerance=0.05)


@pytest.fixture
def held(cell: Cell, taught: Skill) -> Cell:
    """A cell whose arm holds with the hands halfway to the handover, and was led away by hand."""
    cell.client.add(VIA_POINTS)
    state = cell.state
    hands = taught.model.hands
    state["tick"] = 1000
    state["arm_tick"] = 1000
    state["held_tick"] = 900
    state["guided_tick"] = 990
    state["operator_hold"] = 1
    state["held"] = HELD_SEEN
    state["held_segment"] = 0
    state["held_hands"] = (0.5 * (hands[0] + hands[1])).reshape(2, 3)
    state["measured"] = cell.settings.arm.posture
    state["measured"][0] += 0.2
    return cell


@pytest.mark.timeout(300)
def test_corrections_are_refused_with_the_reason(held: Cell, taught: Skill) -> None:
    state = held.state
    right = taught.mean(state["held_hands"].reshape(1, 6), ["handover"])[0].tolist()
    cases: tuple[tuple[dict[str, Any], dict[str, Any], str], ...] = (
        ({"operator_hold": 0}, ADD, "the arm does not hold for an operator"),
        ({"operator_hold": 0}, {"op": "undo"}, "the arm does not hold for an operator"),
        ({"held": HELD_UNSEEN}, ADD, "the hands were not seen when the hold began"),
        ({"guided_tick": 0}, ADD, "the arm was not led in this hold"),
        ({"guided_tick": 899}, ADD, "the arm was not led in this hold"),
        ({"arm_tick": 500}, ADD, "the arm's joints are not measured now"),
        ({"measured_velocities": 0.3}, ADD, "the arm moves at 0.30 rad/s; 0.05 rad/s accepted"),
        ({"held_segment": -1}, ADD, "the segment of the task was not known"),
        (
            {},
            ADD | {"tool": right},
            "the tool is 0 mm from where the skill has it for these hands; 5 mm or more",
        ),
        ({"held_hands": 0.3}, ADD, "the distance of a hand from its paths is "),
        (
            {},
            ADD | {"tool": [0.5, 0.0, 2.0]},
            "$.tool: [0.5, 0.0, 2.0] outside the skill's workspace",
        ),
        ({}, ADD | {"tool": [0.6, 0.0, -0.02]}, "$.tool: [0.6, 0.0, -0.02]"),
        (
            {},
            ADD | {"tool": [0.8, -0.31, 0.19]},
            "no posture of the arm has the tool there and keeps clear",
        ),
        ({}, ADD | {"tool": right, "turned": True}, "turned: true given with a tool"),
        ({}, ADD | {"hands": "now"}, "$.hands: 'now' given, but the hands are not seen now"),
        ({}, {"op": "undo"}, "no correction is in force"),
    )
    for change, request, words in cases:
        before = {name: np.array(state[name]) for name in change}
        for name, value in change.items():
            state[name] = value
        assert words in held.refusal("correct", request), (change, request)
        for name, value in before.items():
            state[name] = value
    held.mode = Mode.FAULT
    assert "the arm is in a fault" in held.refusal("correct", ADD)
    held.mode = Mode.FOLLOW
    assert "the arm does not hold" in held.refusal("correct", ADD)


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("field", "value"), [("operator_hold", 0), ("held_tick", 950), ("mode", Mode.FOLLOW)]
)
def test_a_correction_is_made_in_its_own_hold_alone(
    held: Cell, monkeypatch: pytest.MonkeyPatch, field: str, value: int
) -> None:
    """The hold ends while the correction is computed; another hold may have begun."""
    monkeypatch.setattr(held, "keep", lambda file: held.state.__setitem__(field, value))
    assert held.refusal("correct", ADD).startswith(
        "the hold ended while this was computed; nothing was changed"
    )


@pytest.mark.timeout(300)
def test_corrections_are_undone_in_turn_with_what_they_replaced(held: Cell) -> None:
    first = held.client.correct()
    assert first.correction is not None
    assert (first.correction.name, first.correction.segment) == (
        "correction-1",
        ("start", "handover"),
    )
    # the segment at the hold, not that of the leading hand's motion
    assert held.kinds()[-2:] == ["skill", "segment"]
    points = held.client.via_points()
    held.state["measured"][0] += 0.1
    second = held.client.correct()
    assert second.correction is not None
    assert (second.correction.name, second.correction.corrections) == ("correction-2", 2)
    two = held.client.via_points()
    assert [point.name for point in two] == [*(point.name for point in VIA_POINTS), "correction-2"]
    undone = held.client.undo_correction().correction
    assert undone is not None
    assert (undone.name, undone.undone) == ("correction-2", True)
    assert held.client.via_points() == points
    held.client.undo_correction()
    assert [point.name for point in held.client.via_points()] == [
        point.name for point in VIA_POINTS
    ]
    with pytest.raises(RefusedError, match="no correction is in force"):
        held.client.undo_correction()
    assert not held.failures
