"""Continuous joints: an arm may report any turn and count turns in any way. It follows as an arm
that starts at 0, and no command jumps by a turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.in_process import Loop, assert_limits_hold, script_hands
from support.turning import CONTINUOUS, NEAR_SEAM, continuous_cell
from thirdhand.contract.records import Cause, Mode, Reason
from thirdhand.core.frame import Vector, order
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings, load
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

TURN = 2.0 * math.pi
Counts = Callable[[Vector], Vector]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return continuous_cell(tmp_path_factory.mktemp("continuous"))


@pytest.fixture(scope="module")
def turns_on(cell: Settings) -> Vector:
    return np.array([float(name in CONTINUOUS) for name in cell.joints.names])


def session(cell: Settings, skill: Skill, counts: Counts, start: Vector) -> Loop:
    """A loop with the hands of a scene, whose arm reports its joints through `counts`."""
    loop = Loop(cell, skill, start)
    loop.hands = script_hands(HandScript(Scene(), seed=3))
    loop.reports = lambda q, dq: (counts(q), dq)
    return loop


def commands(frames: np.ndarray) -> Vector:
    """The commanded joints (T, J)."""
    return np.asarray(frames["joints"][frames["commanded"] != 0])


def wrapped(turns_on: Vector) -> Counts:
    return lambda q: np.where(turns_on > 0, np.mod(q + math.pi, TURN) - math.pi, q)


def counted(q: Vector) -> Vector:
    return q


TICKS = 4000


@pytest.fixture(scope="module")
def reference(cell: Settings, skill: Skill) -> Vector:
    """The commands of an arm that starts at its posture and counts its turns."""
    frames = session(cell, skill, counted, np.array(cell.arm.posture)).run(TICKS)
    assert (frames["mode"][-2000:] == Mode.FOLLOW).all()
    return commands(frames)


def test_task_crosses_the_seam(reference: Vector) -> None:
    """The task moves a joint across its seam."""
    assert reference[:, 0].min() < math.pi - 0.05
    assert reference[:, 0].max() > math.pi + 0.05


@pytest.mark.parametrize(
    ("turns", "how"),
    [
        (0, "counted"),
        (1, "counted"),
        (-3, "counted"),
        (-900, "counted"),
        (0, "wrapped"),
        (40, "wrapped"),
    ],
)
@pytest.mark.one_case
def test_any_turn_is_followed_alike(
    cell: Settings, skill: Skill, turns_on: Vector, reference: Vector, turns: int, how: str
) -> None:
    """An arm in any turn is commanded in that turn, and moves as in the first turn."""
    start = np.array(cell.arm.posture) + TURN * turns * turns_on
    counts = counted if how == "counted" else wrapped(turns_on)
    frames = session(cell, skill, counts, start).run(TICKS)
    sent = commands(frames)
    np.testing.assert_allclose(sent[0], counts(start), atol=1e-3)
    assert_limits_hold(frames, cell)
    in_turn = sent - TURN * np.rint((sent - reference) / TURN)
    # rounding depends on the turn, and accumulates
    np.testing.assert_allclose(in_turn, reference, atol=1e-3)
    assert np.ptp(np.rint((sent - reference) / TURN), axis=0).max() == 0.0
    assert not frames["rejected"][-1].any()


def test_turn_reported_after_silence_counts(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    """After a silence, an arm is commanded in the turn that it then reports."""
    loop = session(cell, skill, counted, np.array(cell.arm.posture) + TURN * turns_on)
    loop.run(600)
    loop.run(201, {200: order("reset")}, every=0)
    loop.joints = loop.joints - TURN * turns_on  # the arm was switched off, and counts from 0
    loop.speed[:] = 0.0
    sent = commands(loop.run(500))
    assert len(sent) > 300
    np.testing.assert_allclose(sent[0][0], NEAR_SEAM, atol=0.3)
    assert (np.abs(np.diff(sent, axis=0)) < 0.01).all()


def test_allowed_silence_turns_nothing(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    """A silence of the longest accepted duration changes no turn."""
    # start beyond the seam
    loop = session(cell, skill, wrapped(turns_on), np.array(cell.arm.posture) + 0.05)
    loop.joints[0] = math.pi + 0.01
    for k in range(1500):
        loop.step(is_heard=k <= 300 or k % 50 == 0)
    assert (loop.frames["mode"] != Mode.FAULT).all()
    assert (np.abs(np.diff(commands(loop.frames), axis=0)) < 0.01).all()


def test_jump_of_a_turn_is_none(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    """A jump by a whole turn is ignored, one by half a turn is rejected."""
    loop = session(cell, skill, counted, np.array(cell.arm.posture))
    loop.run(200)
    before = loop.controller.state["measured"].copy()
    for turned, rejected in ((TURN, 0), (-3 * TURN, 0), (math.pi, 1)):
        loop.reports = lambda q, dq, turned=turned: (q + turned * turns_on, 0.0 * dq)
        loop.step()
        state = loop.controller.state
        assert int(state["rejected"][Cause.JUMPED]) == rejected
        np.testing.assert_allclose(state["measured"], before, atol=0.01)


def test_narrow_limits_hold_in_their_turn(tmp_path: Path, skill: Skill) -> None:
    """Narrow limits of a continuous joint apply to the turn in which they are configured."""
    cell = continuous_cell(tmp_path)
    text = (tmp_path / "cell.toml").read_text(encoding="utf-8")
    limits = "lower = [2.0, -6.0, -3.0, -6.0, -6.0, -6.0]\nupper = [4.0, 6.0, 3.0, 6.0, 6.0, 6.0]"
    (tmp_path / "cell.toml").write_text(
        text.replace("[joints]", f"[joints]\n{limits}"), encoding="utf-8"
    )
    narrow = load(tmp_path / "cell.toml")
    assert narrow.joints.lower[0] == 2.0
    assert cell.joints.lower[0] == -6000.0
    posture = np.array(narrow.arm.posture)
    sent = commands(session(narrow, skill, counted, posture).run(2000))
    assert (sent[:, 0] >= 2.0).all()
    assert (sent[:, 0] <= 4.0).all()
    other = session(narrow, skill, counted, posture - [TURN, 0, 0, 0, 0, 0]).run(200)
    assert int(other["reason"][-1]) == Reason.ARM_NOT_READY
    assert int(other["rejected"][-1][Cause.OUT_OF_RANGE]) > 0
