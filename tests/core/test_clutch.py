"""The clutch as a dead-man's switch, and a person's wish for the gripper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
import pytest

from support.followed import changed, followed
from support.in_process import ASSUMED, LEFT, RIGHT, Loop, clutch, resting, wish
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.frame import Event, Tick, order
from thirdhand.core.skill.pose import CLOSED, OPEN, UNKNOWN
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene

LOOP_RATES_HZ = (100, 250, 500, 1000)
SENT_HZ = 10
STALE_S = 0.3


def cell(base: Settings = ASSUMED, rate_hz: int = 500, **hands: Any) -> Settings:
    """A cell with a clutch, or with other settings of [hands]."""
    return changed(base, rate_hz=rate_hz, hands=hands or {"clutch": "key"})


def at(events: Mapping[int, Event], every: int = 0) -> Callable[[int], tuple[Event, ...]]:
    """Events by their ticks; before the first one, a pressed clutch is sent at regular
    intervals.
    """
    last = min(events, default=10**9)
    return lambda k: (
        *((clutch(True),) if every and k % every == 0 and k < last else ()),
        *((events[k],) if k in events else ()),
    )


def reasons(settings: Settings, skill: Skill, ticks: list[Tick]) -> np.ndarray:
    frames = followed(skill, ticks, settings)
    assert ((frames["mode"] == Mode.FOLLOW) == (frames["reason"] == Reason.NONE)).all()
    return frames["reason"]


@pytest.mark.parametrize("rate_hz", LOOP_RATES_HZ)
def test_release_holds_at_once(taught: Skill, rate_hz: int) -> None:
    """The arm holds from the tick in which the release arrives."""
    release = rate_hz
    ticks = resting(
        0, 2 * rate_hz, at({release: clutch(False)}, every=rate_hz // SENT_HZ), every=rate_hz // 100
    )
    reason = reasons(cell(rate_hz=rate_hz), taught, ticks)
    assert (reason[:release] == Reason.NONE).all()
    assert (reason[release:] == Reason.CLUTCH).all()


@pytest.mark.parametrize("rate_hz", LOOP_RATES_HZ)
def test_silent_clutch_is_released(taught: Skill, rate_hz: int) -> None:
    pressed = lambda k: (clutch(True),) if k in (0, 10) else ()  # noqa: E731
    reason = reasons(
        cell(rate_hz=rate_hz), taught, resting(0, rate_hz, pressed, every=rate_hz // 100)
    )
    silent = 10 + round(STALE_S * rate_hz)
    assert (reason[:silent] == Reason.NONE).all()
    assert (reason[silent:] == Reason.CLUTCH).all()


def test_missed_deadlines_count_as_silence(taught: Skill) -> None:
    ticks = resting(0, 20, lambda k: (clutch(True),) if k == 0 else ())
    late = [
        Tick(k, tick.inbox)
        for k, tick in zip(range(149, 169), resting(20, 20, every=1), strict=True)
    ]
    reason = reasons(cell(), taught, [*ticks, *late])
    assert (reason[:21] == Reason.NONE).all()  # tick 149 is the last one
    assert (reason[21:] == Reason.CLUTCH).all()


def test_without_a_clutch_messages_change_nothing(taught: Skill) -> None:
    """The settings have no clutch."""
    plain = followed(taught, resting(0, 300))
    chattered = followed(taught, resting(0, 300, lambda k: (clutch(k % 3 == 0), wish(1))))
    assert plain.tobytes() == chattered.tobytes()


def test_reasons_before_the_clutch(taught: Skill) -> None:
    """The reasons `operator` and an arm that is not ready are named before the clutch."""
    loop = Loop(cell(Settings()), taught)
    not_ready = loop.run(20)
    assert (not_ready["reason"] == Reason.ARM_NOT_READY).all()
    assert (loop.run(100)["reason"][-20:] == Reason.CLUTCH).all()
    assert (loop.run(10, {0: order("hold")})["reason"] == Reason.OPERATOR).all()
    assert (loop.run(10, {0: order("resume")})["reason"] == Reason.CLUTCH).all()
    assert (loop.run(50, {0: clutch(True)})["reason"] == Reason.NONE).all()


def test_return_needs_a_pressed_clutch(taught: Skill) -> None:
    """An arm outside its limits returns only while the clutch is pressed."""
    settings = cell(Settings())
    start = np.array(settings.arm.posture)
    start[3] = settings.joints.upper[3] + 0.02
    loop = Loop(settings, taught, start=start)
    released = loop.run(200)
    assert not released["joint_velocities"].any()
    pressed = loop.run(400, {k: clutch(True) for k in range(0, 400, 50)})
    assert (pressed["reason"][:20] == Reason.ARM_NOT_READY).all()
    assert pressed["joints"][-1, 3] < settings.joints.upper[3]


def gripper(settings: Settings, skill: Skill, events: Mapping[int, Event]) -> list[int]:
    """The gripper's state in each tick while the hands rest at a via-point."""
    return followed(skill, resting(0, 900, at(events)), settings)["gripper"].tolist()


def test_wish_decides_gripper_without_skill(taught: Skill) -> None:
    """Wishes have the hysteresis and the pause of a skill's decisions, and no effect while the arm
    holds.
    """
    wishes = cell(gripper="key")
    events = {50: wish(0.2), 350: wish(0.7), 400: wish(0.95), 420: wish(0.0)}
    states = gripper(wishes, taught, events)
    assert [states[k] for k in (49, 50, 399, 400, 420, 649)] == [
        UNKNOWN,
        OPEN,
        OPEN,
        CLOSED,
        CLOSED,
        CLOSED,
    ]
    assert states[650:] == [OPEN] * 250  # half a second after it began to close
    held = gripper(
        wishes, taught, {50: wish(0.2), 390: order("hold"), 400: wish(1.0), 500: order("resume")}
    )
    assert held[50:500] == [OPEN] * 450
    assert held[500:] == [CLOSED] * 400


def test_skill_decides_its_gripper_alone(skill: Skill) -> None:
    """Wishes have no effect on a skill with a gripper."""
    first, *more = Scene().via_points()
    point = msgspec.structs.replace(first, left=LEFT, right=RIGHT, gripper="closed")
    closing = adapted(skill, (point, *more), tolerance=0.05)
    wishes = cell(gripper="key")
    alone = followed(closing, resting(0, 300), wishes)
    assert alone["closure"][-1] >= 0.0
    wished = followed(closing, resting(0, 300, lambda k: (wish(k % 2),)), wishes)
    assert alone.tobytes() == wished.tobytes()
