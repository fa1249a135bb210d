"""The numbers of the arm's differential inverse kinematics, compiled: arrays in, arrays out.

One step is a strictly convex least-squares problem with a bound on each joint's speed toward its
limits, so that its solution is unique and continuous: unreachable targets and singular postures
slow the arm, without chatter.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.arm.least_squares import factorise, keep_under, least_squares, substitute
from service.core.frame import Vector
from service.core.rotation import axis_of, quaternion_of, swing, turn_between

# Gains, speeds and damping below were chosen on the WAM, and tried on a Panda and a UR5.
NEAR_LIMIT = 0.1  # [rad]

POSITION_GAIN = 50.0  # [1/s] of a small error's decay
TURN_GAIN = 10.0  # [1/s]
TURN_LEVER = 0.03  # [m] 1 rad/s counts as this many m/s of the tool: position goes first, the posture last
POSTURE_GAIN = 1.0  # [1/s]
POSTURE_SPEED = 0.3  # [rad/s] at most, each joint
DAMPING = 1e-5  # [m²] a joint at 1 rad/s costs as much as sqrt(DAMPING) m/s of error
SINGULAR_DAMPING = 2e-3  # [m²] more at a singular posture
SINGULAR_VOLUME = 0.04  # [m³] manipulability below which damping grows; 0.06 to 0.13 over the table
FAR_SPEED = 0.15  # [m/s]
GAP_FREE, GAP_SLOW = 0.003, 0.012  # [m] a tool so far behind its setpoint slows it, more so by every so far
FARTHEST = 10.0  # [m], [m/s] beyond which errors and velocities are no larger
ROUNDING = 1e-12  # of a speed
STEPS = 1e9  # [s/rad] of the result: rounded so that a replay on another kind of CPU agrees
SPEED, NEAR, APART = 1, 2, 4  # what a step says: a limit of speed met; of position near; of separation met


@compiled
def measured_error(q: Vector, tasks: Vector, measured: Vector, velocities: Vector) -> tuple[float, float]:
    """How far the joints are from where they are measured, the farthest [rad]; how fast the tool is
    measured [m/s], by the tasks at q.
    """
    error = speed = 0.0
    for joint in range(len(q)):
        error = max(error, abs(q[joint] - measured[joint]))
    for axis in range(3):
        along = 0.0
        for joint in range(len(q)):
            along += tasks[axis, joint] * velocities[joint]
        speed += along * along
    return error, math.sqrt(speed)


@compiled
def slow_down(setpoint: Vector, tool: Vector, share: float, max_speed: float) -> float:
    """Share of the greatest speed [m/s] for a setpoint (3, 3) that is ahead of the tool (3,) [m]; 1
    where it comes back; and for one that may keep only a share of its own speed.
    """
    along = gap = 0.0
    for i in range(3):
        ahead = setpoint[0, i] - tool[i]
        along += ahead * setpoint[1, i]
        gap += ahead * ahead
    slow = 1.0 if along <= 0.0 else 1.0 / (1.0 + max(0.0, math.sqrt(gap) - GAP_FREE) / GAP_SLOW)
    if share < 1.0:
        speed = math.sqrt(setpoint[1, 0] ** 2 + setpoint[1, 1] ** 2 + setpoint[1, 2] ** 2)
        slow = min(slow, share * speed / max_speed)
    return slow


@compiled
def tool_speeds(tasks: Vector, dq: Vector, ddq: Vector, jerk: Vector) -> tuple[float, float]:
    """Speed now, and the greater of it and that of the crest, when the accelerations are 0."""
    now = crest = 0.0
    for axis in range(3):
        v = v_crest = 0.0
        for joint in range(len(dq)):
            v += tasks[axis, joint] * dq[joint]
            gained = ddq[joint] * abs(ddq[joint]) / (2.0 * jerk[joint])
            v_crest += tasks[axis, joint] * (dq[joint] + gained)
        now += v * v
        crest += v_crest * v_crest
    return math.sqrt(now), math.sqrt(max(now, crest))


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
def joint_costs(tasks: Vector, damping: float, limits: Vector, out: Vector) -> None:
    """Into out (3, 3, J): joint speeds per tool velocity, by damped least squares, as shares of
    limits (3, J).
    """
    count = len(tasks)
    root, right = np.empty((count, count)), np.empty(count)
    factorise(tasks, damping, root)
    for axis in range(3):
        right[:] = 0.0
        right[axis] = 1.0
        substitute(root, right)
        for joint in range(tasks.shape[1]):
            speed = 0.0
            for i in range(count):
                speed += tasks[i, joint] * right[i]
            for order in range(3):
                out[order, axis, joint] = speed / limits[order, joint]


@compiled
def tool_tasks(jacobian: Vector, rotation: Vector, tasks: Vector) -> float:
    """The tasks (5 or 6, J) of a tool's Jacobian (6, J) and rotation (3, 3), the sixth turns it
    about its +z; their damping [m²]: small, and growing smoothly where the tool's position becomes
    singular.
    """
    joints = jacobian.shape[1]
    square = np.empty((3, 3))
    for joint in range(joints):
        for i in range(3):
            tasks[i, joint] = jacobian[i, joint]
        for i in range(len(tasks) - 3):
            turn = 0.0
            for k in range(3):
                turn += rotation[k, i] * jacobian[3 + k, joint]
            tasks[3 + i, joint] = TURN_LEVER * turn
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
    shortage = max(1.0 - math.sqrt(max(determinant, 0.0)) / SINGULAR_VOLUME, 0.0)
    return DAMPING + SINGULAR_DAMPING * shortage * shortage


@compiled
def joint_step(
    q: Vector,
    tool: Vector,
    rotation: Vector,
    tasks: Vector,
    damping: float,
    position: Vector,
    velocity: Vector,
    orientation: Vector,
    turning: Vector,
    posture: Vector,
    within: Vector,
    gain: Vector,
    scale: Vector,
    moving: Vector,
    max_speed: Vector,
    change: Vector,
    closing: Vector,
    rows: Vector,
    limits: Vector,
    count: int,
    out: Vector,
) -> int:
    """`Arm.step` into out (J,) [rad/s], for joints that move so (J,) and can soon change that by
    change (J,) [rad/s], with the first `count` of rows (K, J) times out at most limits (K,) [m/s];
    what is to be said of it.
    """
    joints, rows_of_tasks = len(q), len(tasks)
    period, braking, closing_speed, far_damping, most, fastest_turn = closing
    wanted, error, linear, turn = np.empty(rows_of_tasks), np.empty(3), np.empty(3), np.empty(3)
    distance = 0.0
    for i in range(3):
        linear[i] = min(max(velocity[i], -FARTHEST), FARTHEST)
        error[i] = min(max(position[i] - tool[i], -FARTHEST), FARTHEST) - period * linear[i]
        distance += error[i] * error[i]
    distance = math.sqrt(distance)
    # in proportion to the error when near, braking evenly from afar
    near = braking / POSITION_GAIN**2
    rate = POSITION_GAIN
    if distance > near:
        rate = min(math.sqrt(2.0 * braking * (distance - 0.5 * near)), closing_speed) / distance
    excess = max(rate * distance - FAR_SPEED, 0.0)
    damping += far_damping * excess * excess
    for i in range(3):  # the error decays as it will be, not as it is
        error[i] *= rate / (1.0 + POSITION_GAIN * period)
    _add_closing(linear, error, most)
    _turn(rotation, orientation, turning, fastest_turn, rows_of_tasks == 6, turn)
    wanted[:3], wanted[3:] = linear, 0.0
    for i in range(rows_of_tasks - 3):
        for k in range(3):
            wanted[3 + i] += TURN_LEVER * rotation[k, i] * turn[k]
    said, scaled, home, bounds = 0, np.empty((rows_of_tasks, joints)), np.empty(joints), np.empty((2, joints))
    for j in range(joints):
        low, high = q[j] - within[0, j], within[1, j] - q[j]
        if min(low, high) < NEAR_LIMIT:
            said |= NEAR
        bounds[0, j] = -gain[j] * max(low, 0.0) / scale[j]
        bounds[1, j] = gain[j] * max(high, 0.0) / scale[j]
        home[j] = min(max(POSTURE_GAIN * (posture[j] - q[j]), -POSTURE_SPEED), POSTURE_SPEED) / scale[j]
        for i in range(rows_of_tasks):
            scaled[i, j] = tasks[i, j] * scale[j]
    scaled_rows = np.empty((count, joints))
    for k in range(count):
        for j in range(joints):
            scaled_rows[k, j] = rows[k, j] * scale[j]
    least_squares(scaled, wanted, home, damping, bounds, out)
    kept = keep_under(scaled, wanted, home, damping, bounds, scaled_rows, limits, count, out)
    if kept:
        said |= APART
    if not _can_have(out, moving, scale, max_speed, change):  # it turns as far as costs its position nothing
        free = np.empty(joints)
        scaled[3:], wanted[3:] = 0.0, 0.0
        for j in range(joints):
            home[j] = moving[j] / scale[j]
        least_squares(scaled, wanted, home, damping, bounds, free)
        keep_under(scaled, wanted, home, damping, bounds, scaled_rows, limits, count, free)
        if not kept:  # what keeps distances was found for this solution, not for one on the way to it
            _turn_less(out, free, moving, scale, max_speed, change)
    excess = _excess(out, scale, max_speed)
    for j in range(joints):
        if math.isnan(excess):
            out[j] = 0.0
        else:
            out[j] *= scale[j] / max(excess, 1.0)
        out[j] = np.rint(out[j] * STEPS) / STEPS
    return said | SPEED if excess > 1.0 + ROUNDING else said


@compiled
def _excess(out: Vector, scale: Vector, max_speed: Vector) -> float:
    """How many times its greatest speed the fastest joint needs; NaN where one is not finite."""
    excess = 0.0
    for j in range(len(out)):
        if not math.isfinite(out[j]):
            return math.nan
        excess = max(excess, abs(out[j] * scale[j]) / max_speed[j])
    return excess


@compiled
def _can_have(out: Vector, moving: Vector, scale: Vector, max_speed: Vector, change: Vector) -> bool:
    """Whether joints that move so (J,) [rad/s] can soon have the velocities of a solution (J,)."""
    for j in range(len(out)):
        wanted = out[j] * scale[j]
        if abs(wanted) > max_speed[j] or abs(wanted - moving[j]) > change[j]:
            return False
    return True


@compiled
def _turn_less(out: Vector, free: Vector, moving: Vector, scale: Vector, max_speed: Vector, change: Vector) -> None:
    """Brings a solution (J,) as near to that of a tool that is free to turn as it has to be for
    joints that can have it.
    """
    share = 1.0
    for j in range(len(out)):
        there, more = free[j] * scale[j], (out[j] - free[j]) * scale[j]
        low = min(max(-max_speed[j], moving[j] - change[j]), there)
        high = max(min(max_speed[j], moving[j] + change[j]), there)
        if there + more > high:
            share = min(share, (high - there) / more)
        elif there + more < low:
            share = min(share, (low - there) / more)
    for j in range(len(out)):
        out[j] = free[j] + share * (out[j] - free[j])


@compiled
def _turn(
    rotation: Vector,
    orientation: Vector,
    turning: Vector,
    max_speed: float,
    about: bool,
    out: Vector,
) -> None:
    """Into out (3,) [rad/s] the angular velocity that turns the tool to an orientation (4,) that
    turns itself (3,) [rad/s]: all of it, also `about` its +z, or that the shortest way.
    """
    here, axis = np.empty(4), np.empty(3)
    if about:
        quaternion_of(rotation, here)
        turn_between(here, orientation, out)
    else:
        axis_of(orientation, axis)
        swing(rotation[:, 2].copy(), axis, out)
    square = 0.0
    for i in range(3):
        out[i] = TURN_GAIN * out[i] + turning[i]
        square += out[i] * out[i]
    if not square < math.inf:
        out[:] = 0.0
    elif square > max_speed * max_speed:
        for i in range(3):
            out[i] *= max_speed / math.sqrt(square)
