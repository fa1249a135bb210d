"""The smoother: a reach followed without lag or chatter, and limits that hold whatever the target
does.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st
from wam import STATE

from service.config import Settings, ToolSettings
from service.contract.messages import PoseStamped
from service.core.frame import Vector, blank
from service.core.intake import Intake
from service.core.smoother import Smoother

PERIOD_S = 0.002
TOOL = ToolSettings()
REST_S, REACH_S = 0.5, 2.5
REACH = np.array([0.30, -0.20, 0.12])  # [m] of the hand
GAIN = 1.6  # the target goes so many times as far
properties = example_settings(max_examples=25, deadline=None, derandomize=True)
inside = st.tuples(*(st.floats(-1.0, 1.0),) * 3)
anything = st.tuples(*(st.floats(-1e3, 1e3),) * 3)


def reach(t: float) -> Vector:
    """Position, velocity and acceleration (3, 3) of a hand that goes there and back by minimum
    jerk, with rests.
    """
    half, since = divmod(t, REST_S + REACH_S)
    u = min(max(since - REST_S, 0.0) / REACH_S, 1.0)
    share = np.array(
        [
            u**3 * (10 - 15 * u + 6 * u * u),
            30 * (u * (1 - u)) ** 2 / REACH_S,
            60 * u * (1 - u) * (1 - 2 * u) / REACH_S**2,
        ]
    )
    motion = np.outer(share, REACH)
    return motion if half % 2 == 0 else np.array([REACH, np.zeros(3), np.zeros(3)]) - motion


def following(seed: int) -> tuple[Vector, Vector]:
    """Setpoints and noise-free targets (T, 3, 3) while a tracker sees the reach at 100 Hz with 0.5
    mm of noise.
    """
    random = np.random.default_rng(seed)
    intake, smoother = Intake(Settings()), Smoother(TOOL, PERIOD_S)
    state = blank(STATE)
    state["tick"] = state["hand_ticks"] = -1
    setpoint = np.zeros((3, 3))
    setpoints, targets = [], []
    for tick in range(round(2 * (REST_S + REACH_S) / PERIOD_S)):
        intake.advance(state, 1)
        if tick % 5 == 0:
            seen = reach(tick * PERIOD_S)[0] + random.normal(0.0, 0.0005, 3)
            intake.take_hand(
                state, 0, PoseStamped(1 + tick * 2_000_000, "base", tuple(seen.tolist()), (0.0, 0.0, 0.0, 1.0))
            )
        setpoint, _ = smoother.step(setpoint, *(GAIN * state["filters"][0]))
        setpoints.append(setpoint)
        targets.append(GAIN * reach(tick * PERIOD_S))
    return np.array(setpoints), np.array(targets)


def stepped(start: Vector, targets: list[Vector], *, ticks: int) -> tuple[Vector, list[bool]]:
    """Setpoints (1 + T, 3, 3) and whether each met a limit, when each target (3, 3) is held for
    some ticks.
    """
    smoother, states, limited = Smoother(TOOL, PERIOD_S), [start], []
    for target in targets:
        for _ in range(ticks):
            state, met = smoother.step(states[-1], *target)
            states.append(state)
            limited.append(met)
    return np.array(states), limited


def at_rest(position: tuple[float, ...] | Vector) -> Vector:
    """A motion (3, 3) that stands still at a position."""
    return np.array([position, (0.0,) * 3, (0.0,) * 3])


def assert_limits_of_each_axis_hold(states: Vector) -> None:
    assert np.isfinite(states).all()
    assert np.abs(states[:, 1]).max() <= 1.01 * TOOL.max_speed
    assert np.abs(states[:, 2]).max() <= TOOL.max_acceleration * (1 + 1e-6)
    assert np.abs(np.diff(states[:, 2], axis=0)).max() / PERIOD_S <= TOOL.max_jerk * (1 + 1e-6)


def top_speed(states: Vector) -> float:
    """The greatest norm of the velocity [m/s]."""
    return float(np.linalg.norm(states[:, 1], axis=1).max())


# --- quiet motion --------------------------------------------------------------------------------


def lag_s(moved: Vector, asked: Vector) -> float:
    """By how much speeds trail those asked for: the peak of their cross-correlation, between its
    samples by a parabola.
    """
    a, b = (np.linalg.norm(x[:, 1], axis=1) for x in (moved, asked))
    most = 40
    score = [float(np.dot(a[most + k : len(a) - most + k], b[most:-most])) for k in range(-most, most + 1)]
    k = int(np.argmax(score))
    assert 0 < k < 2 * most
    before, peak, after = score[k - 1 : k + 2]
    return (k - most + 0.5 * (before - after) / (before - 2 * peak + after)) * PERIOD_S


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_reach_is_followed_without_lag_and_without_chatter(seed: int) -> None:
    setpoints, targets = following(seed)
    assert abs(lag_s(setpoints, targets)) <= 0.014
    moving = slice(round(REST_S / PERIOD_S), None)  # the first sample makes the setpoint start with a small step
    chatter, needed = (np.sqrt(np.mean(x[moving, 2] ** 2)) for x in (setpoints, targets))
    assert chatter <= 3 * needed
    assert np.linalg.norm(setpoints[moving, 0] - targets[moving, 0], axis=1).max() < 0.012
    assert_limits_of_each_axis_hold(setpoints)


def test_a_target_within_limits_is_met_to_a_hundredth_of_a_millimetre_where_it_moves_steadily() -> None:
    velocity = np.array([0.2, -0.1, 0.05])
    smoother, state = Smoother(TOOL, PERIOD_S), at_rest((0.0, 0.0, 0.0))
    for tick in range(1500):
        target = velocity * tick * PERIOD_S
        state, limited = smoother.step(state, target, velocity, np.zeros(3))
    np.testing.assert_allclose(state[0], target + velocity * PERIOD_S, atol=1e-5)
    assert not limited


def test_a_setpoint_at_rest_on_its_target_stays_there_to_the_bit() -> None:
    states, limited = stepped(at_rest((0.5, 0.1, 0.3)), [at_rest((0.5, 0.1, 0.3))], ticks=100)
    np.testing.assert_array_equal(states, np.broadcast_to(states[0], states.shape))
    assert not any(limited)


# --- jumps and worse -----------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.577, 0.577, -0.577), (0.9, 0.1, -0.3)])
@pytest.mark.parametrize("distance_m", [0.01, 0.24, 1.0])
def test_a_jump_is_approached_without_overshoot(direction: tuple[float, ...], distance_m: float) -> None:
    way = distance_m * np.array(direction) / np.linalg.norm(direction)
    states, limited = stepped(at_rest((0.0, 0.0, 0.0)), [at_rest(way)], ticks=1200)
    assert ((states[:, 0] @ way) / distance_m**2).max() <= 1.02
    np.testing.assert_allclose(states[-1, 0], way, atol=1e-4)
    assert top_speed(states) <= 1.01 * TOOL.max_speed
    assert_limits_of_each_axis_hold(states)
    assert any(limited) == (distance_m > 0.1)


@properties
@given(st.lists(inside, min_size=1, max_size=8), st.integers(5, 150))
def test_limits_hold_for_any_jumps_of_a_target(positions: list[tuple[float, float, float]], ticks: int) -> None:
    states, _ = stepped(at_rest((0.0, 0.0, 0.0)), [at_rest(position) for position in positions], ticks=ticks)
    assert top_speed(states) <= 1.01 * TOOL.max_speed
    assert_limits_of_each_axis_hold(states)


@properties
@given(st.lists(st.tuples(anything, anything, anything), min_size=1, max_size=20), st.integers(1, 30))
def test_limits_of_each_axis_hold_whatever_is_asked(targets: list[tuple[tuple[float, ...], ...]], ticks: int) -> None:
    states, _ = stepped(at_rest((0.0, 0.0, 0.0)), [np.array(target) for target in targets], ticks=ticks)
    assert_limits_of_each_axis_hold(states)


@pytest.mark.parametrize(
    ("amplitude_m", "hertz", "way"),
    [
        (0.3, 0.8, (1.0, 0.0, 0.0)),
        (0.4, 1.0, (0.0, -1.0, 0.0)),
        (0.3, 0.8, (0.577, 0.577, 0.577)),
        (0.4, 1.0, (0.0, 0.6, -0.8)),
        (0.2, 1.5, (0.577, 0.577, -0.577)),
    ],
)
def test_a_target_that_swings_too_fast_is_followed_at_the_speed_limit(
    amplitude_m: float, hertz: float, way: tuple[float, ...]
) -> None:
    smoother, omega = Smoother(TOOL, PERIOD_S), 2 * np.pi * hertz
    states = [at_rest((0.0, 0.0, 0.0))]
    for tick in range(750):
        phase = omega * tick * PERIOD_S
        swing = amplitude_m * np.array([1 - np.cos(phase), omega * np.sin(phase), omega**2 * np.cos(phase)])
        states.append(smoother.step(states[-1], *np.outer(swing, way))[0])
    assert_limits_of_each_axis_hold(np.array(states))
    assert top_speed(np.array(states)) <= 1.01 * TOOL.max_speed


def test_lowered_limits_are_kept() -> None:
    tool = ToolSettings(max_speed=0.2, max_acceleration=1.0, max_jerk=20.0)
    smoother, states = Smoother(tool, PERIOD_S), [at_rest((0.0, 0.0, 0.0))]
    for _ in range(1500):
        states.append(smoother.step(states[-1], np.array([0.2, 0.2, 0.2]), np.zeros(3), np.zeros(3))[0])
    moved = np.array(states)
    assert top_speed(moved) <= 1.01 * 0.2
    assert np.abs(moved[:, 2]).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(moved[:, 2], axis=0)).max() / PERIOD_S <= 20.0 + 1e-6


def test_a_state_beyond_every_limit_is_braked() -> None:
    fast = np.array([(0.0,) * 3, (2.0, -2.0, 0.0), (8.0, 0.0, -8.0)])
    states, limited = stepped(fast, [at_rest((0.0, 0.0, 0.0))], ticks=1500)
    assert np.isfinite(states).all()
    assert limited[0]
    assert_limits_of_each_axis_hold(states[1000:])
    assert top_speed(states[1000:]) <= 1.01 * TOOL.max_speed


def test_going_on_from_a_copy_of_the_state_gives_the_same_bits() -> None:
    setpoints, _ = following(seed=1)
    random = np.random.default_rng(5)
    targets = [random.uniform(-1.0, 1.0, (3, 3)) for _ in range(40)]
    start = setpoints[1000]
    whole, _ = stepped(start, targets, ticks=5)
    rest, _ = stepped(np.frombuffer(whole[100].tobytes()).reshape(3, 3), targets[20:], ticks=5)
    assert rest.tobytes() == whole[100:].tobytes()
