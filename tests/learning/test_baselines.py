"""Baselines: exact where they fit, and judged by what they have not seen."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.baselines import (
    baselines,
    held_out_errors,
    linear,
    look_up,
    same_time,
)
from thirdhand.workbench.learning.records import Take
from thirdhand.workbench.learning.takes import takes_of

RANDOM = np.random.default_rng(0)
SLOPE, OFFSET = RANDOM.normal(size=(6, 3)), np.array([0.1, 0.2, 0.3])
HANDS = [RANDOM.normal(size=(50, 6)) for _ in range(3)]


def take(person: int, hands: np.ndarray, tool: np.ndarray) -> Take:
    """A take of hands (T, 6) and tool (T, 3)."""
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(hands), 1))
    left, right, tools = (np.hstack([at, still]) for at in (hands[:, :3], hands[:, 3:], tool))
    shown = Demonstration(np.arange(len(hands)) * 10**7, left, right, tools)
    return Take(str(person), person, shown, hands, tools, None)


def test_a_linear_function_is_found_from_the_others() -> None:
    takes = [take(person, hands, hands @ SLOPE + OFFSET) for person, hands in enumerate(HANDS)]
    for errors in held_out_errors(takes, linear):
        assert errors == pytest.approx(np.zeros((50, 3)), abs=1e-9)


def test_a_look_up_answers_with_the_nearest_hands_of_another_demonstration() -> None:
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    near = [HANDS[0], HANDS[0] + 1e-6, HANDS[2] + 100.0]
    errors = held_out_errors([take(*one) for one in zip(range(3), near, tools, strict=True)], look_up)
    assert (errors[0] == -1.0).all()
    assert (errors[1] == 1.0).all()


def test_one_demonstration_is_judged_by_nothing() -> None:
    assert baselines([take(0, HANDS[0], HANDS[0][:, :3])]) == {}


def test_what_is_left_out_together_tells_nothing_of_each_other() -> None:
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    hands = [HANDS[0], HANDS[0], HANDS[0] + 1e-6]
    for persons, wanted in ((range(3), [-1.0, 1.0]), ((0, 0, 1), [-2.0, -1.0])):
        takes = [take(*one) for one in zip(persons, hands, tools, strict=True)]
        assert [float(one[0, 0]) for one in held_out_errors(takes, look_up)[:2]] == wanted


def test_after_as_much_time_the_tool_is_where_the_others_were_and_stays_at_their_end() -> None:
    def shown(seconds: float, speed: float) -> Demonstration:
        times = np.arange(0.0, seconds, 0.1)
        tool = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(times), 1))
        tool[:, 0] = speed * times
        return Demonstration((1e9 * times).astype(np.int64), tool, tool, tool)

    one, *others = takes_of([shown(2.05, 1.0), shown(1.05, 2.0), shown(1.05, 4.0)], list("abc"))
    found = same_time(one, others)
    np.testing.assert_allclose(found[:, 0], [3.0 * min(t, 1.0) for t in np.arange(0.0, 2.05, 0.1)], atol=1e-9)
    assert not found[:, 1:].any()
