"""Compiled differential inverse kinematics of the arm.

A step minimises a strictly convex quadratic cost, with bounds on the speed of each joint toward its
limits. The solution is therefore unique and continuous in position and velocity: at unreachable
targets and near singular postures the arm slows down without chatter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kmp.compiled import compiled
from kmp.elementary import sin_cos
from thirdhand.core.arm.least_squares import solve
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.geometry import quaternion_of, swing, turn_between
from thirdhand.core.numerics import MAX_ERROR_M, MAX_JOINT_RAD, ROUNDING
from thirdhand.core.vectors import dot, norm, rounded, square

SPEED = 1  # flag of a step: the velocities were scaled down to a joint's speed limit
NEAR = 2  # flag of a step: a joint is near its position limit
SEPARATED = 4  # flag of a step: separation changed the velocities


@compiled
def stand(heres: Records, turns: NDArray[np.bool_], q: Vector) -> None:
    """Write joints q (J,) [rad, m], limited to ± MAX_JOINT_RAD, and their configuration: cosine and
    sine of each joint that `turns` (J,), the position of each other one.
    """
    kinematics = heres[0]
    entry = 0
    for joint in range(len(q)):
        position = min(max(q[joint], -MAX_JOINT_RAD), MAX_JOINT_RAD)
        kinematics.joints[joint] = kinematics.configuration[entry] = position
        if turns[joint]:
            sine, cosine = sin_cos(position)
            kinematics.configuration[entry] = cosine
            kinematics.configuration[entry + 1] = sine
            entry += 1
        entry += 1


@compiled
def describe(arms: Records, heres: Records, jacobian: Vector, pose: Vector) -> None:
    """Write Jacobian, position, rotation, task matrix and damping of the arm at some joints.

    With the tool's Jacobian (6, J) = (Jv; Jw), the rotation R (3, 3) of its `pose`, a homogeneous
    matrix (4, 4), and the turn lever l [m]:

        tasks (5 or 6, J) = (Jv; l R^T Jw)                row 5, if present, is the turn about +z
        damping [m²] = damping0 + singular_damping max(1 - sqrt(det(Jv Jv^T)) / singular_volume, 0)²
        singular_volume [m³] = sqrt(singular_damping) outer²

    So damping is added when the weakest direction has less of a lever than sqrt(singular_damping),
    if the two others have that of the outer radius of the reach.

    With 5 tasks, the last row of R^T Jw is left out.
    """
    arm = arms[0]
    kinematics = heres[0]
    joints = jacobian.shape[1]
    gram = np.empty((3, 3))
    tasks = kinematics.tasks
    kinematics.jacobian[:] = jacobian
    kinematics.position[:] = pose[:3, 3]
    kinematics.rotation[:] = pose[:3, :3]

    for joint in range(joints):
        for i in range(3):
            tasks[i, joint] = jacobian[i, joint]
        for i in range(len(tasks) - 3):
            turn = 0.0
            for k in range(3):
                turn += pose[k, i] * jacobian[3 + k, joint]
            tasks[3 + i, joint] = arm.turn_lever * turn

    # det(Jv Jv^T), and the damping
    for i in range(3):
        for j in range(3):
            total = 0.0
            for joint in range(joints):
                total += jacobian[i, joint] * jacobian[j, joint]
            gram[i, j] = total
    determinant = (
        gram[0, 0] * (gram[1, 1] * gram[2, 2] - gram[1, 2] ** 2)
        - gram[0, 1] * (gram[0, 1] * gram[2, 2] - gram[0, 2] * gram[1, 2])
        + gram[0, 2] * (gram[0, 1] * gram[1, 2] - gram[0, 2] * gram[1, 1])
    )
    shortage = max(1.0 - math.sqrt(max(determinant, 0.0)) / arm.singular_volume, 0.0)
    kinematics.damping = arm.damping + arm.singular_damping * shortage * shortage


@compiled
def _add_closing(forward: Vector, closing: Vector, most: float) -> None:
    """Add to `forward` (3,) [m/s] the largest share of the velocity `closing` within a speed limit.

        forward + share closing,    0 <= share <= 1,    norm <= most

    If `forward` alone exceeds `most`, it is first scaled down to it.
    """
    ff = square(forward)
    fc = dot(forward, closing)
    cc = square(closing)
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
    arms: Records,
    heres: Records,
    states: Records,
    goals: Records,
    constraints: Records,
    count: int,
    out: Vector,
) -> int:
    """Run `joint_step` toward the state's setpoint, with the state's joint velocities."""
    state = states[0]
    goal = goals[0]
    goal.position[:] = state.setpoint[0]
    goal.velocity[:] = state.setpoint[1]
    goal.orientation[:] = state.orientation
    goal.turning[:] = state.turning
    goal.acceleration[:] = state.setpoint[2]
    goal.moving[:] = state.joints[1]
    goal.horizon_s = arms[0].horizon_s
    return joint_step(arms, heres, goals, constraints, count, out)


@compiled
def joint_step(
    arms: Records, heres: Records, goals: Records, constraints: Records, count: int, out: Vector
) -> int:
    """Write joint velocities and accelerations into out (2, J) [rad/s, rad/s²]; return flags.

    The quadratic programme, with T = tasks S and S = diag(scale):

        minimise    |T x - (v; l R^T w)|² + damping |x - h|²
        subject to  -approach_gain max(q - lower, 0) <= S x <= approach_gain max(upper - q, 0)
                    row_k S x <= planned_k,    k < count        (separation)

        x (J,)      joint velocities divided by `scale`
        v (3,)      target velocity of the tool [m/s], see below
        w (3,)      target angular velocity of the tool [rad/s], from `_turn`
        l, R        turn lever [m] and rotation (3, 3) of the tool
        h (J,)      velocities toward the configured posture, at most posture_speed each
        damping     of `describe`, plus far_damping max(rate |e| - far_speed, 0)²

    With u the goal's velocity, e = goal position - position - period u, g the position gain and B
    the closing braking:

        v     = u + share rate e / (1 + g period),    0 <= share <= 1,    |v| <= max_tool_speed
        rate  = g                                                         if |e| <= B / g²
        rate  = min(sqrt(2 B (|e| - B / 2g²)), closing_speed) / |e|       otherwise

    If a row changed the solution, the programme is solved again with more damping, by
    singular_damping m / (m + constrained_speed²), where m = |v - T x|² in the first three rows of
    T: where few directions are left free, the least motion would change the solution much.

    If no row changed the solution, and the joints cannot reach its velocities soon (`_can_have`),
    `_turn_less` moves it toward that of the first three rows alone, in which idle joints brake.

    Finally all velocities are scaled down together to the speed limits. The accelerations minimise
    |T y - (goal acceleration)|² + damping |y|², in the first three rows, within the acceleration
    limits.
    """
    arm = arms[0]
    kinematics = heres[0]
    goal = goals[0]
    task_count, joints = kinematics.tasks.shape

    # The programme: what the tool shall do, what the joints can do, and what separation allows.
    wish = np.empty(task_count)
    damping = kinematics.damping + _wish(arm, kinematics, goal, wish)
    scaled = np.empty((task_count, joints))
    home = np.empty(joints)
    bounds = np.empty((2, joints))
    flags = _bound_joints(arm, kinematics, scaled, home, bounds)
    rows = np.empty((count, joints))
    limits = np.empty(count)
    _separate(arm, constraints, rows, limits)

    velocity = out[0]
    is_constrained = solve(scaled, wish, home, damping, bounds, rows, limits, velocity)
    if is_constrained:
        flags |= SEPARATED
        missing = _missing(scaled, wish, velocity)
        damping += (
            arm.singular_damping
            * missing
            / (missing + arm.constrained_speed * arm.constrained_speed)
        )
        solve(scaled, wish, home, damping, bounds, rows, limits, velocity)

    # If the joints cannot reach this soon, the turn is reduced, so that the position is kept. This
    # mixes two solutions, and a mixture need not keep separation's rows.
    is_reachable = _can_have(arm, goal, velocity)
    scaled[3:] = 0.0
    wish[3:] = 0.0
    if not is_reachable and not is_constrained:
        without_turn = np.empty(joints)
        _brake_idle(arm, goal, home)
        solve(scaled, wish, home, damping, bounds, rows, limits, without_turn)
        _turn_less(arm, goal, velocity, without_turn)
    excess = _excess(arm, velocity)

    # The accelerations: the same programme, without turn and separation.
    _wish_acceleration(arm, goal, wish, home, bounds)
    solve(scaled, wish, home, damping, bounds, rows[:0], limits[:0], out[1])

    for j in range(joints):
        speed = 0.0 if math.isnan(excess) else velocity[j] * arm.scale[j] / max(excess, 1.0)
        velocity[j] = rounded(speed)
        out[1, j] = rounded(out[1, j] * arm.scale[j])
    return flags | SPEED if excess > 1.0 + ROUNDING else flags


@compiled
def _separate(arm: Struct, constraints: Records, rows: Vector, limits: Vector) -> None:
    """Write the `rows` (K, J) of K constraints, times `scale`, and their `limits` (K,) [m/s]."""
    for k in range(len(rows)):
        limits[k] = constraints[k].planned
        for j in range(rows.shape[1]):
            rows[k, j] = constraints[k].row[j] * arm.scale[j]


@compiled
def _brake_idle(arm: Struct, goal: Struct, home: Vector) -> None:
    """Write the velocities (J,) of joints that brake, divided by `scale`."""
    for j in range(len(home)):
        brake = arm.idle_brake_share * arm.period_s * arm.acceleration[j]
        home[j] = (goal.moving[j] - min(max(goal.moving[j], -brake), brake)) / arm.scale[j]


@compiled
def _wish_acceleration(
    arm: Struct, goal: Struct, wish: Vector, home: Vector, bounds: Vector
) -> None:
    """Write the programme of the accelerations: the goal's for the tool, 0 for the joints, and the
    joints' limits, divided by `scale`.
    """
    wish[:3] = goal.acceleration
    home[:] = 0.0
    for j in range(len(home)):
        bounds[1, j] = arm.acceleration[j] / arm.scale[j]
        bounds[0, j] = -bounds[1, j]


@compiled
def _wish(arm: Struct, kinematics: Struct, goal: Struct, wish: Vector) -> float:
    """Write the target velocities (v; l R^T w) of `joint_step`; return the damping far from the
    goal.
    """
    linear = np.empty(3)
    error = np.empty(3)
    for i in range(3):
        linear[i] = min(max(goal.velocity[i], -MAX_ERROR_M), MAX_ERROR_M)
        error[i] = min(max(goal.position[i] - kinematics.position[i], -MAX_ERROR_M), MAX_ERROR_M)
        error[i] -= arm.period_s * linear[i]

    # The rate is constant for small errors; large ones are closed at constant deceleration.
    distance = norm(error)
    near_m = arm.closing_braking / arm.position_gain**2
    rate = arm.position_gain
    if distance > near_m:
        speed = math.sqrt(2.0 * arm.closing_braking * (distance - 0.5 * near_m))
        rate = min(speed, arm.closing_speed) / distance
    for i in range(3):  # implicit step: in proportion to the error at the end of the period
        error[i] *= rate / (1.0 + arm.position_gain * arm.period_s)
    _add_closing(linear, error, arm.max_tool_speed)

    turn = np.empty(3)
    turn_rows = len(wish) - 3
    _turn(arm, kinematics.rotation, goal.orientation, goal.turning, turn_rows == 3, turn)
    wish[:3] = linear
    wish[3:] = 0.0
    for i in range(turn_rows):
        for k in range(3):
            wish[3 + i] += arm.turn_lever * kinematics.rotation[k, i] * turn[k]
    excess = max(rate * distance - arm.far_speed, 0.0)
    far_damping: float = arm.far_damping * excess * excess
    return far_damping


@compiled
def _bound_joints(
    arm: Struct, kinematics: Struct, scaled: Vector, home: Vector, bounds: Vector
) -> int:
    """Write T (N, J), h (J,) and the bounds (2, J) on x of `joint_step`; return NEAR if a joint is
    near its limit, else 0.
    """
    flags = 0
    for j in range(len(home)):
        below = kinematics.joints[j] - arm.lower[j]
        above = arm.upper[j] - kinematics.joints[j]
        if min(below, above) < arm.near_limit_rad * arm.per_rad[j]:
            flags = NEAR
        bounds[0, j] = -arm.approach_gain[j] * max(below, 0.0) / arm.scale[j]
        bounds[1, j] = arm.approach_gain[j] * max(above, 0.0) / arm.scale[j]

        # Any number of turns away; 0 at half a turn, where no direction is shorter.
        error = arm.posture[j] - kinematics.joints[j]
        if arm.is_continuous[j]:
            error, _ = sin_cos(error)
        max_speed = arm.posture_speed * arm.per_rad[j]
        home[j] = min(max(arm.posture_gain * error, -max_speed), max_speed) / arm.scale[j]
        for i in range(len(scaled)):
            scaled[i, j] = kinematics.tasks[i, j] * arm.scale[j]
    return flags


@compiled
def _missing(tasks: Vector, wanted: Vector, x: Vector) -> float:
    """Squared error [m²/s²] of the tool's velocity at x (J,): |wanted - tasks x|², linear rows."""
    total = 0.0
    for i in range(3):
        lacks = wanted[i]
        for j in range(len(x)):
            lacks -= tasks[i, j] * x[j]
        total += lacks * lacks
    return total


