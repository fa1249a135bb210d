"""The limiter: every limit holds by construction, for any wanted velocity; a motion within the
limits passes unchanged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thirdhand.core.joint_limits import approach_gain
from thirdhand.core.limiter.stage import Limited, Limiter
from thirdhand.settings.config import JointSettings

PERIOD = 0.002  # [s]
LIMITS = JointSettings()
LOWERED = JointSettings(velocity=(0.3,) * 7, acceleration=(0.5,) * 7, jerk=(4.0,) * 7)
LOWER = np.array(LIMITS.lower)
UPPER = np.array(LIMITS.upper)
REST = np.zeros(7)
START = np.array([0.0, 0.0, 0.0, 1.2, -1.5, 0.0, 0.0])  # far from all limits
# as published: joints 2 and 4 outside their limits
HOME = np.array([0.0, -2.0, 0.0, 3.13, 0.0, 0.0, 0.0])
Vector = npt.NDArray[np.float64]


class Run(NamedTuple):
    """A motion from rest, (N, 7) each; jerk from differences of acceleration."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    jerk: Vector
    limited: list[bool]


def drive(limits: JointSettings, q: Vector, inputs: Vector, changing: Vector | None = None) -> Run:
    limiter = Limiter(limits, PERIOD)
    state: tuple[Vector, Vector, Vector] = (q, REST, REST)
    steps: list[Limited] = []
    for k, velocity in enumerate(inputs):
        steps.append(limiter.step(*state, velocity, None if changing is None else changing[k]))
        state = steps[-1][:3]
    position, speed, acceleration = (np.array([step[i] for step in steps]) for i in range(3))
    jerk = np.diff(acceleration, axis=0, prepend=0.0) / PERIOD
    return Run(position, speed, acceleration, jerk, [step.limited for step in steps])


def assert_held(limits: JointSettings, q: Vector, run: Run) -> None:
    furthest = np.vstack((q, run.position))
    assert (np.maximum.accumulate(furthest)[-1] <= np.maximum(UPPER, q)).all()
    assert (np.minimum.accumulate(furthest)[-1] >= np.minimum(LOWER, q)).all()
    outside = np.maximum(np.maximum(furthest - UPPER, LOWER - furthest), 0.0)
    assert (np.diff(outside, axis=0) <= 0.0).all(), "outside the limits, inwards only"
    assert (np.abs(run.velocity) <= limits.velocity).all()
    assert (np.abs(run.acceleration) <= np.array(limits.acceleration) * (1 + 1e-9)).all()
    assert (np.abs(run.jerk) <= np.array(limits.jerk) * (1 + 1e-9)).all()
    between = 0.5 * (run.velocity[1:] + run.velocity[:-1])
    # the largest error of the trapezoidal rule in one tick of constant jerk
    slack = np.array(limits.jerk) * PERIOD**2 + 1e-6
    assert (np.abs(np.diff(run.position, axis=0) / PERIOD - between) <= slack).all(), (
        "position follows velocity"
    )
    assert np.array_equal(run.position, run.position.round(9))


anything = st.one_of(
    st.floats(),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, 1.5, -1.5]),
    st.floats(-2.0, 2.0),
    st.floats(-30.0, 30.0),
)
pieces = st.lists(st.tuples(st.tuples(*[anything] * 7), st.integers(1, 60)), min_size=1, max_size=8)


anywhere = st.tuples(*[st.floats(0.0, 1.0)] * 7).map(
    lambda where: (LOWER + np.array(where) * (UPPER - LOWER)).round(9).clip(LOWER, UPPER)
)


def tick_by_tick(wanted: list[tuple[tuple[float, ...], int]]) -> Vector:
    """The wanted velocities (N, 7) in each tick."""
    return np.array([value for value, count in wanted for _ in range(count)])


@settings(derandomize=True, deadline=None, max_examples=150)
@given(pieces, st.none() | pieces, anywhere | st.just(HOME), st.sampled_from([LIMITS, LOWERED]))
def test_limits_hold_for_any_velocities(
    wanted: list[tuple[tuple[float, ...], int]],
    said: list[tuple[tuple[float, ...], int]] | None,
    q: Vector,
    limits: JointSettings,
) -> None:
    """HOME is outside the limits: from there, joints only move inwards."""
    inputs = tick_by_tick(wanted)
    changing = None if said is None else np.resize(tick_by_tick(said), inputs.shape)
    assert_held(limits, q, drive(limits, q, inputs, changing))


def test_smooth_motion_passes_unchanged() -> None:
    times = PERIOD * np.arange(1, 4001)[:, None]
    start = 1.0 - np.exp(-(times**3))
    target = start * 0.4 * np.sin(1.3 * times + np.arange(7))
    run = drive(LIMITS, START, target)
    assert np.abs(run.velocity - target).max() < 2e-5
    assert not any(run.limited)


def test_announced_ramp_is_followed_without_lag() -> None:
    """Velocities with sudden changes are followed if their derivative is given."""
    rate = np.array([5.0, -5.0, 5.0, 4.0, -5.0, 5.0, -3.0])
    target = np.clip(PERIOD * np.arange(1, 201)[:, None], 0.0, 0.25) * rate
    changing = np.where(target == 0.25 * rate, 0.0, rate)
    announced, untold = (
        np.abs(drive(LIMITS, START, target, derivative).velocity - target)
        for derivative in (changing, None)
    )
    last = slice(80, 124)  # the end of the ramp
    assert announced[last].max() < 1e-6
    late = rate**2 / (2.0 * np.array(LIMITS.jerk))
    np.testing.assert_allclose(untold[last], np.tile(late, (44, 1)), rtol=0.2)
    assert announced[-1].max() < 1e-9


