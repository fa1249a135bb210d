"""Joints that turn on and on: whatever turn an arm reports, and however it counts turns, it follows
as one that starts at 0, and no command ever jumps by a turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.contract.messages import JointState
from service.contract.records import Cause, Mode, Reason
from service.core.arm.stage import Arm
from service.core.controller import Controller
from service.core.frame import Event, Frame, Tick, Vector, order
from service.core.geometry import quaternion_of
from service.core.skill.skill import Skill
from service.core.way_out import WayOut
from service.settings.config import Settings, load, robot_description
from sim.closed_loop import hand_event, joints_event
from sim.scene import Scene
from sim.script import HandScript
from support.turning import CONTINUOUS, NEAR_SEAM, continuous_cell

TURN = 2.0 * math.pi
Counts = Callable[[Vector], Vector]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return continuous_cell(tmp_path_factory.mktemp("continuous"))


@pytest.fixture(scope="module")
def turns_on(cell: Settings) -> Vector:
    return np.array([float(name in CONTINUOUS) for name in cell.joints.names])


class Session:
    """A controller and an arm that is where it was commanded; it reports its joints as `counts`
    says.
    """

    def __init__(self, cell: Settings, skill: Skill, counts: Counts, start: Vector) -> None:
        self.cell, self.counts, self.joints, self.speed = cell, counts, start, np.zeros(len(start))
        self.controller = Controller(cell, skill, urdf=robot_description(cell))
        self.script, self.tick, self.frames = HandScript(Scene(), seed=3), 0, list[Frame]()
        self.commands: list[Vector] = []

    def step(self, *, silent: bool = False, more: tuple[Event, ...] = ()) -> Frame:
        stamp_ns, t = (self.tick + 1) * 2_000_000, max(0.0, self.tick * 0.002 - 1.5)
        inbox = list(more)
        if self.tick % 5 == 0:
            poses = [tuple(pose[:3].tolist()) for pose in self.script.sample(t)]
            inbox += [hand_event(side, pose, stamp_ns) for side, pose in zip(("left", "right"), poses, strict=True)]
        if not silent:
            seen = tuple(self.counts(self.joints).tolist())
            inbox.append(joints_event(self.cell.joints.names, seen, tuple(self.speed.tolist()), stamp_ns))
        frame = self.controller.step(Tick(self.tick, tuple(inbox)))
        self.tick += 1
        self.frames.append(frame)
        if frame["commanded"]:
            self.joints, self.speed = frame["joints"].copy(), frame["joint_velocities"].copy()
            self.commands.append(self.joints)
        return frame

    def run(self, seconds: float) -> Vector:
        """The commands (T, J) of a session of some length."""
        for _ in range(round(seconds / 0.002)):
            self.step()
        return np.array(self.commands)


def wrapped(turns_on: Vector) -> Counts:
    return lambda q: np.where(turns_on > 0, np.mod(q + math.pi, TURN) - math.pi, q)


def counted(q: Vector) -> Vector:
    return q


SECONDS = 8.0


@pytest.fixture(scope="module")
def reference(cell: Settings, skill: Skill) -> Vector:
    """The commands of an arm that starts at its posture and counts its turns."""
    session = Session(cell, skill, counted, np.array(cell.arm.posture))
    commands = session.run(SECONDS)
    assert {int(one["mode"]) for one in session.frames[-2000:]} == {Mode.FOLLOW}
    return commands


def test_the_task_takes_a_joint_over_the_seam(reference: Vector) -> None:
    assert reference[:, 0].min() < math.pi - 0.05
    assert reference[:, 0].max() > math.pi + 0.05


@pytest.mark.parametrize(
    ("turns", "how"),
    [(0, "counted"), (1, "counted"), (-3, "counted"), (-900, "counted"), (0, "wrapped"), (40, "wrapped")],
)
def test_an_arm_in_any_turn_is_commanded_in_its_own_and_goes_as_from_the_first(
    cell: Settings, skill: Skill, turns_on: Vector, reference: Vector, turns: int, how: str
) -> None:
    start = np.array(cell.arm.posture) + TURN * turns * turns_on
    counts = counted if how == "counted" else wrapped(turns_on)
    session = Session(cell, skill, counts, start)
    commands = session.run(SECONDS)
    np.testing.assert_allclose(commands[0], counts(start), atol=1e-3)
    moved = np.abs(np.diff(commands, axis=0)) / cell.period_s
    assert (moved <= np.array(cell.joints.velocity) * (1 + 1e-6)).all()
    in_turn = commands - TURN * np.rint((commands - reference) / TURN)
    np.testing.assert_allclose(in_turn, reference, atol=1e-4)
    assert np.ptp(np.rint((commands - reference) / TURN), axis=0).max() == 0.0
    assert not session.frames[-1]["rejected"].any()


def test_after_a_silence_an_arm_is_commanded_in_the_turn_that_it_reports_then(
    cell: Settings, skill: Skill, turns_on: Vector
) -> None:
    session = Session(cell, skill, counted, np.array(cell.arm.posture) + TURN * turns_on)
    session.run(1.2)
    for _ in range(200):
        session.step(silent=True)
    session.step(silent=True, more=(order("reset"),))
    session.joints = session.joints - TURN * turns_on  # it was switched off, and counts from 0
    session.speed[:] = 0.0
    first = len(session.commands)
    session.run(1.0)
    commands = np.array(session.commands[first:])
    assert len(commands) > 300
    np.testing.assert_allclose(commands[0][0], NEAR_SEAM, atol=0.3)
    assert (np.abs(np.diff(commands, axis=0)) < 0.01).all()


def test_a_silence_of_just_as_long_as_is_allowed_turns_nothing(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    session = Session(cell, skill, wrapped(turns_on), np.array(cell.arm.posture) + 0.05)  # beyond the seam
    session.joints[0] = math.pi + 0.01
    for k in range(1500):
        session.step(silent=k > 300 and k % 50 != 0)
    assert Mode.FAULT not in {int(one["mode"]) for one in session.frames}
    assert (np.abs(np.diff(np.array(session.commands), axis=0)) < 0.01).all()


def test_half_a_turn_from_the_posture_no_joint_swings(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    start = np.array(cell.arm.posture)
    start[5] += math.pi  # the flange's turn is free
    session = Session(cell, skill, counted, start)
    session.script = HandScript(Scene(), seed=3)
    for _ in range(700):
        session.step()
    speeds = np.array([frame["joint_velocities"][5] for frame in session.frames[300:]])
    assert np.abs(np.diff(np.sign(speeds))).sum() <= 4.0
    assert np.abs(speeds).max() < 0.5


def test_a_jump_of_a_turn_is_none_and_one_of_half_a_turn_is(cell: Settings, skill: Skill, turns_on: Vector) -> None:
    session = Session(cell, skill, counted, np.array(cell.arm.posture))
    session.run(0.4)
    names = cell.joints.names
    before = session.controller.state["measured"].copy()
    for turned, rejected in ((TURN, 0), (-3 * TURN, 0), (math.pi, 1)):
        position = session.joints + turned * turns_on
        state = JointState((session.tick + 1) * 2_000_000, names, tuple(position.tolist()), ())
        session.controller.step(Tick(session.tick, (Event("joints/state", b"", state),)))
        session.tick += 1
        found = session.controller.state
        assert int(found["rejected"][Cause.JUMPED]) == rejected
        np.testing.assert_allclose(found["measured"], before, atol=0.01)


def test_narrower_limits_of_a_continuous_joint_hold_in_the_turn_that_they_are_given_for(
    tmp_path: Path, skill: Skill
) -> None:
    cell = continuous_cell(tmp_path)
    text = (tmp_path / "cell.toml").read_text(encoding="utf-8")
    limits = "lower = [2.0, -6.0, -3.0, -6.0, -6.0, -6.0]\nupper = [4.0, 6.0, 3.0, 6.0, 6.0, 6.0]"
    (tmp_path / "cell.toml").write_text(text.replace("[joints]", f"[joints]\n{limits}"), encoding="utf-8")
    narrow = load(tmp_path / "cell.toml")
    assert narrow.joints.lower[0] == 2.0
    assert cell.joints.lower[0] == -6000.0
    session = Session(narrow, skill, counted, np.array(narrow.arm.posture))
    commands = session.run(4.0)
    assert (commands[:, 0] >= 2.0).all()
    assert (commands[:, 0] <= 4.0).all()
    other = Session(narrow, skill, counted, np.array(narrow.arm.posture) - [TURN, 0, 0, 0, 0, 0])
    other.run(0.4)
    assert int(other.frames[-1]["reason"]) == Reason.ARM_NOT_READY
    assert int(other.frames[-1]["rejected"][Cause.OUT_OF_RANGE]) > 0


def test_a_way_out_stays_within_half_a_turn(cell: Settings, turns_on: Vector) -> None:
    finder = WayOut(cell, robot_description(cell))
    arm, hands = Arm(cell, robot_description(cell)), np.full((2, 3), 5.0)
    for turns in (0, 7, -500):
        start = np.array(cell.arm.posture) + TURN * turns * turns_on
        target = arm.at(start + np.array([0.8, 0.1, 0.1, 0.0, 0.0, 0.0]))
        turned = np.empty(4)
        quaternion_of(target.rotation, turned)
        path = finder.find(start, target.position, turned, hands)
        assert path
        assert np.abs(np.array(path) - start).max() <= math.pi + 1e-9
