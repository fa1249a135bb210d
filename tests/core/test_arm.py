"""The arm's model against published numbers, and its inverse kinematics: accurate, bounded and
without chatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.followed import changed
from support.wam import JOINT_NAMES, URDF
from thirdhand.contract.messages import BASE
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.limiter.stage import Limiter
from thirdhand.settings.config import ArmSettings, Settings

Vector = npt.NDArray[np.float64]

# Denavit-Hartenberg parameters (Spong), from libbarrett's wam7w.conf: alpha [rad], a [m], d [m]
RIGHT = math.pi / 2
DH = (
    (-RIGHT, 0, 0),
    (RIGHT, 0, 0),
    (-RIGHT, 0.045, 0.55),
    (RIGHT, -0.045, 0),
    (-RIGHT, 0, 0.3),
    (RIGHT, 0, 0),
    (0, 0, 0.06),
)
START = np.array([0.45, -0.05, 0.35])  # [m]
AHEAD_AND_DOWN = np.array([1.0, 0.0, -1.0]) / math.sqrt(2.0)
# [rad] joints with the tool at START, pointing ahead and down
POSTURE = (0.1761, 0.8604, -0.5, 2.5414, -0.4273, -1.0823, 0.0)
CELL = Settings(arm=ArmSettings(posture=POSTURE))
LOWER, UPPER, FASTEST = (
    np.array(getattr(CELL.joints, name)) for name in ("lower", "upper", "velocity")
)
STILL = np.zeros(3)
ARM = ArmStage(CELL, URDF)


def facing(direction: Vector) -> Vector:
    """The quaternion (4,) of the smallest rotation of +z to a direction."""
    x, y, z = direction / np.linalg.norm(direction)
    quaternion = np.array([-y, x, 0.0, 1.0 + z])
    return (
        np.asarray(quaternion / np.linalg.norm(quaternion))
        if quaternion.any()
        else np.array([1.0, 0.0, 0.0, 0.0])
    )


AHEAD = facing(AHEAD_AND_DOWN)


def dh_frames(q: Vector) -> list[Vector]:
    """The DH frames 1 to 7 in frame base, (4, 4) each."""
    frame = np.eye(4)
    frame[:3, 3] = CELL.reach.centre
    frames = []
    for theta, (alpha, a, d) in zip(q, DH, strict=True):
        c = math.cos(theta)
        s = math.sin(theta)
        ca = math.cos(alpha)
        sa = math.sin(alpha)
        frame = frame @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
        frames.append(frame)
    return frames


def random_joints(count: int, seed: int) -> Vector:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


class Followed(NamedTuple):
    """The motion along a path: errors (N,) [m], joints (N, 7), their accelerations, and the number
    of steps with a limited speed.
    """

    error: Vector
    position: Vector
    acceleration: Vector
    speed_limited: int


def follow(q: Vector, path: Vector, velocity: Vector, direction: Vector) -> Followed:
    """The tool led along a path (N, 3) with the limiter in the loop, from rest at q."""
    limiter = Limiter(CELL.joints, CELL.period_s)
    dq = np.zeros(7)
    ddq = np.zeros(7)
    errors = []
    joints = []
    accelerations = []
    speed_limited = 0
    for target, speed in zip(path, velocity, strict=True):
        solution = ARM.step(q, target, speed, facing(direction))
        q, dq, ddq, _ = limiter.step(q, dq, ddq, solution.velocity)
        errors.append(math.dist(ARM.at(q).position, target))
        joints.append(q)
        accelerations.append(ddq)
        speed_limited += solution.speed_limited
    return Followed(np.array(errors), np.array(joints), np.array(accelerations), speed_limited)


def wait(q: Vector, target: Vector, direction: Vector, seconds: float) -> Followed:
    ticks = round(seconds / CELL.period_s)
    return follow(q, np.tile(target, (ticks, 1)), np.zeros((ticks, 3)), direction)


def test_forward_kinematics_is_as_published() -> None:
    """Forward kinematics equals the product of the published frames, and gives the published check
    values.
    """
    for q in random_joints(200, seed=1):
        position = ARM.at(q).position
        rotation = ARM.at(q).rotation
        expected = dh_frames(q)[-1]
        assert np.abs(position - expected[:3, 3]).max() < 1e-9
        assert np.abs(rotation - expected[:3, :3]).max() < 1e-9
    assert ARM.at(np.zeros(7)).position == pytest.approx([0, 0, 1.256])
    assert ARM.at(np.array([0, -2, 0, 3.13, 0, 0, 0])).position == pytest.approx(
        [-0.2125, 0, 0.3523], abs=1e-4
    )


def test_tool_sits_on_the_plate() -> None:
    """The tool sits on the plate where the settings say."""
    half = math.sqrt(0.5)
    arm = ArmStage(
        changed(CELL, tool={"plate_from_tool": (0.01, 0.02, 0.1, 0.0, half, 0.0, half)}), URDF
    )
    q = random_joints(1, seed=2)[0]
    plate = dh_frames(q)[-1]
    position = arm.at(q).position
    rotation = arm.at(q).rotation
    assert position == pytest.approx(plate[:3, 3] + plate[:3, :3] @ [0.01, 0.02, 0.1], abs=1e-9)
    assert rotation[:, 2] == pytest.approx(plate[:3, 0], abs=1e-9)


def test_model_agrees_with_wire_and_settings() -> None:
    """Joint names and limits equal those of wire and settings."""
    model = pin.buildModelFromXML(URDF)
    assert tuple(model.names)[1:] == JOINT_NAMES
    assert model.frames[1].name == BASE
    assert "<mesh" not in URDF
    assert np.array_equal(model.lowerPositionLimit, LOWER)
    assert np.array_equal(model.upperPositionLimit, UPPER)
    assert model.effortLimit.tolist() == [60, 60, 45, 30, 10, 10, 10]
    assert model.velocityLimit.tolist() == [2.0] * 7
    assert (model.velocityLimit >= FASTEST).all()


def test_tool_velocity_is_the_derivative() -> None:
    step = 1e-6
    for q, dq in zip(random_joints(50, seed=4), random_joints(50, seed=5), strict=True):
        ahead = ARM.at(q + step * dq).position
        behind = ARM.at(q - step * dq).position
        assert ARM.at(q).tasks[:3] @ dq == pytest.approx((ahead - behind) / (2 * step), abs=1e-7)


def test_position_has_priority_over_direction() -> None:
    """Position has priority over a direction that is out of reach."""
    for direction in (-AHEAD_AND_DOWN, np.array([0, 1.0, 0])):
        assert wait(np.array(POSTURE), START, direction, seconds=5.0).error[-1] < 1e-4


@pytest.mark.parametrize(
    "target", [(2.0, 0, 0.5), (0, 0.5, 3.0), (50.0, 50, 0), (0.05, 0, 0.4), (0.3, 0, -3.0)]
)
def test_unreachable_target_causes_no_chatter(target: tuple[float, float, float]) -> None:
    """A target out of reach does not make the arm chatter."""
    run = wait(np.array(POSTURE), np.array(target), AHEAD_AND_DOWN, seconds=8.0)
    assert np.abs(run.acceleration[-1000:]).max() < 1.0
    assert (run.position <= UPPER).all()
    assert (run.position >= LOWER).all()


def test_arm_leaves_the_stretched_posture() -> None:
    """The arm leaves the stretched posture for a target within reach."""
    assert wait(np.zeros(7), START, AHEAD_AND_DOWN, seconds=12.0).error[-1] < 1e-3


def test_outside_limits_joints_move_inwards() -> None:
    home = np.array([0.0, -2.0, 0.0, 3.13, 0.0, 0.0, 0.0])
    run = wait(home, START, AHEAD_AND_DOWN, seconds=12.0)
    outside = np.maximum(np.maximum(run.position - UPPER, LOWER - run.position), 0.0)
    assert (np.diff(outside, axis=0) <= 0.0).all()
    assert not outside[-1].any()
    assert run.error[-1] < 1e-4


def test_joint_slows_toward_its_limit() -> None:
    """A joint slows down toward its limit and does not pass it."""
    for distance in (0.2, 0.05, 0.01, 0.0, -0.1):
        q = np.array(POSTURE)
        q[3] = LOWER[3] + distance
        outward = ARM.at(q).tasks[:3] @ np.array([0, 0, 0, -1.0, 0, 0, 0])
        solution = ARM.step(q, ARM.at(q).position, outward, AHEAD)
        assert (
            solution.velocity[3]
            >= -max(distance, 0.0) * 0.5 * CELL.joints.acceleration[3] / FASTEST[3] - 1e-9
        )
        assert solution.near_limit == (distance < 0.1)


def test_fast_task_is_scaled() -> None:
    """A task that is too fast is scaled and keeps its direction."""
    q = np.array(POSTURE)
    position = ARM.at(q).position
    arm = ArmStage(changed(CELL, joints={"velocity": (0.7,) * 7}), URDF)
    slow = arm.step(q, position, np.array([0.0, 0.1, 0.0]), AHEAD)
    fast = arm.step(q, position + np.array([0, 0.018, 0]), np.array([0.0, 9.0, 0.0]), AHEAD)
    assert not slow.speed_limited
    assert fast.speed_limited
    assert np.abs(fast.velocity).max() == pytest.approx(0.7)
    moved = ARM.at(q).tasks[:3] @ fast.velocity
    assert moved[1] / np.linalg.norm(moved) > 0.999


def numbers(size: int) -> st.SearchStrategy[Vector]:
    usual = st.floats(-3, 3)
    any_finite = st.floats(allow_nan=False, allow_infinity=False)
    return st.tuples(*[st.one_of(usual, any_finite)] * size).map(np.array)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(numbers(7), numbers(3), numbers(3), numbers(4), numbers(3))
def test_a_step_never_raises_nor_returns_nan(
    q: Vector, position: Vector, velocity: Vector, orientation: Vector, turning: Vector
) -> None:
    solution = ARM.step(q, position, velocity, orientation, turning)
    assert np.isfinite(solution.velocity).all()
    assert (np.abs(solution.velocity) <= FASTEST + 1e-9).all()
    assert np.array_equal(solution.velocity, solution.velocity.round(9))
    assert (solution.velocity[q >= UPPER] <= 0).all()
    assert (solution.velocity[q <= LOWER] >= 0).all()


def test_velocities_are_continuous_at_limits() -> None:
    """The joint velocities that the arm asks for are continuous across a joint's limits."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        q = random_joints(1, seed=int(rng.integers(1 << 30)))[0]
        i = rng.integers(7)
        q[i] = rng.choice([LOWER[i], UPPER[i]]) + rng.uniform(-0.02, 0.02)
        target = ARM.at(q).position + rng.normal(size=3) * 0.005
        velocity = ARM.step(q, target, STILL, AHEAD).velocity
        nearby = ARM.step(q + 1e-9 * rng.normal(size=7), target, STILL, AHEAD).velocity
        assert np.abs(velocity - nearby).max() < 1e-4
