"""Foreign publishers of joint states: whatever they send, no command jumps, and the arm that was
heard first is not locked out.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from support.in_process import Loop, arm, assert_limits_hold, stamp_ns
from thirdhand.contract.records import Cause, Mode, Reason
from thirdhand.core.frame import Event, order
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings

SETTINGS = Settings()
POSTURE = SETTINGS.arm.posture
ELSEWHERE = (POSTURE[0] + 1.2, *POSTURE[1:])
HOUR_NS = 3600 * 10**9
LOWER = np.array(SETTINGS.joints.lower)
UPPER = np.array(SETTINGS.joints.upper)
MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "10"))


def rejected(loop: Loop) -> dict[Cause, int]:
    """The number of rejected samples by cause."""
    return {
        cause: int(n) for cause, n in zip(Cause, loop.steps[-1][1]["rejected"], strict=True) if n
    }


@pytest.mark.parametrize("ahead_ns", [10**9, HOUR_NS])
@pytest.mark.parametrize("posture", [POSTURE, ELSEWHERE])
def test_one_state_ahead_changes_nothing(
    skill: Skill, ahead_ns: int, posture: tuple[float, ...]
) -> None:
    """A single state with a stamp ahead causes no fault, no motion and no later rejection."""
    loop = Loop(SETTINGS, skill)
    loop.run(500, every=5)
    frames = loop.run(
        1000, {3: arm(posture, stamp_ns(503) + ahead_ns), 200: order("reset")}, every=5
    )
    assert set(frames["reason"].tolist()) == {Reason.NONE}
    assert rejected(loop) == {Cause.AHEAD: 1}
    assert_limits_hold(loop.frames)


def test_state_ahead_is_no_start_after_reset(skill: Skill) -> None:
    """The attack: a fault, then a foreign posture with a stamp an hour ahead, then `reset`."""
    loop = Loop(SETTINGS, skill)
    loop.run(500, every=5)
    shifted_rad = tuple(q + 0.15 for q in loop.joints)
    fault = loop.run(
        300, {k: arm(shifted_rad, stamp_ns(500 + k)) for k in range(0, 300, 5)}, every=0
    )
    assert fault["reason"][-1] == Reason.ARM_ERROR
    frames = loop.run(
        600, {10: arm(ELSEWHERE, stamp_ns(810) + HOUR_NS), 11: order("reset")}, every=5
    )
    assert frames["mode"][-1] == Mode.FOLLOW
    assert np.abs(frames["joints"][:, 0] - loop.frames[799]["joints"][0]).max() < 0.2
    assert_limits_hold(frames)
    assert rejected(loop)[Cause.AHEAD] == 1


@pytest.mark.parametrize("every", [5, 2])
def test_two_arms_in_turns_are_not_ready(skill: Skill, every: int) -> None:
    """Two alternating arms do not count as ready."""
    loop = Loop(SETTINGS, skill)
    frames = loop.run(
        2000, {k: arm(ELSEWHERE, stamp_ns(k) + 1) for k in range(0, 2000, every)}, every=5
    )
    assert not frames["commanded"].any()
    assert frames["reason"][-1] == Reason.TWO_SOURCES
    assert rejected(loop)[Cause.JUMPED] > 300


def test_second_arm_is_refused_while_following(skill: Skill) -> None:
    """The service holds until the second arm ends."""
    loop = Loop(SETTINGS, skill)
    loop.run(500, every=5)
    frames = loop.run(
        1500, {k: arm(ELSEWHERE, stamp_ns(500 + k) + 1) for k in range(0, 1500, 5)}, every=5
    )
    assert set(frames["reason"].tolist()) == {Reason.NONE, Reason.TWO_SOURCES}
    assert frames["commanded"].all()
    assert np.abs(frames["joints"] - frames["joints"][0]).max() < 0.1
    after = loop.run(1500, every=5)
    assert after["mode"][-1] == Mode.FOLLOW
    assert_limits_hold(loop.frames)


def test_joint_that_jumps_is_refused_then_faults(skill: Skill) -> None:
    """A joint that jumps is refused; after the time that makes an arm silent, it is a fault."""
    loop = Loop(SETTINGS, skill)
    loop.run(1000, every=5)
    other = (loop.joints[0] - 1.2, *loop.joints[1:])
    frames = loop.run(200, {k: arm(other, stamp_ns(1000 + k)) for k in range(0, 200, 5)}, every=0)
    assert set(frames["reason"][:45].tolist()) == {Reason.NONE}
    assert set(frames["reason"][45:].tolist()) == {Reason.ARM_ERROR}
    assert not frames["commanded"][-1]
    assert_limits_hold(frames)


@pytest.mark.parametrize(
    ("joint", "value"), [(0, 2.6 + 0.15), (3, -0.9 - 0.05), (5, 1.5707 + 1e-4)]
)
def test_arm_outside_limits_is_brought_back(skill: Skill, joint: int, value: float) -> None:
    """An arm a little outside its limits is brought back and then followed."""
    start = list(POSTURE)
    start[joint] = value
    loop = Loop(SETTINGS, skill, tuple(start))
    frames = loop.run(1800, every=5)
    sent = frames[frames["commanded"] == 1]
    assert np.abs(sent["joints"][0] - start).max() < 1e-3
    assert_limits_hold(frames)
    outside = ((sent["joints"] < LOWER) | (sent["joints"] > UPPER)).any(axis=1)
    assert set(sent["reason"][outside].tolist()) == {Reason.ARM_NOT_READY}
    assert np.abs(sent["joint_velocities"][outside]).max() < 0.11
    assert (
        np.diff(np.maximum(sent["joints"] - UPPER, LOWER - sent["joints"])[outside][60:, joint]) < 0
    ).all()
    assert frames["mode"][-1] == Mode.FOLLOW


def test_hold_stops_the_return(skill: Skill) -> None:
    """An operator's hold stops the return, and its end continues it."""
    loop = Loop(SETTINGS, skill, (2.75, *POSTURE[1:]))
    loop.run(300, every=5)
    held = loop.run(500, {0: order("hold")}, every=5)
    assert np.abs(held["joint_velocities"][100:]).max() == 0.0
    assert held["joints"][-1, 0] > 2.6
    frames = loop.run(1500, {0: order("resume")}, every=5)
    assert frames["mode"][-1] == Mode.FOLLOW
    assert_limits_hold(loop.frames)


