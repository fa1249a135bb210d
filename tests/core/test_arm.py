"""The arm: the model against its published numbers, and inverse kinematics that is right, bounded
and steady.
"""

from __future__ import annotations

import itertools
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
from thirdhand.core.arm.stage import Arm
from thirdhand.core.limiter.stage import Limiter
from thirdhand.core.skill.skill import clamp
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
# the same file: mass [kg], centre of mass in the DH link frame [m], inertia about it [kg m²]
LINKS = (
    (10.7677, (-0.00443, 0.12189, -0.00066), (0.13488, 0.11328, 0.09046)),
    (3.8749, (-0.00237, 0.03106, 0.01542), (0.02141, 0.01378, 0.01559)),
    (1.8023, (-0.03826, 0.20751, 0.00003), (0.05911, 0.00325, 0.05927)),
    (2.17266, (0.00553, 0.00007, 0.11928), (0.01067, 0.01059, 0.00282)),
    (0.35656, (0.00005, 0.02886, 0.00148), (3.71e-4, 1.94e-4, 3.82e-4)),
    (0.40916, (-0.00006, -0.01686, 0.02419), (5.49e-4, 2.38e-4, 4.51e-4)),
    (0.07548, (0.00015, 0.00007, -0.00335), (3.91e-5, 3.88e-5, 7.61e-5)),
)
START = np.array([0.45, -0.05, 0.35])  # [m]
AHEAD_AND_DOWN = np.array([1.0, 0.0, -1.0]) / math.sqrt(2.0)
POSTURE = (0.1761, 0.8604, -0.5, 2.5414, -0.4273, -1.0823, 0.0)  # [rad] at START, pointing ahead and down
CELL = Settings(arm=ArmSettings(posture=POSTURE))
LOWER, UPPER, FASTEST = (np.array(getattr(CELL.joints, name)) for name in ("lower", "upper", "velocity"))
STILL = np.zeros(3)
EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])
ARM = Arm(CELL, URDF)


def facing(direction: Vector) -> Vector:
    """A quaternion (4,) that turns +z there, the shortest way."""
    x, y, z = direction / np.linalg.norm(direction)
    found = np.array([-y, x, 0.0, 1.0 + z])
    return np.asarray(found / np.linalg.norm(found)) if found.any() else np.array([1.0, 0.0, 0.0, 0.0])


AHEAD = facing(AHEAD_AND_DOWN)


def dh_frames(q: Vector) -> list[Vector]:
    """The DH frames 1 to 7 in frame base, (4, 4) each."""
    frame = np.eye(4)
    frame[:3, 3] = CELL.reach.centre
    frames = []
    for theta, (alpha, a, d) in zip(q, DH, strict=True):
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        frame = frame @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
        frames.append(frame)
    return frames


def random_joints(count: int, seed: int) -> Vector:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


def angle_to(q: Vector, direction: Vector) -> float:
    return math.acos(min(1.0, float(ARM.at(q).rotation[:, 2] @ direction)))


class Followed(NamedTuple):
    """What came of a path: errors (N,) [m], joints (N, 7) and their accelerations, and how often
    speeds were limited.
    """

    error: Vector
    position: Vector
    acceleration: Vector
    speed_limited: int


def follow(q: Vector, path: Vector, velocity: Vector, direction: Vector) -> Followed:
    """The tool led along a path (N, 3) with the limiter in the loop, from rest at q."""
    limiter = Limiter(CELL.joints, CELL.period_s)
    dq, ddq = np.zeros(7), np.zeros(7)
    errors, joints, accelerations, speed_limited = [], [], [], 0
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


def minimum_jerk(start: Vector, end: Vector, seconds: float) -> tuple[Vector, Vector]:
    """Positions and velocities, (N, 3) each, at the ends of the periods."""
    t = np.arange(1, round(seconds / CELL.period_s) + 1)[:, None] * CELL.period_s / seconds
    way = end - start
    return start + (10 * t**3 - 15 * t**4 + 6 * t**5) * way, (30 * t**2 - 60 * t**3 + 30 * t**4) * way / seconds


def test_forward_kinematics_is_the_product_of_the_published_parameters_and_gives_their_check_values() -> None:
    for q in random_joints(200, seed=1):
        position, rotation = ARM.at(q).position, ARM.at(q).rotation
        expected = dh_frames(q)[-1]
        assert np.abs(position - expected[:3, 3]).max() < 1e-9
        assert np.abs(rotation - expected[:3, :3]).max() < 1e-9
    assert ARM.at(np.zeros(7)).position == pytest.approx([0, 0, 1.256])
    assert ARM.at(np.array([0, -2, 0, 3.13, 0, 0, 0])).position == pytest.approx([-0.2125, 0, 0.3523], abs=1e-4)