def test_pushing_against_a_limit_rests_there() -> None:
    """There is no chatter."""
    run = drive(LIMITS, START, np.full((5000, 7), 9.0))
    assert_held(LIMITS, np.zeros(7), run)
    assert (run.position[-1] > UPPER - 1e-4).all()
    assert (np.diff(run.position[2000:], axis=0) >= 0.0).all()
    assert np.abs(run.jerk[2000:]).max() < 1.0
    assert all(run.limited)


def test_stop_is_shortest_and_ends_together() -> None:
    """A stop takes the shortest time that the limits allow, and all joints come to rest
    together.
    """
    limiter = Limiter(LIMITS, PERIOD)
    start = (np.zeros(7), np.full(7, 1.2), np.zeros(7))
    a = np.array(LIMITS.acceleration)
    j = np.array(LIMITS.jerk)
    shortest = np.where(a**2 / j > 1.2, 2 * np.sqrt(1.2 / j), 1.2 / a + a / j)
    q, dq, ddq = start
    stopped = np.zeros(7)
    for tick in range(1, 200):
        q, dq, ddq, _ = limiter.stop(q, dq, ddq)
        stopped[(stopped == 0) & (np.abs(dq) < 1e-9) & (np.abs(ddq) < 1e-9)] = tick * PERIOD
    assert (stopped >= shortest - 1e-9).all()
    assert (np.abs(stopped - shortest.max()) <= 1.001 * PERIOD).all()


def test_joints_together_stay_on_their_way() -> None:
    """Synchronised joints stay between their present velocities and the wanted ones."""
    limiter = Limiter(LIMITS, PERIOD)
    target = np.array([0.4, -0.1, 0.02, 0.3, -0.6, 0.001, 0.5])
    is_reached = np.isclose(
        drive(LIMITS, START, np.tile(target, (300, 1))).velocity, target, rtol=1e-6, atol=0.0
    )
    alone = int(np.argmax(is_reached.all(axis=1)))
    state: tuple[Vector, Vector, Vector] = (START, REST, REST)
    for _ in range(round(1.5 * alone)):
        step = limiter.together(*state, target)
        assert step is not None
        assert np.ptp(step.velocity / target) < 1e-6
        assert (step.velocity / target).max() < 1.001  # overshoot within the last tick
        assert (
            np.abs(step.acceleration - state[2]) <= np.array(LIMITS.jerk) * PERIOD * (1 + 1e-9)
        ).all()
        assert (np.abs(step.acceleration) <= np.array(LIMITS.acceleration) * (1 + 1e-9)).all()
        state = step[:3]
    assert np.allclose(state[1], target, rtol=1e-6, atol=0.0)
    assert limiter.together(START, target, 50 * np.sign(target), -target) is None


def test_a_nan_stops_all_joints() -> None:
    limiter = Limiter(LIMITS, PERIOD)
    run = drive(LIMITS, START, np.tile([1.0, -1.2, 0.9, 0.6, -1, 1, 0.5], (40, 1)))
    state = run.position[-1], run.velocity[-1], run.acceleration[-1]
    target = np.array([0.0, 0.0, math.nan, 0.0, 0.0, 0.0, 0.0])
    for _ in range(300):
        q, dq, ddq, limited = limiter.step(*state, target)
        state = (q, dq, ddq)
        assert limited
    assert np.abs(state[1]).max() < 1e-12


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300, 1e9])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_unusable_state_neither_raises_nor_moves(bad: float, which: int) -> None:
    """An invalid joint state raises no error and does not move the other joints."""
    state = [REST.copy(), REST.copy(), REST.copy()]
    state[which][3] = bad
    q, dq, ddq = state
    for result in (
        Limiter(LIMITS, PERIOD).step(q, dq, ddq, np.ones(7)),
        Limiter(LIMITS, PERIOD).stop(q, dq, ddq),
    ):
        assert result.limited
        assert not result.velocity.any()
        assert np.array_equal(result.position, state[0], equal_nan=True)


@settings(derandomize=True, deadline=None, max_examples=100)
@given(st.tuples(*[st.floats(-1e4, 1e4)] * 21))
def test_no_finite_state_raises_or_gives_nan(values: tuple[float, ...]) -> None:
    q, dq, ddq = np.array(values).reshape(3, 7)
    for result in (
        Limiter(LIMITS, PERIOD).step(q, dq, ddq, np.ones(7)),
        Limiter(LIMITS, PERIOD).stop(q, dq, ddq),
    ):
        for array in result[:3]:
            assert np.isfinite(array).all()


def test_too_fast_joint_is_brought_back() -> None:
    limiter = Limiter(LIMITS, PERIOD)
    q = REST
    dq = np.full(7, 2.5)
    ddq = np.full(7, 30.0)
    for _ in range(600):
        q, dq, ddq, _ = limiter.step(q, dq, ddq, np.full(7, 0.1))
    assert np.abs(dq - 0.1).max() < 1e-9
    assert np.abs(ddq).max() < 1e-6


def test_approach_takes_half_the_acceleration() -> None:
    gain = approach_gain(LIMITS)
    velocity = np.array(LIMITS.velocity)
    assert (gain * velocity <= 0.5 * np.array(LIMITS.acceleration) + 1e-12).all()
    assert (gain**2 * velocity <= 0.25 * np.array(LIMITS.jerk) + 1e-12).all()
    slow = msgspec.structs.replace(LIMITS, jerk=(1.0,) * 7)
    assert (approach_gain(slow) ** 2 * velocity <= 0.25 + 1e-12).all()
