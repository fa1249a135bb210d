"""The arm's differential inverse kinematics, compiled.

One step is a strictly convex least-squares problem with a bound on each joint's speed toward its
limits, so that its solution is unique and continuous: unreachable targets and singular postures
slow the arm, without chatter.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.arm.least_squares import solve
from service.core.arm.tuning import (
    FAR_SPEED_MPS,
    IDLE_BRAKE_SHARE,
    MAX_ERROR_M,
    NEAR_LIMIT_RAD,
    POSTURE_GAIN_PER_S,
    POSTURE_SPEED_RADPS,
    SPEED_ROUNDING_MPS,
)
from service.core.frame import Records, Vector
from service.core.geometry import ROUND_TO, quaternion_of, swing, turn_between

SPEED = 1  # flag of a step: a joint's speed limit was met
NEAR = 2  # a joint is near its position limit
SEPARATED = 4  # separation asked for other velocities


@compiled
def describe(arms: Records, heres: Records, jacobian: Vector, rotation: Vector) -> None:
    """Into the kinematics at some joints the tool's Jacobian (6, J), rotation (3, 3), and tasks (5
    or 6, J), of which the sixth turns it about its +z; their damping [m²]: small, and growing
    smoothly where the tool's position becomes singular.
    """
    arm, here = arms[0], heres[0]
    joints, square, tasks = jacobian.shape[1], np.empty((3, 3)), here.tasks
    here.jacobian[:], here.rotation[:] = jacobian, rotation
    for joint in range(joints):
        for i in range(3):
            tasks[i, joint] = jacobian[i, joint]
        for i in range(len(tasks) - 3):
            turn = 0.0
            for k in range(3):
                turn += rotation[k, i] * jacobian[3 + k, joint]
            tasks[3 + i, joint] = arm.turn_lever * turn
    for i in range(3):
        for j in range(3):
            total = 0.0
            for joint in range(joints):
                total += jacobian[i, joint] * jacobian[j, joint]
            square[i, j] = total
    determinant = (
        square[0, 0] * (square[1, 1] * square[2, 2] - square[1, 2] ** 2)
        - square[0, 1] * (square[0, 1] * square[2, 2] - square[0, 2] * square[1, 2])
        + square[0, 2] * (square[0, 1] * square[1, 2] - square[0, 2] * square[1, 1])
    )
    shortage = max(1.0 - math.sqrt(max(determinant, 0.0)) / arm.singular_volume, 0.0)
    here.damping = arm.damping + arm.singular_damping * shortage * shortage


@compiled
def _add_closing(forward: Vector, closing: Vector, most: float) -> None:
    """Adds to a forward speed (3,) [m/s] as much of a closing speed as keeps the sum at most
    `most`.
    """
    ff = fc = cc = 0.0
    for i in range(3):
        ff += forward[i] * forward[i]
        fc += forward[i] * closing[i]
        cc += closing[i] * closing[i]
    if ff > most * most:
        shrink = most / math.sqrt(ff)
        for i in range(3):
            forward[i] *= shrink
        ff *= shrink * shrink
        fc *= shrink
    share = 1.0
    if ff + 2.0 * fc + cc > most * most:
        share = (-fc + math.sqrt(max(fc * fc + cc * (most * most - ff), 0.0))) / cc
    for i in range(3):
        forward[i] += min(max(share, 0.0), 1.0) * closing[i]


@compiled
def follow(
    arms: Records, heres: Records, states: Records, goals: Records, constraints: Records, count: int, out: Vector
) -> int:
    """`joint_step` toward the state's setpoint, for joints that move as the state's."""
    state, goal = states[0], goals[0]
    goal.position[:], goal.velocity[:] = state.setpoint[0], state.setpoint[1]
    goal.orientation[:], goal.turning[:] = state.orientation, state.turning
    goal.acceleration[:], goal.moving[:], goal.horizon_s = state.setpoint[2], state.joints[1], arms[0].horizon_s
    return joint_step(arms, heres, goals, constraints, count, out)


@compiled
def joint_step(arms: Records, heres: Records, goals: Records, constraints: Records, count: int, out: Vector) -> int:
    """`Arm.step` into out (2, J) [rad/s, rad/s²], under the first `count` constraints; flags."""
    arm, here, goal = arms[0], heres[0], goals[0]
    tasks, scale, damping = here.tasks, arm.scale, here.damping
    count_of_tasks, joints = tasks.shape
    wanted, error, linear, turn = np.empty(count_of_tasks), np.empty(3), np.empty(3), np.empty(3)
    distance = 0.0
    for i in range(3):
        linear[i] = min(max(goal.velocity[i], -MAX_ERROR_M), MAX_ERROR_M)
        error[i] = min(max(goal.position[i] - here.position[i], -MAX_ERROR_M), MAX_ERROR_M) - arm.period_s * linear[i]
        distance += error[i] * error[i]
    distance = math.sqrt(distance)
    # in proportion to the error when near, braking evenly from afar
    near = arm.closing_braking / arm.position_gain**2
    rate = arm.position_gain
    if distance > near:
        rate = min(math.sqrt(2.0 * arm.closing_braking * (distance - 0.5 * near)), arm.closing_speed) / distance
    excess = max(rate * distance - FAR_SPEED_MPS, 0.0)
    damping += arm.far_damping * excess * excess
    for i in range(3):  # the error decays as it will be, not as it is
        error[i] *= rate / (1.0 + arm.position_gain * arm.period_s)
    _add_closing(linear, error, arm.max_tool_speed)
    _turn(arms, here.rotation, goal.orientation, goal.turning, count_of_tasks == 6, turn)
    wanted[:3], wanted[3:] = linear, 0.0
    for i in range(count_of_tasks - 3):
        for k in range(3):
            wanted[3 + i] += arm.turn_lever * here.rotation[k, i] * turn[k]
    said, scaled, home, bounds = 0, np.empty((count_of_tasks, joints)), np.empty(joints), np.empty((2, joints))
    for j in range(joints):
        low, high = here.joints[j] - arm.lower[j], arm.upper[j] - here.joints[j]
        if min(low, high) < NEAR_LIMIT_RAD * arm.per_rad[j]:
            said |= NEAR
        bounds[0, j] = -arm.approach_gain[j] * max(low, 0.0) / scale[j]
        bounds[1, j] = arm.approach_gain[j] * max(high, 0.0) / scale[j]
        off, most = arm.posture[j] - here.joints[j], POSTURE_SPEED_RADPS * arm.per_rad[j]
        if arm.is_continuous[j]:  # in whichever turn; 0 half a turn away, as no direction is shorter there
            off = math.sin(off)
        home[j] = min(max(POSTURE_GAIN_PER_S * off, -most), most) / scale[j]
        for i in range(count_of_tasks):
            scaled[i, j] = tasks[i, j] * scale[j]
    rows, limits = np.empty((count, joints)), np.empty(count)
    for k in range(count):
        limits[k] = constraints[k].planned
        for j in range(joints):
            rows[k, j] = constraints[k].row[j] * scale[j]
    velocity = out[0]
    kept = solve(scaled, wanted, home, damping, bounds, rows, limits, velocity)
    if kept:
        said |= SEPARATED
        missing = _missing(scaled, wanted, velocity)
        damping += arm.singular_damping * missing / (missing + arm.kept_speed * arm.kept_speed)
        solve(scaled, wanted, home, damping, bounds, rows, limits, velocity)
    near = _can_have(arms, goals, velocity)
    scaled[3:], wanted[3:] = 0.0, 0.0
    if not near:  # it turns as far as costs its position nothing
        free = np.empty(joints)
        for j in range(joints):
            brake = IDLE_BRAKE_SHARE * arm.period_s * arm.acceleration[j]
            home[j] = (goal.moving[j] - min(max(goal.moving[j], -brake), brake)) / scale[j]
        solve(scaled, wanted, home, damping, bounds, rows, limits, free)
        if not kept:  # what keeps distances was found for this solution, not for one on the way to it
            _turn_less(arms, goals, velocity, free)
    excess = _excess(arms, velocity)
    wanted[:3], home[:] = goal.acceleration, 0.0
    for j in range(joints):
        bounds[1, j] = arm.acceleration[j] / scale[j]
        bounds[0, j] = -bounds[1, j]
    solve(scaled, wanted, home, damping, bounds, rows[:0], limits[:0], out[1])
    for j in range(joints):
        velocity[j] = 0.0 if math.isnan(excess) else velocity[j] * scale[j] / max(excess, 1.0)
        for order in range(2):
            out[order, j] = np.rint(out[order, j] * (1.0 if order == 0 else scale[j]) * ROUND_TO) / ROUND_TO
    return said | SPEED if excess > 1.0 + SPEED_ROUNDING_MPS else said


@compiled
def _missing(tasks: Vector, wanted: Vector, x: Vector) -> float:
    """The square of the tool's velocity [m²/s²] that a solution x (J,) lacks: |wanted - tasks x|²,
    over the first three rows of tasks (N, J).
    """
    total = 0.0
    for i in range(3):
        lacks = wanted[i]
        for j in range(len(x)):
            lacks -= tasks[i, j] * x[j]
        total += lacks * lacks
    return total


@compiled
def _excess(arms: Records, out: Vector) -> float:
    """How many times its greatest speed the fastest joint needs; NaN where one is not finite."""
    excess = 0.0
    for j in range(len(out)):
        if not math.isfinite(out[j]):
            return math.nan
        excess = max(excess, abs(out[j] * arms[0].scale[j]) / arms[0].max_velocity[j])
    return excess


@compiled
def _can_have(arms: Records, goals: Records, out: Vector) -> bool:
    """Whether the joints can soon have the velocities of a solution (J,)."""
    arm, goal = arms[0], goals[0]
    for j in range(len(out)):
        wanted = out[j] * arm.scale[j]
        change = goal.horizon_s * arm.acceleration[j]
        if abs(wanted) > arm.max_velocity[j] or abs(wanted - goal.moving[j]) > change:
            return False
    return True


@compiled
def _turn_less(arms: Records, goals: Records, out: Vector, free: Vector) -> None:
    """Brings a solution (J,) as near to that of a tool that is free to turn as it has to be for
    joints that can have it.
    """
    arm, goal, share = arms[0], goals[0], 1.0
    for j in range(len(out)):
        there, more = free[j] * arm.scale[j], (out[j] - free[j]) * arm.scale[j]
        change, top = goal.horizon_s * arm.acceleration[j], arm.max_velocity[j]
        low = min(max(-top, goal.moving[j] - change), there)
        high = max(min(top, goal.moving[j] + change), there)
        if there + more > high:
            share = min(share, (high - there) / more)
        elif there + more < low:
            share = min(share, (low - there) / more)
    for j in range(len(out)):
        out[j] = free[j] + share * (out[j] - free[j])


@compiled
def _turn(arms: Records, rotation: Vector, orientation: Vector, turning: Vector, about: bool, out: Vector) -> None:
    """Into out (3,) [rad/s] the angular velocity that turns the tool to an orientation (4,) that
    turns itself (3,) [rad/s]: all of it, also `about` its +z, or that the shortest way.
    """
    here, max_speed = np.empty(4), arms[0].max_turn_speed
    if about:
        quaternion_of(rotation, here)
        turn_between(here, orientation, out)
    else:
        swing(rotation[:, 2].copy(), orientation, out)
    square = 0.0
    for i in range(3):
        out[i] = arms[0].turn_gain * out[i] + turning[i]
        square += out[i] * out[i]
    if not square < math.inf:
        out[:] = 0.0
    elif square > max_speed * max_speed:
        for i in range(3):
            out[i] *= max_speed / math.sqrt(square)
