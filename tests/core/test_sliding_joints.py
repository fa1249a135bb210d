"""An arm on a rail: kinematics, separation and every limit in metres; and joints beyond the plate,
which never matter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from service.contract.records import Cause, Mode, Reason
from service.core.arm.stage import Arm
from service.core.controller import Controller
from service.core.frame import Tick
from service.core.geometry import place
from service.core.separation.body import body_of
from service.core.separation.stage import Separation
from service.core.skill.skill import Skill
from service.files.recording import Recorder
from service.files.replay import replay
from service.settings.config import Settings, robot_description
from sim.closed_loop import hand_event, joints_event
from sim.scene import Scene
from sim.script import HandScript
from support.in_process import LEFT, RIGHT
from support.turning import ARMS, BEYOND, cell_in, sliding_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return sliding_cell(tmp_path_factory.mktemp("sliding"))


def test_units_and_limits_are_those_of_the_description(cell: Settings) -> None:
    joints = cell.joints
    assert joints.kinds == ("prismatic", *("revolute",) * 6)
    assert (joints.units[0], joints.lower[0], joints.upper[0]) == ("m", -0.3, 0.3)


def test_the_body_moves_as_the_links_do(cell: Settings) -> None:
    urdf = robot_description(cell)
    body, model = body_of(cell, urdf), pin.buildModelFromXML(urdf)
    data, rng = model.createData(), np.random.default_rng(2)
    for _ in range(20):
        q = rng.uniform(cell.joints.lower, cell.joints.upper)
        pin.forwardKinematics(model, data, q)
        placed = np.empty((len(body.capsules), 2, 3))
        place(q, body.frames, body.axes, body.capsules, placed)
        for capsule, ends in zip(body.capsules, placed, strict=True):
            joint = data.oMi[int(capsule["link"])]
            np.testing.assert_allclose(ends, [joint.act(end) for end in capsule["ends"]], atol=1e-9)


def test_no_part_is_faster_than_its_bound(cell: Settings) -> None:
    body, rng = body_of(cell, robot_description(cell)), np.random.default_rng(3)
    ends = np.empty((2, len(body.capsules), 2, 3))
    for _ in range(300):
        q = rng.uniform(cell.joints.lower, cell.joints.upper)
        velocity = np.array(cell.joints.velocity) * rng.choice([-1.0, 1.0], len(q))
        for out, at in zip(ends, (q, q + 1e-6 * velocity), strict=True):
            place(at, body.frames, body.axes, body.capsules, out)
        speed = np.linalg.norm(ends[1] - ends[0], axis=2).max(axis=1) / 1e-6
        assert (speed <= body.capsules["max_speed"] * (1 + 1e-4)).all()


def test_separation_s_rows_are_the_speed_of_the_nearest_points(cell: Settings) -> None:
    urdf = robot_description(cell)
    arm, separation, rng = Arm(cell, urdf), Separation(cell, urdf), np.random.default_rng(4)
    for _ in range(50):
        q = np.array(cell.arm.posture) + rng.uniform(-0.2, 0.2, 7)
        hand = arm.at(q).position + rng.uniform(-0.2, 0.2, 3) + [0.0, 0.0, 0.3]
        velocity, step_s = rng.uniform(-0.3, 0.3, 7), 1e-5
        hands = np.array([hand])
        before, part, _ = separation.clearance(q, hands)
        after, same, _ = separation.clearance(q + step_s * velocity, hands)
        if part == same and before > 0.05:
            assert abs(after - before) <= step_s * separation.max_speed


def session(cell: Settings, skill: Skill, path: Path | None = None, *, ticks: int = 3500) -> np.ndarray:
    """The frames of a session with hands that move, and an arm that is where it was commanded."""
    controller = Controller(cell, skill, urdf=robot_description(cell))
    script, frames = HandScript(Scene(), seed=3), []
    joints, speed = cell.arm.posture, (0.0,) * 7
    recorder = path and Recorder(path, settings=cell, skill=skill.file, state=controller.state)
    for k in range(ticks):
        stamp_ns, inbox = (k + 1) * 2_000_000, []
        if k % 5 == 0:
            poses = [tuple(pose[:3].tolist()) for pose in script.sample(max(0.0, k * 0.002 - 1.5))]
            inbox = [hand_event(side, pose, stamp_ns) for side, pose in zip(("left", "right"), poses, strict=True)]
        tick = Tick(k, (*inbox, joints_event(cell.joints.names, joints, speed, stamp_ns)))
        frame = controller.step(tick)
        if recorder:
            recorder.write(tick, frame, time_ns=stamp_ns)
        if frame["commanded"]:
            joints, speed = tuple(frame["joints"].tolist()), tuple(frame["joint_velocities"].tolist())
        frames.append(frame)
    if recorder:
        recorder.close()
    return np.array(frames)


def test_it_follows_with_every_limit_held_and_replays(cell: Settings, skill: Skill, tmp_path: Path) -> None:
    seen = session(cell, skill, tmp_path / "a.mcap")
    assert (seen["mode"][1000:] == Mode.FOLLOW).all()
    limits, sent = cell.joints, seen[seen["commanded"] != 0]
    assert np.ptp(sent["joints"], axis=0)[0] > 0.05, "the rail is not used"
    assert (sent["joints"] >= limits.lower).all()
    assert (sent["joints"] <= limits.upper).all()
    assert (np.abs(sent["joint_velocities"]) <= limits.velocity).all()
    assert (np.abs(sent["joint_accelerations"]) <= np.array(limits.acceleration) * (1 + 1e-9)).all()
    jerk = np.abs(np.diff(sent["joint_accelerations"], axis=0)) / cell.period_s
    assert (jerk <= np.array(limits.jerk) * (1 + 1e-6)).all()
    off_mm = 1000 * np.linalg.norm(seen["tool"] - seen["setpoint"], axis=1)[1000:]
    assert np.sqrt(np.mean(off_mm**2)) < 1.0, off_mm.max()
    assert replay(tmp_path / "a.mcap").text() == "3500 ticks, 3500 frames identical"


@pytest.mark.parametrize(("off_m", "reason"), [(0.04, Reason.NONE), (0.06, Reason.ARM_ERROR)])
def test_a_rail_that_does_not_follow_is_a_fault(cell: Settings, skill: Skill, off_m: float, reason: Reason) -> None:
    controller, names = Controller(cell, skill, urdf=robot_description(cell)), cell.joints.names
    joints = cell.arm.posture
    for k in range(300):
        stamp_ns = (k + 1) * 2_000_000
        pushed = (joints[0] + off_m * max(0, k - 200) / 100, *joints[1:])
        hands = (hand_event("left", LEFT, stamp_ns), hand_event("right", RIGHT, stamp_ns)) if k % 5 == 0 else ()
        frame = controller.step(Tick(k, (*hands, joints_event(names, pushed, (0.0,) * 7, stamp_ns))))
        if frame["commanded"]:
            joints = tuple(frame["joints"].tolist())
    assert int(frame["reason"]) == reason


@pytest.mark.parametrize(
    ("rail_m", "cause"), [(0.2, None), (0.38, None), (0.42, Cause.OUT_OF_RANGE), (200.0, Cause.OUT_OF_RANGE)]
)
def test_a_rail_outside_its_limits_is_brought_back_or_refused(
    cell: Settings, skill: Skill, rail_m: float, cause: Cause | None
) -> None:
    controller, names = Controller(cell, skill, urdf=robot_description(cell)), cell.joints.names
    joints, fastest = (rail_m, *cell.arm.posture[1:]), 0.0
    for k in range(1500):
        frame = controller.step(Tick(k, (joints_event(names, joints, (0.0,) * 7, (k + 1) * 2_000_000),)))
        if frame["commanded"]:
            joints = tuple(frame["joints"].tolist())
            fastest = max(fastest, float(np.abs(frame["joint_velocities"]).max()))
    if cause is None:
        assert not frame["rejected"].any()
        assert joints[0] <= 0.3
        assert fastest <= 0.06
    else:
        assert int(frame["rejected"][cause]) == 1500


def test_joints_beyond_the_plate_change_nothing(tmp_path: Path) -> None:
    plain = (ARMS / "ur5.urdf").read_text(encoding="utf-8")
    cells = []
    for name, urdf in (("plain", plain), ("more", plain.replace("</robot>", BEYOND + "</robot>"))):
        (tmp_path / name).mkdir()
        cells.append(cell_in(tmp_path / name, urdf))
    assert cells[0].joints == cells[1].joints
    arms = [Arm(one, robot_description(one)) for one in cells]
    q = np.array(cells[0].arm.posture) + 0.1
    np.testing.assert_array_equal(arms[0].at(q).jacobian, arms[1].at(q).jacobian)
    assert len(body_of(cells[1], robot_description(cells[1])).capsules) > 5