@compiled
def _excess(arm: Struct, out: Vector) -> float:
    """Largest ratio of a joint's speed to its limit; NaN if a velocity is not finite."""
    excess = 0.0
    for j in range(len(out)):
        if not math.isfinite(out[j]):
            return math.nan
        excess = max(excess, abs(out[j] * arm.scale[j]) / arm.max_velocity[j])
    return excess


@compiled
def _can_have(arm: Struct, goal: Struct, out: Vector) -> bool:
    """True if the joints can reach the velocities of a solution (J,) within horizon_s.

    |S x| <= max_velocity    and    |S x - moving| <= horizon_s acceleration
    """
    for j in range(len(out)):
        velocity = out[j] * arm.scale[j]
        change = goal.horizon_s * arm.acceleration[j]
        if abs(velocity) > arm.max_velocity[j] or abs(velocity - goal.moving[j]) > change:
            return False
    return True


@compiled
def _turn_less(arm: Struct, goal: Struct, out: Vector, free: Vector) -> None:
    """Move a solution x (J,) toward `free` (J,) until the joints can reach its velocities.

        x = free + share (x - free)

    with the largest share in 0 ... 1 at which each joint is within the velocities that it can reach
    in horizon_s, or no further outside than at `free`. `free` is the solution in which the tool may
    turn as it likes.
    """
    share = 1.0
    for j in range(len(out)):
        free_velocity = free[j] * arm.scale[j]
        more = (out[j] - free[j]) * arm.scale[j]
        change = goal.horizon_s * arm.acceleration[j]
        top = arm.max_velocity[j]
        low = min(max(-top, goal.moving[j] - change), free_velocity)
        high = max(min(top, goal.moving[j] + change), free_velocity)
        if free_velocity + more > high:
            share = min(share, (high - free_velocity) / more)
        elif free_velocity + more < low:
            share = min(share, (low - free_velocity) / more)
    for j in range(len(out)):
        out[j] = free[j] + share * (out[j] - free[j])


@compiled
def _turn(
    arm: Struct, rotation: Vector, orientation: Vector, turning: Vector, about: bool, out: Vector
) -> None:
    """Write into out (3,) [rad/s] the angular velocity that turns the tool to an orientation (4,).

        turn_gain e + turning, scaled down to max_turn_speed

    e (3,) [rad] is the rotation vector to the orientation or, unless `about` is set, the shortest
    turn of +z to its +z. The result is 0 if it is not finite.
    """
    quaternion = np.empty(4)
    max_speed = arm.max_turn_speed
    if about:
        quaternion_of(rotation, quaternion)
        turn_between(quaternion, orientation, out)
    else:
        swing(rotation[:, 2].copy(), orientation, out)
    for i in range(3):
        out[i] = arm.turn_gain * out[i] + turning[i]
    turn = square(out)
    if not turn < math.inf:
        out[:] = 0.0
    elif turn > max_speed * max_speed:
        for i in range(3):
            out[i] *= max_speed / math.sqrt(turn)
