"""Baselines: exact where they fit, and judged on held-out demonstrations."""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.baselines import held_out_errors, linear, look_up
from thirdhand.workbench.learning.records import Take

RANDOM = np.random.default_rng(0)
SLOPE = RANDOM.normal(size=(6, 3))
OFFSET = np.array([0.1, 0.2, 0.3])
HANDS = [RANDOM.normal(size=(50, 6)) for _ in range(3)]


def take(person: int, hands: np.ndarray, tool: np.ndarray) -> Take:
    """A take of hands (T, 6) and tool (T, 3)."""
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(hands), 1))
    left, right, tools = (
        np.hstack([position, still]) for position in (hands[:, :3], hands[:, 3:], tool)
    )
    demonstration = Demonstration(np.arange(len(hands)) * 10**7, left, right, tools)
    return Take(str(person), person, demonstration, hands, tools, None)


def test_linear_function_is_found() -> None:
    """The other demonstrations determine the function."""
    takes = [take(person, hands, hands @ SLOPE + OFFSET) for person, hands in enumerate(HANDS)]
    for errors in held_out_errors(takes, linear):
        assert errors == pytest.approx(np.zeros((50, 3)), abs=1e-9)


def test_look_up_uses_nearest_hands() -> None:
    """A look-up returns the tool at the nearest hands of another demonstration."""
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    near = [HANDS[0], HANDS[0] + 1e-6, HANDS[2] + 100.0]
    errors = held_out_errors(
        [take(*parts) for parts in zip(range(3), near, tools, strict=True)], look_up
    )
    assert (errors[0] == -1.0).all()
    assert (errors[1] == 1.0).all()


def test_left_out_person_tells_nothing() -> None:
    """Demonstrations that are held out together do not predict each other."""
    tools = [np.full((50, 3), float(number)) for number in range(3)]
    hands = [HANDS[0], HANDS[0], HANDS[0] + 1e-6]
    for persons, expected in ((range(3), [-1.0, 1.0]), ((0, 0, 1), [-2.0, -1.0])):
        takes = [take(*parts) for parts in zip(persons, hands, tools, strict=True)]
        assert [float(errors[0, 0]) for errors in held_out_errors(takes, look_up)[:2]] == expected
