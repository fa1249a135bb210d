"""Baselines: exact where they fit, and judged by what they have not seen."""

from __future__ import annotations

import numpy as np
import pytest

from service.learning.baselines import left_out, linear, look_up, same_time
from service.learning.demonstration import Demonstration

RANDOM = np.random.default_rng(0)
SLOPE, OFFSET = RANDOM.normal(size=(6, 3)), np.array([0.1, 0.2, 0.3])
HANDS = [RANDOM.normal(size=(50, 6)) for _ in range(3)]
ALONE = np.arange(3, dtype=np.intp)


def test_a_linear_function_is_found_from_the_others() -> None:
    paths = [(hands, hands @ SLOPE + OFFSET) for hands in HANDS]
    for errors in left_out(paths, ALONE, linear):
        assert errors == pytest.approx(np.zeros((50, 3)), abs=1e-9)


def test_a_look_up_answers_with_the_nearest_hands_of_another_demonstration() -> None:
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    near = [HANDS[0], HANDS[0] + 1e-6, HANDS[2] + 100.0]
    errors = left_out(list(zip(near, tools, strict=True)), ALONE, look_up)
    assert (errors[0] == -1.0).all()
    assert (errors[1] == 1.0).all()


def test_one_demonstration_is_judged_by_nothing() -> None:
    assert left_out([(HANDS[0], HANDS[0][:, :3])], ALONE[:1], linear) == []


def test_what_is_left_out_together_tells_nothing_of_each_other() -> None:
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    pairs = list(zip([HANDS[0], HANDS[0], HANDS[0] + 1e-6], tools, strict=True))
    assert [float(one[0, 0]) for one in left_out(pairs, ALONE, look_up)[:2]] == [-1.0, 1.0]
    assert [float(one[0, 0]) for one in left_out(pairs, np.array([0, 0, 1]), look_up)[:2]] == [-2.0, -1.0]


def test_after_as_much_time_the_tool_is_where_the_others_were_and_stays_at_their_end() -> None:
    def shown(seconds: float, speed: float) -> Demonstration:
        times = np.arange(0.0, seconds, 0.1)
        tool = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(times), 1))
        tool[:, 0] = speed * times
        return Demonstration((1e9 * times).astype(np.int64), tool, tool, tool)

    errors = same_time([shown(2.05, 1.0), shown(1.05, 2.0), shown(1.05, 4.0)], ALONE)
    np.testing.assert_allclose(errors[0][:, 0], [t - 3.0 * min(t, 1.0) for t in np.arange(0.0, 2.05, 0.1)], atol=1e-9)
    assert not errors[0][:, 1:].any()