@pytest.mark.parametrize("value", [2.81, -2.81, 6.0])
def test_arm_far_outside_is_never_commanded(skill: Skill, value: float) -> None:
    """An arm far outside its limits is never commanded."""
    loop = Loop(SETTINGS, skill, (value, *POSTURE[1:]))
    frames = loop.run(400, every=5)
    assert not frames["commanded"].any()
    assert set(frames["reason"].tolist()) == {Reason.ARM_NOT_READY}
    assert rejected(loop) == {Cause.OUT_OF_RANGE: 80}


def test_moving_arm_is_not_ready(skill: Skill) -> None:
    """An arm is ready once it rests."""
    loop = Loop(SETTINGS, skill)
    moving = {k: arm((POSTURE[0] + 0.001 * k, *POSTURE[1:]), stamp_ns(k)) for k in range(0, 400, 5)}
    assert not loop.run(400, moving, every=0)["commanded"].any()
    loop.joints = np.array((POSTURE[0] + 0.4, *POSTURE[1:]))
    frames = loop.run(200, every=5)
    assert frames["commanded"][-1]
    assert np.abs(frames["joints"][-1] - loop.joints).max() < 0.1


STRANGERS = st.tuples(
    st.integers(1, 12),  # ticks between states of the arm
    st.integers(0, 11),
    st.sampled_from([-HOUR_NS, -3_000_000, 1, 3_000_000, 90_000_000, 10**9, HOUR_NS]),
    st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7),
    st.integers(0, 400),
    st.integers(50, 1200),
)


@example_settings(max_examples=MANY, deadline=None, derandomize=True)
@given(STRANGERS, st.lists(st.integers(0, 1500), max_size=6), st.integers(1, 20))
def test_no_stranger_makes_a_command_jump(
    skill: Skill,
    stranger: tuple[int, int, int, list[float], int, int],
    resets: list[int],
    every: int,
) -> None:
    period, phase, offset_ns, shift_rad, begin, count = stranger
    loop = Loop(SETTINGS, replace(skill, threshold=np.inf))
    other = tuple((np.clip(np.array(POSTURE) + shift_rad, LOWER - 0.1, UPPER + 0.1)).tolist())
    events: dict[int, Event] = {
        k: arm(other, stamp_ns(k) + offset_ns)
        for k in range(begin, begin + count)
        if k % period == phase % period
    }
    loop.run(1600, events | {k: order("reset") for k in resets}, every=every)
    frames = loop.frames
    assert_limits_hold(frames)
    # before a new posture is adopted, it must be the only one for a tenth of a second
    begins = np.flatnonzero(np.diff(frames["commanded"].astype(int)) == 1) + 1
    real = [k for k in range(1600) if k % every == 0]
    for k in begins:
        if (
            np.abs(frames["joints"][k] - other).max()
            < 0.02
            < np.abs(np.array(other) - POSTURE).max()
        ):
            assert not [r for r in real if k - 40 <= r <= k], "adopted while the arm was heard"
