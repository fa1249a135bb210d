"""The arm's differential inverse kinematics, compiled.

One step is a strictly convex least-squares problem with a bound on each joint's speed toward its
limits, so that its solution is unique and continuous: unreachable targets and singular postures
slow the arm, without chatter.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.arm.least_squares import factorise, solve, substitute
from service.core.frame import Records, Vector
from service.core.geometry import quaternion_of, swing, turn_between

NEAR_LIMIT = 0.1  # [rad]
POSTURE_GAIN = 1.0  # [1/s]
POSTURE_SPEED = 0.3  # [rad/s] at most, each joint
FAR_SPEED = 0.15  # [m/s] a faster approach is damped more
FARTHEST = 10.0  # [m], [m/s] beyond which errors and velocities are no larger
IDLE_BRAKE = 0.25  # of the joints' acceleration, with which motion ends that neither moves the tool nor turns it
ROUNDING = 1e-12  # of a speed
ROUND_TO = 1e9  # [s/rad], [s²/rad] of the result: machines that differ in the last bits agree
SPEED = 1  # flag of a step: a joint's speed limit was met
NEAR = 2  # a joint is near its position limit
SEPARATED = 4  # separation asked for other velocities


@compiled
def tool_speeds(heres: Records, dq: Vector, ddq: Vector, jerk: Vector) -> tuple[float, float, float]:
    """Speed of the tool now; the greater of it and the speed once each joint has brought its
    acceleration to 0; and the sum of what the joints contribute to that [m/s].

    The sum bounds the speed whatever the joints' motions cancel of each other now.
    """
    tasks = heres[0].tasks
    now = crest = total = 0.0
    for axis in range(3):
        v = v_crest = 0.0
        for joint in range(len(dq)):
            v += tasks[axis, joint] * dq[joint]
            gained = ddq[joint] * abs(ddq[joint]) / (2.0 * jerk[joint])
            v_crest += tasks[axis, joint] * (dq[joint] + gained)
        now += v * v
        crest += v_crest * v_crest
    for joint in range(len(dq)):
        column = math.sqrt(tasks[0, joint] ** 2 + tasks[1, joint] ** 2 + tasks[2, joint] ** 2)
        total += column * (abs(dq[joint]) + ddq[joint] ** 2 / (2.0 * jerk[joint]))
    return math.sqrt(now), math.sqrt(max(now, crest)), total


@compiled
def tool_speed_after(heres: Records, way: Vector, dq: Vector) -> float:
    """Speed of the tool [m/s] at joint velocities dq (J,), once the joints have moved by `way` (J,)
    [rad, or m of a sliding joint].

    Exact, by the product of exponentials: joint i is a screw with axis w and moment u = o × w, or
    with w = 0 and direction u where it slides, as the Jacobian has them now. The joints before it
    carry both along, by (R, s) = exp(screw_1 way_1) ... exp(screw_(i-1) way_(i-1)):

        w' = R w,  u' = R u + s × w',  and with all joints  tool' = R tool + s

    and the speed is |sum dq (u' + w' × tool')|.
    """
    here, joints = heres[0], len(dq)
    jacobian, tool = here.jacobian, here.position
    rotation, shift, turned, moved = np.eye(3), np.zeros(3), np.empty((3, 3)), np.empty(3)
    linear, angular, axis, moment = np.zeros(3), np.zeros(3), np.empty(3), np.empty(3)
    own, own_shift = np.empty((3, 3)), np.empty(3)
    for j in range(joints):
        wx, wy, wz = jacobian[3, j], jacobian[4, j], jacobian[5, j]
        # moment about the origin: the tool's velocity less w × tool
        ux = jacobian[0, j] - (wy * tool[2] - wz * tool[1])
        uy = jacobian[1, j] - (wz * tool[0] - wx * tool[2])
        uz = jacobian[2, j] - (wx * tool[1] - wy * tool[0])
        for i in range(3):
            axis[i] = rotation[i, 0] * wx + rotation[i, 1] * wy + rotation[i, 2] * wz
            moment[i] = rotation[i, 0] * ux + rotation[i, 1] * uy + rotation[i, 2] * uz
        linear[0] += dq[j] * (moment[0] + shift[1] * axis[2] - shift[2] * axis[1])
        linear[1] += dq[j] * (moment[1] + shift[2] * axis[0] - shift[0] * axis[2])
        linear[2] += dq[j] * (moment[2] + shift[0] * axis[1] - shift[1] * axis[0])
        for i in range(3):
            angular[i] += dq[j] * axis[i]
        c, s = math.cos(way[j]), math.sin(way[j])
        turns = wx * wx + wy * wy + wz * wz > 0.5
        if not turns:
            c, s = 1.0, 0.0
        v = 1.0 - c
        own[0, 0], own[0, 1], own[0, 2] = c + v * wx * wx, v * wx * wy - s * wz, v * wx * wz + s * wy
        own[1, 0], own[1, 1], own[1, 2] = v * wx * wy + s * wz, c + v * wy * wy, v * wy * wz - s * wx
        own[2, 0], own[2, 1], own[2, 2] = v * wx * wz - s * wy, v * wy * wz + s * wx, c + v * wz * wz
        if turns:  # about the point o = w × u of the axis: o - own o
            ox, oy, oz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
            own_shift[0] = ox - (own[0, 0] * ox + own[0, 1] * oy + own[0, 2] * oz)
            own_shift[1] = oy - (own[1, 0] * ox + own[1, 1] * oy + own[1, 2] * oz)
            own_shift[2] = oz - (own[2, 0] * ox + own[2, 1] * oy + own[2, 2] * oz)
        else:
            own_shift[0], own_shift[1], own_shift[2] = ux * way[j], uy * way[j], uz * way[j]
        for i in range(3):
            moved[i] = shift[i]
            for k in range(3):
                moved[i] += rotation[i, k] * own_shift[k]
                turned[i, k] = rotation[i, 0] * own[0, k] + rotation[i, 1] * own[1, k] + rotation[i, 2] * own[2, k]
        rotation[:], shift[:] = turned, moved
    for i in range(3):
        moved[i] = rotation[i, 0] * tool[0] + rotation[i, 1] * tool[1] + rotation[i, 2] * tool[2] + shift[i]
    x = linear[0] + angular[1] * moved[2] - angular[2] * moved[1]
    y = linear[1] + angular[2] * moved[0] - angular[0] * moved[2]
    z = linear[2] + angular[0] * moved[1] - angular[1] * moved[0]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def joint_costs(arms: Records, heres: Records, out: Vector) -> None:
    """Into out (3, 3, J): what a tool velocity, acceleration and jerk cost of each joint's planned
    limit, by damped least squares that spare the joints with less of it; by order of the
    derivative, then by axis. The tool turns where that spares joints.
    """
    arm, here = arms[0], heres[0]
    joints = here.tasks.shape[1]
    scaled, root, right = np.empty((3, joints)), np.empty((3, 3)), np.empty(3)
    for order in range(3):
        for i in range(3):
            for joint in range(joints):
                scaled[i, joint] = here.tasks[i, joint] * arm.spared[order, joint]
        factorise(scaled, here.damping, root)
        for axis in range(3):
            right[:] = 0.0
            right[axis] = 1.0
            substitute(root, right)
            for joint in range(joints):
                moved = 0.0
                for i in range(3):
                    moved += scaled[i, joint] * right[i]
                out[order, axis, joint] = moved / arm.planned_limits[order, joint]


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
        linear[i] = min(max(goal.velocity[i], -FARTHEST), FARTHEST)
        error[i] = min(max(goal.position[i] - here.position[i], -FARTHEST), FARTHEST) - arm.period_s * linear[i]
        distance += error[i] * error[i]
    distance = math.sqrt(distance)
    # in proportion to the error when near, braking evenly from afar
    near = arm.closing_braking / arm.position_gain**2
    rate = arm.position_gain
    if distance > near:
        rate = min(math.sqrt(2.0 * arm.closing_braking * (distance - 0.5 * near)), arm.closing_speed) / distance
    excess = max(rate * distance - FAR_SPEED, 0.0)
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
        if min(low, high) < NEAR_LIMIT * arm.per_rad[j]:
            said |= NEAR
        bounds[0, j] = -arm.approach_gain[j] * max(low, 0.0) / scale[j]
        bounds[1, j] = arm.approach_gain[j] * max(high, 0.0) / scale[j]
        off, most = arm.posture[j] - here.joints[j], POSTURE_SPEED * arm.per_rad[j]
        if arm.is_continuous[j]:  # in whichever turn; 0 half a turn away, as no direction is shorter there
            off = math.sin(off)
        home[j] = min(max(POSTURE_GAIN * off, -most), most) / scale[j]
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
            brake = IDLE_BRAKE * arm.period_s * arm.acceleration[j]
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
    return said | SPEED if excess > 1.0 + ROUNDING else said


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
