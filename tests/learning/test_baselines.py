"""Baselines: exact where they fit, and judged by what they have not seen."""

from __future__ import annotations

import numpy as np
import pytest

from service.learning.baselines import left_out, linear, look_up

RANDOM = np.random.default_rng(0)
SLOPE, OFFSET = RANDOM.normal(size=(6, 3)), np.array([0.1, 0.2, 0.3])
HANDS = [RANDOM.normal(size=(50, 6)) for _ in range(3)]


def test_a_linear_function_is_found_from_the_others() -> None:
    paths = [(hands, hands @ SLOPE + OFFSET) for hands in HANDS]
    for errors in left_out(paths, linear):
        assert errors == pytest.approx(np.zeros((50, 3)), abs=1e-9)


def test_a_look_up_answers_with_the_nearest_hands_of_another_demonstration() -> None:
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    near = [HANDS[0], HANDS[0] + 1e-6, HANDS[2] + 100.0]
    errors = left_out(list(zip(near, tools, strict=True)), look_up)
    assert (errors[0] == -1.0).all()
    assert (errors[1] == 1.0).all()


def test_one_demonstration_is_judged_by_nothing() -> None:
    assert left_out([(HANDS[0], HANDS[0][:, :3])], linear) == []
