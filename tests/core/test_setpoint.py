"""The setpoint's bounds, which hold for any target. How it follows is tested in test_following."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import ruckig
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from support.explained import Explained, margin
from support.setpoints import (
    BOX,
    FREE,
    MIDDLE,
    PERIOD_S,
    TOOL,
    at_rest,
    driven,
    name_of_broken_bound,
)
from support.wam import STATE
from thirdhand.core.frame import Vector, blank
from thirdhand.core.setpoint.stage import SetpointGenerator
from thirdhand.core.setpoint.step import slow_down
from thirdhand.core.setpoint.tracker import waiting
from thirdhand.core.skill.model import Target
from thirdhand.core.stops import fastest_stop
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import FOLLOWING, Settings, ToolSettings

HULL_MARGIN_M = TUNING.setpoint.hull_margin_m
HULL_TIME_S = TUNING.setpoint.hull_time_s
JERK_WEIGHT = TUNING.setpoint.jerk_weight
RETURN_SHARE = 0.75 * TUNING.decision.progress_share


WAY_TICKS = round(2.0 / PERIOD_S)  # time to reach the targets from any state
properties = example_settings(max_examples=60, deadline=None, derandomize=True)
inside = st.tuples(st.floats(0.2, 1.0), st.floats(-0.6, 0.6), st.floats(0.05, 0.8))
moving = st.tuples(*(st.floats(-20.0, 20.0),) * 3)
wild = st.tuples(*(st.floats(-1e4, 1e4),) * 3)


def assert_bounds_hold(states: Vector, targets: list[Vector]) -> None:
    """Speed, acceleration, jerk, workspace, and the box around the last targets."""
    assert np.isfinite(states).all()
    assert np.linalg.norm(states[:, 1], axis=1).max() <= TOOL.max_speed + 1e-9
    assert np.linalg.norm(states[:, 2], axis=1).max() <= TOOL.acceleration + 1e-9
    assert (
        np.linalg.norm(np.diff(states[:, 2], axis=0), axis=1).max() <= (TOOL.jerk + 1e-6) * PERIOD_S
    )
    # error of one tick of constant jerk: jerk period³ / 12
    trapezia = 0.5 * PERIOD_S * (states[1:, 1] + states[:-1, 1])
    np.testing.assert_allclose(
        np.diff(states[:, 0], axis=0), trapezia, atol=1.01 * TOOL.jerk * PERIOD_S**3 / 12
    )
    assert (states[:, 0] >= BOX[0] - 1e-9).all()
    assert (states[:, 0] <= BOX[1] + 1e-9).all()
    positions = np.array([states[0, 0], *(target[0] for target in targets)])
    for k in range(0, len(targets), 7):
        last = positions[max(0, k + 1 - WAY_TICKS) : k + 2]
        assert (states[k + 1, 0] >= last.min(axis=0) - HULL_MARGIN_M - 1e-9).all()
        assert (states[k + 1, 0] <= last.max(axis=0) + HULL_MARGIN_M + 1e-9).all()


# --- bounds ------------------------------------------------------------


@properties
@given(st.lists(st.tuples(inside, moving, wild), min_size=1, max_size=25), st.integers(1, 120))
def test_every_bound_holds_whatever_is_asked(
    told: list[tuple[tuple[float, ...], ...]], ticks: int
) -> None:
    targets = [np.array(target) for target in told for _ in range(ticks)]
    states, _ = driven(targets)
    assert_bounds_hold(states, targets)


@properties
@given(st.lists(inside, min_size=2, max_size=6), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_alternating_targets_keep_bounds(
    places: list[tuple[float, ...]], ticks: int, seed: int
) -> None:
    """The setpoint does not run away from targets that alternate or tremble."""
    random = np.random.default_rng(seed)
    targets = []
    for place in itertools.islice(itertools.cycle(places), 1500 // ticks):
        for _ in range(ticks):
            position = np.clip(np.array(place) + random.normal(0.0, 0.005, 3), *BOX)
            targets.append(
                np.array([position, random.normal(0.0, 2.0, 3), random.normal(0.0, 50.0, 3)])
            )
    states, _ = driven(targets)
    assert_bounds_hold(states, targets)


@properties
@given(
    st.lists(inside, min_size=2, max_size=4),
    inside,
    st.integers(1, 40),
    st.sampled_from([0.0, 1e2, 1e4, 1e6]),
)
def test_starved_axis_comes_back(
    places: list[tuple[float, ...]], start: tuple[float, ...], ticks: int, wild: float
) -> None:
    """The targets of the other axes are extreme; that of the first axis rests, away from the
    start.
    """
    targets = []
    for k in range(1500):
        y, z = places[k // ticks % len(places)][1:]
        sign = (-1.0) ** (k // ticks)
        targets.append(np.array([(0.5, y, z), (0.0, 0.0, 0.0), (0.0, sign * wild, -sign * wild)]))
    states, _ = driven(targets, start=at_rest(start))
    back_s = (abs(start[0] - 0.5) - HULL_MARGIN_M) / (RETURN_SHARE * TOOL.max_speed)
    if back_s < len(targets) * PERIOD_S - 2 * HULL_TIME_S:
        assert abs(states[-1, 0, 0] - 0.5) <= margin(TOOL) + 1e-6


@pytest.mark.parametrize("seed", range(30))
def test_rests_on_a_side_of_the_workspace(seed: int) -> None:
    """The target is on a side, an edge or a corner, or just inside; at any rate, with any
    limits.
    """
    random = np.random.default_rng(seed)
    speed = 10 ** random.uniform(-1.5, -0.1)
    tool = ToolSettings(
        max_speed=speed,
        max_acceleration=10 ** random.uniform(-0.3, 1.3),
        max_jerk=10 ** random.uniform(0.7, 3),
        follow=str(random.choice(list(FOLLOWING))),
    )
    rate_hz = int(random.choice([50, 70, 100, 125, 250, 333, 500, 700, 1000]))
    settings = Settings(rate_hz=rate_hz, tool=tool if seed % 3 else TOOL)
    target = random.uniform(*BOX)
    sides = random.integers(0, 3, 3)
    sides[random.integers(3)] = random.integers(2)
    for axis, side in enumerate(sides):
        if side < 2:
            hair = random.choice([0.0, 1e-9, 1e-6, 1e-5, 1e-4])
            target[axis] = BOX[side, axis] + hair * (1 - 2 * side)
    start = target + random.uniform(0, 0.2) * (BOX.mean(axis=0) - target)
    generator = SetpointGenerator(settings)
    state = blank(STATE)
    generator.begin(state, at_rest(start))
    slowest_s = max(
        JERK_WEIGHT ** (1 / 6), 1.5 * tool.acceleration / tool.jerk, (100 * tool.jerk) ** (-1 / 3)
    )
    accelerations = []
    for _ in range(
        round((3.0 + 2.0 * np.linalg.norm(target - start) / speed + 30 * slowest_s) * rate_hz)
    ):
        generator.step(state, Target(*at_rest(target), clamped=True), BOX, FREE, 1.0)
        accelerations.append(np.abs(state["setpoint"][2]).max())
    assert max(accelerations[-rate_hz:]) <= 1e-6
    np.testing.assert_allclose(state["setpoint"][0], target, atol=1e-6)


def test_waits_for_a_tool_that_cannot_come() -> None:
    """The distance stays bounded: the setpoint once crept toward its target."""
    generator = Explained(Settings(tool=TOOL))
    state = blank(STATE)
    generator.begin(state, at_rest(MIDDLE))
    target = Target(*at_rest(MIDDLE + np.array([0.38, 0.0, 0.0])), clamped=False)
    gaps_m = TUNING.setpoint.gap_waiting_m, TUNING.setpoint.gap_stopped_m
    for _ in range(5000):
        slow = slow_down(state["setpoint"], MIDDLE, 1.0, generator.limits(state)[0])
        generator.step(state, waiting(target, state["setpoint"], MIDDLE, gaps_m), BOX, FREE, slow)
    assert not state["setpoint"][1].round(4).any()
    assert 0.15 < state["setpoint"][0, 0] - MIDDLE[0] <= 0.201


def test_returns_into_the_workspace() -> None:
    """A setpoint outside the workspace only moves toward it."""
    start = at_rest((0.05, 0.9, 0.02))
    targets = [at_rest(MIDDLE)] * 1500
    states, _ = driven(targets, start=start)
    outside_m = np.maximum(BOX[0] - states[:, 0], 0.0) + np.maximum(states[:, 0] - BOX[1], 0.0)
    assert (np.diff(outside_m, axis=0) <= 1e-9).all()
    np.testing.assert_allclose(states[-1, 0], MIDDLE, atol=1e-4)


def test_state_beyond_limits_is_braked() -> None:
    fast = np.array([MIDDLE, (2.0, -2.0, 0.0), (3.0, 0.0, -3.0)])
    states, flags = driven([at_rest(MIDDLE)] * 2500, start=fast)
    assert flags[0]
    assert np.linalg.norm(states[400:, 1], axis=1).max() <= TOOL.max_speed + 1e-9
    np.testing.assert_allclose(states[-1, 0], MIDDLE, atol=1e-3)


def test_slow_joints_slow_it_on_its_way() -> None:
    """The setpoint moves no faster than the joints allow."""
    costs = np.zeros((3, 3, 7))
    costs[0, 1, 2] = 1 / 0.1  # a joint that moves the tool along y by 0.1 m/s at most
    offset_m = np.array([0.1, 0.3, 0.0])
    states, _ = driven([at_rest(MIDDLE)] * 10 + [at_rest(MIDDLE + offset_m)] * 3000, costs=costs)
    assert np.abs(states[:, 1, 1]).max() <= 0.1 + 1e-3
    along = offset_m / np.linalg.norm(offset_m)
    aside = (states[:, 0] - MIDDLE) - np.outer((states[:, 0] - MIDDLE) @ along, along)
    assert np.linalg.norm(aside, axis=1).max() < 0.002
    np.testing.assert_allclose(states[-1, 0], MIDDLE + offset_m, atol=1e-3)


def test_broken_bound_is_named() -> None:
    """A setpoint beyond a bound is detected."""
    generator = SetpointGenerator(Settings())
    state = blank(STATE)
    generator.begin(state, at_rest(MIDDLE))
    before = state["setpoint"].copy()
    for bound, row, value in (
        ("speed", 1, 0.9),
        ("acceleration", 2, 10.1),
        ("jerk", 2, 1.0),
        ("position", 0, 9.0),
    ):
        state["setpoint"] = before
        state["setpoint"][row, 0] = value
        assert name_of_broken_bound(generator, state, before) == bound
    state["setpoint"][0, 0] = np.nan
    assert name_of_broken_bound(generator, state, before) == "not finite"


# --- stops ------------------------------------------------------------


@properties
@given(st.floats(-0.8, 0.8), st.floats(-4.0, 4.0), st.floats(0.5, 4.0), st.floats(20.0, 200.0))
def test_fastest_stop_is_that_of_ruckig(
    velocity: float, acceleration: float, max_acceleration: float, max_jerk: float
) -> None:
    """The fastest stop of one axis equals that of Ruckig."""
    acceleration = max(-max_acceleration, min(max_acceleration, acceleration))
    profile = ruckig_stop(velocity, acceleration, max_acceleration, max_jerk)
    out = np.empty(6)
    fastest_stop(velocity, acceleration, max_acceleration, max_jerk, PERIOD_S, out)
    position, speed, change = (
        value[0] for value in profile.at_time(min(PERIOD_S, profile.duration))
    )
    np.testing.assert_allclose(out[:3], [speed, change, position], atol=1e-7)
    extrema = profile.position_extrema[0]
    np.testing.assert_allclose(
        out[3:], [min(extrema.min, 0.0), max(extrema.max, 0.0), profile.duration], atol=1e-7
    )


def ruckig_stop(
    velocity: float, acceleration: float, max_acceleration: float, max_jerk: float
) -> ruckig.Trajectory:
    """Ruckig's stop of one axis from 0."""
    question = ruckig.InputParameter(1)
    profile = ruckig.Trajectory(1)
    question.control_interface = ruckig.ControlInterface.Velocity
    question.current_velocity = [velocity]
    question.current_acceleration = [acceleration]
    question.target_velocity = [0.0]
    question.max_velocity = [9.0]
    question.max_acceleration = [max_acceleration]
    question.max_jerk = [max_jerk]
    ruckig.Ruckig(1).calculate(question, profile)
    return profile
