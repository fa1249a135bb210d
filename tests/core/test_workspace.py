"""The workspace: a target outside is clamped to it, and its motion leads no further out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import clamp, is_reachable
from thirdhand.settings.config import Reach

REACH = Reach()
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


def numbers(size: int) -> st.SearchStrategy[Vector]:
    usual = st.floats(-3, 3)
    any_finite = st.floats(allow_nan=False, allow_infinity=False)
    return st.tuples(*[st.one_of(usual, any_finite)] * size).map(np.array)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(numbers(3), numbers(3), numbers(3))
def test_clamped_target_is_reachable(p: Vector, v: Vector, a: Vector) -> None:
    """The motion of a clamped target leads no further out."""
    v = v.clip(-1e6, 1e6)
    a = a.clip(-1e6, 1e6)
    position, velocity, acceleration, clamped = clamp(p, v, a, box=EVERYWHERE, reach=REACH)
    from_shoulder = position - REACH.centre
    distance = float(np.linalg.norm(from_shoulder))
    assert REACH.inner - 1e-9 <= distance <= REACH.outer + 1e-9
    assert position[0] >= REACH.min_x - 1e-9
    assert position[2] >= REACH.min_z - 1e-9
    if not clamped:
        assert np.array_equal([position, velocity, acceleration], [p, v, a])
        return
    reclamped, _, _, _ = clamp(position, v, a, box=EVERYWHERE, reach=REACH)
    assert reclamped == pytest.approx(position, abs=1e-9)
    if abs(distance - REACH.outer) < 1e-9 and math.dist(p, REACH.centre) > REACH.outer:
        assert from_shoulder @ velocity <= 1e-6 * (1 + np.linalg.norm(velocity))


def test_clamping_keeps_motion_along_the_boundary() -> None:
    position, velocity, acceleration, clamped = clamp(
        np.array([2.0, 0, REACH.centre[2]]),
        np.array([0.3, 0.2, 0.1]),
        np.array([-1.0, 0.5, 0.0]),
        box=EVERYWHERE,
        reach=REACH,
    )
    assert clamped
    assert position == pytest.approx([REACH.outer, 0, REACH.centre[2]])
    assert velocity == pytest.approx([0.0, 0.2, 0.1])
    assert acceleration == pytest.approx([-1.0, 0.5, 0.0])


def test_target_stays_at_a_side_of_the_box() -> None:
    """A target outside the box stays at its side and moves along it."""
    box = np.array([[0.3, -0.4, 0.1], [0.7, 0.4, 0.5]])
    target = np.array([0.5, 0.6, 0.3])
    velocity = np.array([0.1, 0.2, 0.3])
    position, moving, _, clamped = clamp(target, velocity, velocity, box=box, reach=REACH)
    assert clamped
    assert position.tolist() == [0.5, 0.4, 0.3]
    assert moving.tolist() == [0.1, 0.0, 0.3]


def test_what_is_inside_passes_unchanged() -> None:
    position = np.array([0.5, 0.1, 0.3])
    assert is_reachable(position, REACH)
    target = clamp(position, position, position, box=EVERYWHERE, reach=REACH)
    assert not target.clamped
    assert all(part.tolist() == position.tolist() for part in target[:3])
