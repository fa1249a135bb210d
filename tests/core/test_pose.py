"""The tool's orientation and the gripper are predicted, limited in speed, followed by the arm, and
sent.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmp import KMP, GaussianKernel, Gaussians, OrientationKMP
from support.followed import changed, followed
from support.in_process import ticks_of
from support.wam import FRAME, URDF
from thirdhand.contract import cdr
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import outgoing
from thirdhand.core.frame import blank, state_layout
from thirdhand.core.geometry import axis_of, quaternion_of, swing, turn_between, turn_on
from thirdhand.core.limiter.stage import Limiter
from thirdhand.core.setpoint.orientation import OrientationSetpoint
from thirdhand.core.skill.pose import CLOSED, NO_GRIPPER, OPEN, UNKNOWN, LearnedOrientation, decided
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.tuning import GRIPPER_MOVES_S
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import Settings
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import TOOL_ORIENTATION, Scene
from thirdhand_sim.script import HandScript

PLANNED_SPEED_SHARE = TUNING.arm.planned_limit_shares[0]


PERIOD_S = 0.002
FASTEST = Settings().tool.max_turn_speed
HARDEST = Settings().tool.max_turn_acceleration


def random_rotations(count: int, seed: int) -> Rotation:
    return Rotation.random(count, random_state=np.random.default_rng(seed))


def test_rotations_are_those_of_scipy() -> None:
    for rotation, other in zip(random_rotations(50, 1), random_rotations(50, 2), strict=True):
        a = np.empty(4)
        b = np.empty(4)
        turn = np.empty(3)
        axis = np.empty(3)
        quaternion_of(rotation.as_matrix(), a)
        quaternion_of(other.as_matrix(), b)
        assert abs(a @ rotation.as_quat()) == pytest.approx(1.0, abs=1e-8)
        turn_between(a, b, turn)
        np.testing.assert_allclose(turn, (other * rotation.inv()).as_rotvec(), atol=1e-7)
        axis_of(a, axis)
        np.testing.assert_allclose(axis, rotation.as_matrix()[:, 2], atol=1e-8)
        to = other.as_matrix()[:, 2].copy()
        swing(axis, b, turn)
        np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(axis), to, atol=1e-7)
        turn_on(a, turn)
        assert abs(a @ (Rotation.from_rotvec(turn) * rotation).as_quat()) == pytest.approx(
            1.0, abs=1e-8
        )


def test_learned_orientation_is_that_of_kmp() -> None:
    """Orientation and angular velocity equal those of kmp."""
    random = np.random.default_rng(3)
    inputs = random.normal(size=(12, 6))
    zeta = 0.5 * random.normal(size=(12, 3))
    reference = Gaussians.of(zeta, deviation=0.01)
    primitive = KMP.fit(inputs, reference, kernel=GaussianKernel(0.3), lambda_mean=1.0)
    auxiliary = random_rotations(1, 4)[0].as_quat()
    ours = LearnedOrientation(primitive, auxiliary)
    kmp = OrientationKMP(primitive, auxiliary)
    for query, velocity in zip(inputs + 0.1, random.normal(size=(12, 6)), strict=True):
        prediction = ours.predict(query, velocity)
        mean, covariance = kmp.predict(query[None])
        assert abs(prediction.orientation @ mean[0]) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(
            prediction.velocity,
            kmp.predict_motion(query, velocity, 0 * velocity).velocity,
            atol=2e-5,
        )
        np.testing.assert_allclose(
            prediction.covariance, covariance[0], atol=1e-8 + 1e-4 * np.abs(covariance).max()
        )
        repeated = ours.predict(query, velocity, covariance=prediction.covariance)
        assert repeated.orientation.tobytes() == prediction.orientation.tobytes()
        ahead = Rotation.from_quat(ours.predict(query + 1e-3 * velocity, velocity).orientation)
        turned = (ahead * Rotation.from_quat(prediction.orientation).inv()).as_rotvec() / 1e-3
        np.testing.assert_allclose(
            prediction.velocity, turned, atol=0.05 * np.linalg.norm(turned) + 1e-2
        )


@pytest.mark.parametrize("about", [False, True])
def test_turn_keeps_speed_and_acceleration(about: bool) -> None:
    """An orientation that jumps is approached within speed and acceleration limits."""
    settings = changed(Settings(), tool={"orientation": "full"}) if about else Settings()
    lead = OrientationSetpoint(settings)
    state = blank(state_layout(7))
    lead.begin(state, np.eye(3), np.zeros(3))
    target = Rotation.from_rotvec(math.radians(120) * np.array([1.0, 2.0, 2.0]) / 3.0)
    turnings = []
    for _ in range(2500):
        lead.step(state, target.as_quat(), np.zeros(3))
        turnings.append(state["turning"].copy())
    speeds = np.array(turnings)
    assert np.linalg.norm(speeds, axis=1).max() <= PLANNED_SPEED_SHARE * FASTEST + 1e-6
    assert np.linalg.norm(np.diff(speeds, axis=0), axis=1).max() <= HARDEST * PERIOD_S + 1e-6
    residual = target * Rotation.from_quat(state["orientation"]).inv()
    axis = Rotation.from_quat(state["orientation"]).apply([0, 0, 1.0])
    assert np.linalg.norm(axis - target.apply([0, 0, 1.0])) < 1e-3
    assert (residual.magnitude() < 1e-3) == about  # unless only a direction is followed
    assert np.linalg.norm(speeds[-1]) < 1e-2


def test_full_orientation_costs_no_position() -> None:
    """The arm follows the full orientation if the settings require it."""
    settings = changed(Settings(), tool={"orientation": "full"})
    arm = ArmStage(settings, URDF)
    limiter = Limiter(settings.joints, PERIOD_S)
    q = np.array(settings.arm.posture)
    dq = np.zeros(7)
    ddq = np.zeros(7)
    pose = arm.at(q)
    target = Rotation.from_rotvec([0.3, -0.2, 0.5]) * Rotation.from_matrix(pose.rotation)
    farthest = 0.0
    for _ in range(1500):
        command = arm.step(q, pose.position, np.zeros(3), target.as_quat(), moving=dq)
        q, dq, ddq, _ = limiter.step(q, dq, ddq, command.velocity)
        farthest = max(farthest, float(np.linalg.norm(arm.at(q).position - pose.position)))
    assert (target * Rotation.from_matrix(arm.at(q).rotation).inv()).magnitude() < 0.01
    assert farthest < 5e-4  # the tool stays at its position


def test_taught_orientation_is_followed(skill: Skill) -> None:
    """An orientation taught with a via-point is predicted and followed there."""
    places = Scene().via_points()
    turned = (
        Rotation.from_euler("y", -40, degrees=True) * Rotation.from_quat(TOOL_ORIENTATION)
    ).as_quat()
    x, y, z, w = turned.tolist()
    taught = adapted(
        skill,
        (*places[:2], msgspec.structs.replace(places[2], orientation=(x, y, z, w))),
        tolerance=0.05,
    )
    script = HandScript(
        msgspec.structs.replace(Scene(), dwells_s=(0.4, 0.4, 1.5)), seed=1, offset_std=0.0
    )
    frames = followed(taught, ticks_of(script))
    last = frames[-300:]
    assert np.abs(last["orientation"] @ turned).min() > math.cos(math.radians(1.0))
    axis = Rotation.from_quat(last["tool_orientation"]).apply([0, 0, 1.0])
    assert np.degrees(np.arccos(axis @ Rotation.from_quat(turned).apply([0, 0, 1.0]))).max() < 2.0
    assert np.linalg.norm(last["tool"] - last["setpoint"], axis=1).max() < 1e-3
    turning = np.linalg.norm(frames["setpoint_turning"], axis=1)
    assert 0.1 < turning.max() <= FASTEST
    assert (np.linalg.eigvalsh(last["orientation_covariance"]) >= -1e-12).all()
    assert last["orientation_covariance"].any()


def test_gripper_has_hysteresis() -> None:
    assert decided(UNKNOWN, 0.6) == CLOSED
    assert decided(UNKNOWN, 0.4) == OPEN
    for closure in np.linspace(0.11, 0.89, 20):
        assert decided(OPEN, closure) == OPEN
        assert decided(CLOSED, closure) == CLOSED
    assert decided(OPEN, 0.95) == CLOSED
    assert decided(CLOSED, 0.05) == OPEN
    assert decided(CLOSED, 0.05, since_s=0.5 * GRIPPER_MOVES_S) == CLOSED  # the gripper still moves
    assert decided(CLOSED, 0.05, off=0.05) == CLOSED  # the tool is 5 cm from its target
    assert [decided(state, NO_GRIPPER) for state in (UNKNOWN, OPEN, CLOSED)] == [
        UNKNOWN,
        OPEN,
        CLOSED,
    ]


def test_orientation_and_gripper_are_sent() -> None:
    """Orientation covariance and gripper go out with a frame."""
    frame = blank(FRAME)
    frame["covariance"] = np.eye(3)
    frame["orientation_covariance"] = np.arange(9).reshape(3, 3)
    frame["orientation"] = (0, 0, 0, 1)
    frame["setpoint_orientation"] = (0, 1, 0, 0)
    sent = dict(outgoing(frame, 1, Settings().joints.names))
    assert "gripper/command" not in sent  # this cell has no gripper
    covariance = np.array(cdr.decode_pose_with_covariance(sent["tool/target"]).covariance).reshape(
        6, 6
    )
    np.testing.assert_array_equal(covariance[3:, 3:], np.arange(9).reshape(3, 3))
    assert not covariance[:3, 3:].any()
    assert cdr.decode_pose(sent["tool/setpoint"]).orientation == (0, 1, 0, 0)
    for gripper, position in ((OPEN, 0.0), (CLOSED, 1.0)):
        frame["gripper"] = gripper
        sent = dict(outgoing(frame, 1, Settings().joints.names))
        command = cdr.decode_joints(sent["gripper/command"])
        assert (command.names, command.position) == (("gripper",), (position,))