def test_the_tool_sits_on_the_plate_where_the_settings_say() -> None:
    half = math.sqrt(0.5)
    arm = Arm(changed(CELL, tool={"plate_from_tool": (0.01, 0.02, 0.1, 0.0, half, 0.0, half)}), URDF)
    q = random_joints(1, seed=2)[0]
    plate = dh_frames(q)[-1]
    position, rotation = arm.at(q).position, arm.at(q).rotation
    assert position == pytest.approx(plate[:3, 3] + plate[:3, :3] @ [0.01, 0.02, 0.1], abs=1e-9)
    assert rotation[:, 2] == pytest.approx(plate[:3, 0], abs=1e-9)


def test_masses_and_inertias_are_the_published_ones() -> None:
    model = pin.buildModelFromXML(URDF)
    data = model.createData()
    q = random_joints(1, seed=3)[0]
    pin.forwardKinematics(model, data, q)
    assert sum(inertia.mass for inertia in model.inertias) == pytest.approx(19.45876)
    for i, (frame, (mass, centre, moments)) in enumerate(zip(dh_frames(q), LINKS, strict=True), start=1):
        inertia, placement = model.inertias[i], data.oMi[i]
        assert inertia.mass == pytest.approx(mass)
        assert placement.act(inertia.lever) == pytest.approx(frame[:3, :3] @ centre + frame[:3, 3], abs=1e-9)
        turned = placement.rotation @ inertia.inertia @ placement.rotation.T
        assert np.abs(turned - frame[:3, :3] @ np.diag(moments) @ frame[:3, :3].T).max() < 1e-9


def test_joint_names_and_limits_of_the_model_are_those_of_wire_and_settings() -> None:
    model = pin.buildModelFromXML(URDF)
    assert tuple(model.names)[1:] == JOINT_NAMES
    assert model.frames[1].name == BASE
    assert "<mesh" not in URDF
    assert np.array_equal(model.lowerPositionLimit, LOWER)
    assert np.array_equal(model.upperPositionLimit, UPPER)
    assert model.effortLimit.tolist() == [60, 60, 45, 30, 10, 10, 10]
    assert model.velocityLimit.tolist() == [2.0] * 7
    assert (model.velocityLimit >= FASTEST).all()


def test_tool_velocity_is_the_derivative_of_its_position() -> None:
    step = 1e-6
    for q, dq in zip(random_joints(50, seed=4), random_joints(50, seed=5), strict=True):
        ahead, behind = ARM.at(q + step * dq).position, ARM.at(q - step * dq).position
        assert ARM.at(q).tasks[:3] @ dq == pytest.approx((ahead - behind) / (2 * step), abs=1e-7)


@pytest.mark.parametrize("place", [(0.62, -0.28, 0.30), (0.50, 0.38, 0.16), (0.62, 0.0, 0.26), (0.75, 0.0, 0.06)])
def test_a_place_is_reached_and_the_tool_points_as_told(place: tuple[float, float, float]) -> None:
    run = wait(np.array(POSTURE), np.array(place), AHEAD_AND_DOWN, seconds=7.0)
    assert run.error[-1] < 1e-5
    assert angle_to(run.position[-1], AHEAD_AND_DOWN) < 0.01
    assert np.abs(run.acceleration[-100:]).max() < 0.1


def test_the_posture_is_kept_where_the_task_leaves_it_free() -> None:
    q = np.array(POSTURE)
    position = ARM.at(q).position
    run = wait(q, position, AHEAD_AND_DOWN, seconds=0.5)
    assert np.abs(run.position - q).max() < 1e-3
    turned = q + np.array([0, 0, 0, 0, 0, 0, 1.5])
    assert np.abs(wait(turned, position, AHEAD_AND_DOWN, seconds=8.0).position[-1] - q).max() < 0.01


OFFSETS = list(itertools.product((-0.15, 0.15), repeat=3))


