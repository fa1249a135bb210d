"""The compiled numbers of the inverse kinematics against plain references."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from thirdhand.core.arm.least_squares import keep_under, least_squares
from thirdhand.core.arm.stage import Arm
from thirdhand.core.arm.step import describe
from thirdhand.core.decision.step import measured_error
from thirdhand.core.frame import Vector, parameters
from thirdhand.core.kinematics import tool_speed_after, tool_speeds
from thirdhand.core.setpoint.step import slow_down
from thirdhand.core.tuning import TUNING
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import robot_description

DAMPING_M2 = TUNING.arm.damping_m2
TURN_LEVER_M = TUNING.arm.turn_lever_m
GAP_FREE_M = TUNING.setpoint.gap_free_m
GAP_SLOW_M = TUNING.setpoint.gap_slow_m


@pytest.mark.parametrize("seed", range(40))
def test_the_bounded_least_squares_are_those_of_another_solver(seed: int) -> None:
    random = np.random.default_rng(seed)
    tasks, wanted, posture = random.normal(size=(6, 7)), random.normal(size=6), 0.1 * random.normal(size=7)
    damping, width = 10 ** random.uniform(-4, -1), 10 ** random.uniform(-1.5, 0.5)
    bounds = np.sort(random.normal(size=(2, 7)), axis=0) * width
    bounds[0], bounds[1] = np.minimum(bounds[0], -1e-3), np.maximum(bounds[1], 1e-3)
    found = np.empty(7)
    least_squares(tasks, wanted, posture, damping, bounds, found)
    whole = np.vstack([tasks, np.sqrt(damping) * np.eye(7)])
    right = np.concatenate([wanted, np.sqrt(damping) * posture])
    best = lsq_linear(whole, right, bounds=(bounds[0], bounds[1]), method="bvls", tol=1e-14).x
    np.testing.assert_allclose(found, best, atol=1e-7)


@pytest.mark.parametrize("count", [5, 6])
def test_tasks_are_the_tool_s_velocity_and_what_turns_it(count: int) -> None:
    random = np.random.default_rng(1)
    jacobian, rotation = random.normal(size=(6, 7)), np.linalg.qr(random.normal(size=(3, 3)))[0]
    arm = parameters(turn_lever=TURN_LEVER_M, damping=DAMPING_M2, singular_damping=2e-3, singular_volume=0.04)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, random.normal(size=3)
    parts = {"jacobian": np.empty((6, 7)), "position": np.empty(3), "rotation": np.empty((3, 3))}
    here = parameters(tasks=np.empty((count, 7)), damping=0.0, **parts)
    describe(arm, here, jacobian, pose)
    expected = np.vstack([jacobian[:3], TURN_LEVER_M * rotation.T @ jacobian[3:]])[:count]
    np.testing.assert_allclose(here["tasks"][0], expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(here["position"][0], pose[:3, 3])
    np.testing.assert_array_equal(here["rotation"][0], rotation)
    assert here["damping"][0] == DAMPING_M2  # far from singular


def test_speeds_and_errors_are_those_of_numpy() -> None:
    random = np.random.default_rng(2)
    tasks, q, dq, ddq = random.normal(size=(6, 7)), *random.normal(size=(3, 7))
    jerk = random.uniform(300, 500, 7)
    here = parameters(tasks=tasks, joints=q)
    speed, coming, total = tool_speeds(here, dq, ddq, jerk)
    crest = np.linalg.norm(tasks[:3] @ (dq + ddq * np.abs(ddq) / (2 * jerk)))
    assert speed == pytest.approx(np.linalg.norm(tasks[:3] @ dq), rel=1e-12)
    assert coming == pytest.approx(max(speed, crest), rel=1e-12)
    columns = np.linalg.norm(tasks[:3], axis=0)
    assert total == pytest.approx(columns @ (np.abs(dq) + ddq**2 / (2 * jerk)), rel=1e-12)
    measured = q + 0.01 * random.normal(size=7)
    error, fast = measured_error(
        parameters(measured=measured, measured_velocities=dq), here, parameters(per_rad=np.ones(len(dq)))
    )
    assert (error, fast) == pytest.approx((np.abs(q - measured).max(), speed), rel=1e-12)


@pytest.mark.parametrize("name", ["wam", "franka", "ur5"])
def test_the_tool_s_speed_after_a_way_of_the_joints_is_that_of_pinocchio(name: str) -> None:
    random, settings = np.random.default_rng(3), cell_of(name)
    arm, joints = Arm(settings, robot_description(settings)), len(settings.joints.names)
    for _ in range(20):
        q, way, dq = random.uniform(-1, 1, (3, joints))
        speed = tool_speed_after(arm.at(q).record, way, dq)
        assert speed == pytest.approx(np.linalg.norm(arm.at(q + way).tasks[:3] @ dq), rel=1e-9)


def test_a_setpoint_waits_for_a_tool_that_is_behind() -> None:
    setpoint, tool = np.zeros((3, 3)), np.zeros(3)
    limits = parameters(max_speed=0.8, gap_free_m=GAP_FREE_M, gap_slow_m=GAP_SLOW_M)
    setpoint[0, 0], setpoint[1, 0] = GAP_FREE_M + GAP_SLOW_M, 0.2
    assert slow_down(setpoint, tool, 1.0, limits) == pytest.approx(0.5)
    assert slow_down(setpoint, tool, 0.4, limits) == pytest.approx(0.1)  # of 0.8 m/s, where 0.08 are allowed
    setpoint[1, 0] = -0.2  # it comes back
    assert slow_down(setpoint, tool, 1.0, limits) == 1.0


# --- least squares under inequalities ---


@pytest.mark.parametrize("seed", range(30))
def test_least_squares_under_inequalities_are_those_of_another_solver(seed: int) -> None:
    random = np.random.default_rng(seed)
    tasks, wanted, posture = random.normal(size=(5, 7)), random.normal(size=5), 0.1 * random.normal(size=7)
    damping, count = 10 ** random.uniform(-4, -1), int(random.integers(1, 12))
    bounds = np.sort(random.normal(size=(2, 7)), axis=0) * 0.5
    bounds[0], bounds[1] = np.minimum(bounds[0], 0), np.maximum(bounds[1], 0)
    rows, limits = random.normal(size=(count, 7)), np.maximum(0.2 * random.normal(size=count), 0)
    if seed % 3 == 0 and count > 1:
        rows[1], limits[1] = 2 * rows[0], 2 * limits[0]  # said twice
    if seed % 5 == 0:
        limits[0] = 0.3 * rows[0] @ np.where(rows[0] > 0, bounds[0], bounds[1])  # it is to be left
        count = min(count, 3)
        rows, limits = rows[:count], limits[:count]
    found = np.empty(7)
    least_squares(tasks, wanted, posture, damping, bounds, found)
    before = found.copy()
    met = keep_under(tasks, wanted, posture, damping, bounds, rows, limits, found)
    assert met == bool((rows @ before > limits + 1e-9).any())
    assert (rows @ found <= limits + 1e-8).all()
    assert ((bounds[0] <= found) & (found <= bounds[1])).all()

    def cost(x: Vector) -> float:
        return float(np.sum((tasks @ x - wanted) ** 2) + damping * np.sum((x - posture) ** 2))

    best = minimize(
        cost,
        0.9 * found,
        bounds=list(zip(*bounds, strict=True)),
        constraints=[{"type": "ineq", "fun": lambda x: limits - rows @ x}],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert cost(found) <= best.fun + 1e-6


def test_between_two_things_that_cannot_both_be_left_the_way_along_them_is_free() -> None:
    tasks, wanted, bounds = np.eye(3), np.array([0.3, 0.1, 0.0]), np.tile([[-1.0], [1.0]], 3)
    rows, found = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), np.empty(3)
    least_squares(tasks, wanted, np.zeros(3), 1e-3, bounds, found)
    assert keep_under(tasks, wanted, np.zeros(3), 1e-3, bounds, rows, np.array([-0.02, -0.02]), found)
    np.testing.assert_allclose(found, [0.3, 0.0, 0.0], atol=1e-3)
