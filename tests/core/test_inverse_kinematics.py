"""The compiled functions of the inverse kinematics against plain references."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from thirdhand.core.arm.least_squares import keep_under, least_squares
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.decision.step import measured_error
from thirdhand.core.frame import Vector, parameters
from thirdhand.core.kinematics import tool_speed_after, tool_speeds
from thirdhand.core.setpoint.step import slow_down
from thirdhand.core.tuning import TUNING
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import robot_description

GAP_FREE_M = TUNING.setpoint.gap_free_m
GAP_SLOW_M = TUNING.setpoint.gap_slow_m


@pytest.mark.parametrize("seed", range(40))
def test_bounded_least_squares(seed: int) -> None:
    """The solution equals that of another solver."""
    random = np.random.default_rng(seed)
    tasks = random.normal(size=(6, 7))
    target = random.normal(size=6)
    posture = 0.1 * random.normal(size=7)
    damping = 10 ** random.uniform(-4, -1)
    width = 10 ** random.uniform(-1.5, 0.5)
    bounds = np.sort(random.normal(size=(2, 7)), axis=0) * width
    bounds[0], bounds[1] = np.minimum(bounds[0], -1e-3), np.maximum(bounds[1], 1e-3)
    solution = np.empty(7)
    least_squares(tasks, target, posture, damping, bounds, solution)
    whole = np.vstack([tasks, np.sqrt(damping) * np.eye(7)])
    right = np.concatenate([target, np.sqrt(damping) * posture])
    best = lsq_linear(whole, right, bounds=(bounds[0], bounds[1]), method="bvls", tol=1e-14).x
    np.testing.assert_allclose(solution, best, atol=1e-7)


def test_speeds_and_errors_are_those_of_numpy() -> None:
    """Tool speed now, after the step and in total, and the error of the measured joints."""
    random = np.random.default_rng(2)
    tasks, q, dq, ddq = random.normal(size=(6, 7)), *random.normal(size=(3, 7))
    jerk = random.uniform(300, 500, 7)
    state = parameters(tasks=tasks, joints=q)
    speed, coming, total = tool_speeds(state, dq, ddq, jerk)
    crest = np.linalg.norm(tasks[:3] @ (dq + ddq * np.abs(ddq) / (2 * jerk)))
    assert speed == pytest.approx(np.linalg.norm(tasks[:3] @ dq), rel=1e-12)
    assert coming == pytest.approx(max(speed, crest), rel=1e-12)
    columns = np.linalg.norm(tasks[:3], axis=0)
    assert total == pytest.approx(columns @ (np.abs(dq) + ddq**2 / (2 * jerk)), rel=1e-12)
    measured = q + 0.01 * random.normal(size=7)
    error, fast = measured_error(
        parameters(measured=measured, measured_velocities=dq)[0],
        state[0],
        parameters(per_rad=np.ones(len(dq)))[0],
    )
    assert (error, fast) == pytest.approx((np.abs(q - measured).max(), speed), rel=1e-12)


@pytest.mark.parametrize("name", ["wam", "franka", "ur5"])
def test_tool_speed_after_is_that_of_pinocchio(name: str) -> None:
    """The tool's speed after a joint displacement is that of Pinocchio."""
    random = np.random.default_rng(3)
    settings = cell_of(name)
    arm = ArmStage(settings, robot_description(settings))
    joints = len(settings.joints.names)
    for _ in range(20):
        q, step_rad, dq = random.uniform(-1, 1, (3, joints))
        speed = tool_speed_after(arm.at(q).record[0], step_rad, dq)
        assert speed == pytest.approx(np.linalg.norm(arm.at(q + step_rad).tasks[:3] @ dq), rel=1e-9)


def test_setpoint_waits_for_a_late_tool() -> None:
    setpoint = np.zeros((3, 3))
    tool = np.zeros(3)
    limits = parameters(max_speed=0.8, gap_free_m=GAP_FREE_M, gap_slow_m=GAP_SLOW_M)[0]
    setpoint[0, 0] = GAP_FREE_M + GAP_SLOW_M
    setpoint[1, 0] = 0.2
    assert slow_down(setpoint, tool, 1.0, limits) == pytest.approx(0.5)
    # 40 % of max_speed is asked for, and 0.08 m/s allowed
    assert slow_down(setpoint, tool, 0.4, limits) == pytest.approx(0.1)
    setpoint[1, 0] = -0.2  # the setpoint approaches the tool
    assert slow_down(setpoint, tool, 1.0, limits) == 1.0


# --- least squares under inequalities ---


@pytest.mark.parametrize("seed", range(30))
def test_least_squares_under_inequalities(seed: int) -> None:
    """The solution equals that of another solver."""
    random = np.random.default_rng(seed)
    tasks = random.normal(size=(5, 7))
    target = random.normal(size=5)
    posture = 0.1 * random.normal(size=7)
    damping = 10 ** random.uniform(-4, -1)
    count = int(random.integers(1, 12))
    bounds = np.sort(random.normal(size=(2, 7)), axis=0) * 0.5
    bounds[0], bounds[1] = np.minimum(bounds[0], 0), np.maximum(bounds[1], 0)
    rows = random.normal(size=(count, 7))
    limits = np.maximum(0.2 * random.normal(size=count), 0)
    if seed % 3 == 0 and count > 1:
        # the same inequality twice
        rows[1] = 2 * rows[0]
        limits[1] = 2 * limits[0]
    if seed % 5 == 0:
        limits[0] = 0.3 * rows[0] @ np.where(rows[0] > 0, bounds[0], bounds[1])  # violated at 0
        count = min(count, 3)
        rows = rows[:count]
        limits = limits[:count]
    solution = np.empty(7)
    least_squares(tasks, target, posture, damping, bounds, solution)
    before = solution.copy()
    met = keep_under(tasks, target, posture, damping, bounds, rows, limits, solution)
    assert met == bool((rows @ before > limits + 1e-9).any())
    assert (rows @ solution <= limits + 1e-8).all()
    assert ((bounds[0] <= solution) & (solution <= bounds[1])).all()

    def cost(x: Vector) -> float:
        return float(np.sum((tasks @ x - target) ** 2) + damping * np.sum((x - posture) ** 2))

    best = minimize(
        cost,
        0.9 * solution,
        bounds=list(zip(*bounds, strict=True)),
        constraints=[{"type": "ineq", "fun": lambda x: limits - rows @ x}],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert cost(solution) <= best.fun + 1e-6


def test_way_along_two_obstacles_is_free() -> None:
    """The arm cannot move away from both obstacles."""
    tasks = np.eye(3)
    target = np.array([0.3, 0.1, 0.0])
    bounds = np.tile([[-1.0], [1.0]], 3)
    rows = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    solution = np.empty(3)
    least_squares(tasks, target, np.zeros(3), 1e-3, bounds, solution)
    assert keep_under(
        tasks, target, np.zeros(3), 1e-3, bounds, rows, np.array([-0.02, -0.02]), solution
    )
    np.testing.assert_allclose(solution, [0.3, 0.0, 0.0], atol=1e-3)