@pytest.mark.parametrize(
    ("handover", "glass", "board"),
    [(OFFSETS[i], OFFSETS[(3 * i + 5) % 8], OFFSETS[(5 * i + 2) % 8]) for i in (0, 2, 5, 7)],
)
def test_the_soldering_path_is_followed_to_a_tenth_of_a_millimetre(
    handover: tuple[float, ...], glass: tuple[float, ...], board: tuple[float, ...]
) -> None:
    q = np.array(POSTURE)
    places = [np.array([0.62, -0.28, 0.30]) + handover, np.array([0.50, 0.38, 0.16]) + glass]
    places += [np.array([0.62, 0.0, 0.26]) + board]
    places = [
        clamp(place.clip([-9, -9, 0.05], 9), STILL, STILL, box=EVERYWHERE, reach=CELL.reach)[0] for place in places
    ]
    legs = zip([ARM.at(q).position, *places], places, (3.0, 3.5, 3.0), strict=False)
    paths, speeds = zip(*(minimum_jerk(a, b, seconds) for a, b, seconds in legs), strict=True)
    run = follow(q, np.vstack(paths), np.vstack(speeds), AHEAD_AND_DOWN)
    assert run.error.max() < 1e-4
    assert run.speed_limited == 0


def test_position_goes_before_a_direction_that_cannot_be_had() -> None:
    for direction in (-AHEAD_AND_DOWN, np.array([0, 1.0, 0])):
        assert wait(np.array(POSTURE), START, direction, seconds=5.0).error[-1] < 1e-4


@pytest.mark.parametrize("target", [(2.0, 0, 0.5), (0, 0.5, 3.0), (50.0, 50, 0), (0.05, 0, 0.4), (0.3, 0, -3.0)])
def test_a_target_out_of_reach_does_not_make_the_arm_chatter(target: tuple[float, float, float]) -> None:
    run = wait(np.array(POSTURE), np.array(target), AHEAD_AND_DOWN, seconds=8.0)
    assert np.abs(run.acceleration[-1000:]).max() < 1.0
    assert (run.position <= UPPER).all()
    assert (run.position >= LOWER).all()


def test_the_arm_leaves_the_stretched_posture_for_a_target_within_reach() -> None:
    assert wait(np.zeros(7), START, AHEAD_AND_DOWN, seconds=12.0).error[-1] < 1e-3


def test_from_home_outside_the_limits_joints_come_inwards_only() -> None:
    home = np.array([0.0, -2.0, 0.0, 3.13, 0.0, 0.0, 0.0])
    run = wait(home, START, AHEAD_AND_DOWN, seconds=12.0)
    outside = np.maximum(np.maximum(run.position - UPPER, LOWER - run.position), 0.0)
    assert (np.diff(outside, axis=0) <= 0.0).all()
    assert not outside[-1].any()
    assert run.error[-1] < 1e-4


def test_a_joint_slows_down_toward_its_limit_and_does_not_pass_it() -> None:
    for distance in (0.2, 0.05, 0.01, 0.0, -0.1):
        q = np.array(POSTURE)
        q[3] = LOWER[3] + distance
        outward = ARM.at(q).tasks[:3] @ np.array([0, 0, 0, -1.0, 0, 0, 0])
        solution = ARM.step(q, ARM.at(q).position, outward, AHEAD)
        assert solution.velocity[3] >= -max(distance, 0.0) * 0.5 * CELL.joints.acceleration[3] / FASTEST[3] - 1e-9
        assert solution.near_limit == (distance < 0.1)


def test_too_fast_a_task_is_scaled_and_keeps_its_direction() -> None:
    q = np.array(POSTURE)
    position = ARM.at(q).position
    arm = Arm(changed(CELL, joints={"velocity": (0.7,) * 7}), URDF)
    slow = arm.step(q, position, np.array([0.0, 0.1, 0.0]), AHEAD)
    fast = arm.step(q, position + np.array([0, 0.018, 0]), np.array([0.0, 9.0, 0.0]), AHEAD)
    assert not slow.speed_limited
    assert fast.speed_limited
    assert np.abs(fast.velocity).max() == pytest.approx(0.7)
    moved = ARM.at(q).tasks[:3] @ fast.velocity
    assert moved[1] / np.linalg.norm(moved) > 0.999


def numbers(size: int) -> st.SearchStrategy[Vector]:
    usual, any_finite = st.floats(-3, 3), st.floats(allow_nan=False, allow_infinity=False)
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


def test_the_wanted_velocity_of_the_joints_is_continuous_across_their_limits() -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        q = random_joints(1, seed=int(rng.integers(1 << 30)))[0]
        i = rng.integers(7)
        q[i] = rng.choice([LOWER[i], UPPER[i]]) + rng.uniform(-0.02, 0.02)
        target = ARM.at(q).position + rng.normal(size=3) * 0.005
        here = ARM.step(q, target, STILL, AHEAD).velocity
        there = ARM.step(q + 1e-9 * rng.normal(size=7), target, STILL, AHEAD).velocity
        assert np.abs(here - there).max() < 1e-4
