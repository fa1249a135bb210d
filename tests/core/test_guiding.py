"""An arm that is led by hand: no fault, an operator's hold, and a start from where it was led."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.in_process import ASSUMED, LEFT, RIGHT, Loop, assert_limits_hold, assert_replays
from thirdhand.contract import cdr
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.codes import HELD_SEEN, HELD_UNSEEN
from thirdhand.core.frame import Event, order
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings

CELL = Settings()
LED_RAD = 0.4  # four times the difference at which an arm that is not guided is at fault


def guided(led: bool) -> Event:
    return Event("joints/guided", cdr.encode_bool(led), led)


def lead(loop: Loop, ticks: int, by: float = LED_RAD, *, is_reported: bool = True) -> np.ndarray:
    """The frames while a person moves two joints of the arm, by the angle `by` [rad] each."""
    start = loop.joints.copy()
    shape = np.array([1.0, 0, 0, -1.0, 0, 0, 0])
    for k in range(ticks):
        loop.joints = start + by * shape * (0.5 - 0.5 * np.cos(np.pi * (k + 1) / ticks))
        loop.speed = by * shape * 0.5 * np.pi * np.sin(np.pi * (k + 1) / ticks) / (0.002 * ticks)
        loop.step(*((guided(True),) if is_reported else ()))
    loop.speed = 0.0 * start
    return loop.frames[-ticks:]


@pytest.mark.parametrize("first", ["a hold", "nothing"])
def test_led_arm_holds_and_starts_where_left(taught: Skill, tmp_path: Path, first: str) -> None:
    loop = Loop(CELL, taught)
    assert loop.run(1500)["mode"][-1] == Mode.FOLLOW
    if first == "a hold":
        assert loop.run(200, {0: order("hold")})["reason"][-1] == Reason.OPERATOR
    held_at = loop.index if first == "nothing" else loop.index - 200
    led = lead(loop, 800)
    assert (led["reason"] == Reason.GUIDED).all()
    assert not led["commanded"][200:].any()  # before, an arm that followed stops
    # the frame has the joints of the led arm
    np.testing.assert_allclose(led["joints"][-1], loop.joints, atol=1e-2)
    ended = loop.run(300, {0: guided(False)})
    assert (ended["reason"][100:] == Reason.OPERATOR).all()
    assert (np.abs(ended["joints"][100:] - loop.joints) < 1e-9).all()
    state = loop.controller.state
    assert (state["held"], state["held_tick"]) == (HELD_SEEN, held_at)
    np.testing.assert_allclose(state["held_hands"], (LEFT, RIGHT), atol=1e-3)

    resumed = loop.run(1500, {0: order("resume")})
    assert (resumed["mode"] == Mode.FOLLOW).all()
    speeds = np.linalg.norm(np.diff(resumed["tool"], axis=0), axis=1) / CELL.period_s
    is_engaging = (resumed["flags"][1:] & int(Flag.ENGAGING)) > 0
    assert is_engaging.sum() > 50
    assert 0.1 < speeds[is_engaging].max() < 1.1 * CELL.tool.engage_speed
    assert np.linalg.norm(resumed["tool"][-1] - resumed["target"][-1]) < 2e-3
    assert_limits_hold(resumed)
    assert not loop.controller.state["held"]
    assert_replays(tmp_path / "led.mcap", CELL, taught, loop.steps)


def test_led_arm_without_report_is_a_fault(taught: Skill) -> None:
    loop = Loop(CELL, taught)
    loop.run(700, {500: order("hold")})
    assert lead(loop, 800, is_reported=False)["reason"][-1] == Reason.ARM_ERROR


def test_hold_knows_hands_that_were_seen(taught: Skill) -> None:
    loop = Loop(CELL, taught)
    loop.hands = None
    loop.run(100, {50: order("hold")})
    assert loop.controller.state["held"] == HELD_UNSEEN
    loop.hands = lambda k: np.array((LEFT, RIGHT))
    loop.run(100)
    # hands that appear later do not belong to this hold
    assert loop.controller.state["held"] == HELD_UNSEEN
    loop.run(100, {0: order("resume"), 50: order("hold")})
    assert loop.controller.state["held"] == HELD_SEEN


def test_guiding_ends_when_its_reports_cease(taught: Skill) -> None:
    loop = Loop(CELL, taught)
    loop.run(500)
    lead(loop, 100, 0.05)
    silent = loop.run(200)
    assert (silent["reason"][:49] == Reason.GUIDED).all()  # until 100 ms after the last report
    assert silent["reason"][-1] == Reason.OPERATOR


def test_report_of_guiding_for_assumed_arm(taught: Skill) -> None:
    """A report of guiding changes nothing for an arm that is assumed."""
    loop = Loop(ASSUMED, taught)
    loop.run(200)
    assert (loop.run(100, {k: guided(True) for k in range(100)})["mode"] == Mode.FOLLOW).all()
