"""Compiled step of the setpoint: `stage` describes the method, `bounds` the bounds it keeps."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import BROKEN, PLANNED, STOPPED
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.kinematics import joint_costs
from thirdhand.core.numerics import LEAST_SPEED_MPS
from thirdhand.core.setpoint.bounds import (
    between,
    broken_bound,
    remember,
    stopping,
    take_safe,
)
from thirdhand.core.setpoint.orientation import turn_orientation
from thirdhand.core.vectors import distance, norm


@compiled
def slow_down(setpoint: Vector, tool: Vector, share: float, config: Struct) -> float:
    """Share of max_speed [m/s] that a setpoint (3, 3) may use while its tool (3,) [m] is behind.

        1 / (1 + max(0, |setpoint - tool| - gap_free_m) / gap_slow_m)

    It is 1 if the setpoint moves toward its tool. If separation allows only a share < 1 of the
    setpoint's speed, the result is at most share |v| / max_speed.
    """
    along = gap = 0.0
    for i in range(3):
        ahead = setpoint[0, i] - tool[i]
        along += ahead * setpoint[1, i]
        gap += ahead * ahead
    slow = (
        1.0
        if along <= 0.0
        else 1.0 / (1.0 + max(0.0, math.sqrt(gap) - config.gap_free_m) / config.gap_slow_m)
    )
    if share < 1.0:
        slow = min(slow, share * norm(setpoint[1]) / config.max_speed)
    return slow


@compiled
def lead(
    states: Records,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    parameters: Records,
    box: Vector,
    costs: Vector,
    slow: float,
) -> int:
    """Move the position setpoint of the state one period on; see `SetpointGenerator.step`.

    The tracker's jerk j is constant over the period dt:

        x' = x + v dt + a dt² / 2 + j dt³ / 6
        v' = v + a dt + j dt² / 2
        a' = a + j dt

    `take_safe` accepts this step or replaces it by the fall-back.
    """
    state = states[0]
    config = parameters[0]
    setpoint = state.setpoint
    target = np.empty((3, 3))
    before = setpoint.copy()
    target[0] = position
    target[1] = velocity
    target[2] = acceleration
    state.hull_ticks = remember(state.hull, state.hull_ticks, position, config.span_ticks)

    jerk = np.empty(3)
    ahead = np.empty((3, 3))
    dt = config.period_s
    met = _track(setpoint, target, config, costs, slow, box, jerk)
    for i in range(3):
        x = setpoint[0, i]
        v = setpoint[1, i]
        a = setpoint[2, i]
        j = jerk[i]
        ahead[0, i] = x + dt * (v + dt * (a / 2.0 + dt * j / 6.0))
        ahead[1, i] = v + dt * (a + dt * j / 2.0)
        ahead[2, i] = a + dt * j

    if not take_safe(setpoint, ahead, config, costs, slow, state.hull, box):
        met = STOPPED
    if broken_bound(setpoint, before, state.hull, box, config):
        setpoint[:] = before
        return BROKEN
    return met


@compiled
def _track(
    setpoint: Vector,
    target: Vector,
    config: Struct,
    costs: Vector,
    slow: float,
    box: Vector,
    jerk: Vector,
) -> int:
    """Write the tracker's jerk (3,) [m/s³], reduced along the motion where a barrier requires it.

    The tracker, with gains k (5,) of `tracker_gains` and φ = min(1, V / |v target|):

        jerk = k0 (x target - x) + k1 φ v target + k2 a target + k3 v + k4 a

    Without k2 if φ < 1: accelerations of a target beyond the speed limit are not followed.

    `_approach_sides` and `_limit_jerk` limit this. Then the jerk along the velocity is reduced
    until h' >= retained h for each of three barriers, where h' is the value of h one period later.
    Along the unit vector of the velocity:

        v, a      speed and acceleration of the setpoint
        w         distance to the target
        v_t, a_t  speed, φ v target, and acceleration of the target
        B, C      deceleration and jerk that are planned with, within the limits of tool and joints
        top       speed that is planned with, `slow` times the limit of tool and joints

        stop      h = w + o - stop_distance(v, a, B, C)
                  o    = stop_overshoot_m + stop_room v_p² / (2 hand_brake_mps2)
                  v_p  = max(0, v_t + deceleration_lookahead_s min(a_t, 0))    predicted speed
        meeting   h = w + stop_overshoot_m - stop_distance(v - v_t, a - a_t, M, C)
                  M = max(B + min(a_t, 0), meeting_brake_least_share B)
        speed     h = top - (v + a |a| / 2C)

        retained = 1 - min(barrier_rate_per_s dt, barrier_time_s / dt)

    In the stop, w grows by min(v_p, v) dt in a period. The meeting applies only while the setpoint
    is faster than its target. The jerk is at least -C and, for stop and meeting, at least the one
    with which the setpoint just comes to rest; below that one it would reverse.

    Returns PLANNED if a barrier reduced the jerk, else 0.
    """
    speed = norm(setpoint[1])
    feasible = _feasible_share(target[1], config.max_speed)
    _tracking_jerk(setpoint, target, config, feasible, jerk)
    _approach_sides(setpoint, config, box, jerk)
    _limit_jerk(jerk, setpoint[2], config, costs)
    if speed <= LEAST_SPEED_MPS:
        return 0

    # Along the velocity: how setpoint and target move.
    along = np.empty(3)
    a = tracking = distance = target_speed = target_a = 0.0
    for i in range(3):
        along[i] = setpoint[1, i] / speed
        a += along[i] * setpoint[2, i]
        tracking += along[i] * jerk[i]
        distance += along[i] * (target[0, i] - setpoint[0, i])
        target_speed += along[i] * feasible * target[1, i]
        target_a += along[i] * target[2, i]
    motion = (speed, a, tracking)
    target_motion = (distance, target_speed, target_a)
    reduced = _barriers(motion, target_motion, along, config, costs, slow)
    if reduced >= tracking:
        return 0
    for i in range(3):
        jerk[i] += (reduced - tracking) * along[i]
    _limit_jerk(jerk, setpoint[2], config, costs)
    return PLANNED


@compiled
def _feasible_share(velocity: Vector, max_speed: float) -> float:
    """The share φ of a velocity (3,) [m/s] that is within the speed limit."""
    speed = norm(velocity)
    return min(1.0, max_speed / speed) if speed > 0.0 else 1.0


@compiled
def _tracking_jerk(
    setpoint: Vector, target: Vector, config: Struct, feasible: float, jerk: Vector
) -> None:
    """Write the tracker's jerk (3,) [m/s³], see `_track`."""
    gains = config.gains
    for i in range(3):
        jerk[i] = gains[0] * (target[0, i] - setpoint[0, i]) + gains[1] * feasible * target[1, i]
        if feasible == 1.0:  # accelerations of a target beyond the speed limit are not followed
            jerk[i] += gains[2] * target[2, i]
        jerk[i] += gains[3] * setpoint[1, i] + gains[4] * setpoint[2, i]


@compiled
def _barriers(
    motion: tuple[float, float, float],
    target_motion: tuple[float, float, float],
    along: Vector,
    config: Struct,
    costs: Vector,
    slow: float,
) -> float:
    """The jerk [m/s³] along the velocity that the barriers of `_track` leave.

    `motion` has speed, acceleration and tracking jerk of the setpoint along the unit vector `along`
    (3,); `target_motion` has distance, speed and acceleration of the target.
    """
    dt = config.period_s
    speed, a, tracking = motion
    distance, target_speed, target_a = target_motion

    # What is planned with, within the limits of tool and joints.
    share = config.planned_brake_share
    brake = share * min(config.max_acceleration, _joint_limit(costs[1], along))
    change = share * min(config.stop_jerk, _joint_limit(costs[2], along))
    change = min(change, config.stop_jerk_error_m * config.gains[0])
    top = slow * config.planned_speed_share * min(config.max_speed, _joint_limit(costs[0], along))

    # Below the jerk `lowest`, the setpoint would still decelerate at rest, and reverse.
    coasting_now = _coasting(speed, a, 0.0, change, 0.0)
    coasting_least = _coasting(speed, a, -change, change, dt)
    lowest = between(
        tracking, -change, _coasting(speed, a, tracking, change, dt), coasting_least, 0.0
    )
    retained = 1.0 - min(config.barrier_rate_per_s * dt, config.barrier_time_s / dt)

    # Stop: the setpoint can stop where the target will.
    predicted_speed = max(0.0, target_speed + config.deceleration_lookahead_s * min(target_a, 0.0))
    overshoot = config.stop_overshoot_m + config.stop_room * predicted_speed * predicted_speed / (
        2.0 * config.hand_brake_mps2
    )
    gap = distance + overshoot
    closing = min(predicted_speed, speed) * dt
    jerk = stopping(gap, closing, speed, a, (brake, change), (tracking, lowest), retained, dt)

    # Meeting: a faster setpoint slows down to the speed of its target.
    faster_by = speed - target_speed
    a_faster_by = a - target_a
    if faster_by > 0.0 and _coasting(faster_by, a_faster_by, 0.0, change, 0.0) > 0.0:
        meeting = max(brake + min(target_a, 0.0), config.meeting_brake_least_share * brake)
        gap = distance + config.stop_overshoot_m
        jerk = stopping(
            gap, 0.0, faster_by, a_faster_by, (meeting, change), (jerk, lowest), retained, dt
        )

    # Speed: the speed after the acceleration has ended stays below the limit.
    limit = top - retained * (top - coasting_now)
    return between(jerk, -change, _coasting(speed, a, jerk, change, dt), coasting_least, limit)


@compiled
def _joint_limit(costs: Vector, along: Vector) -> float:
    """The limit of the joints for one derivative of the tool's motion along a direction (3,)."""
    return 1.0 / max(_largest(costs, along), 1e-9)


@compiled
def _approach_sides(setpoint: Vector, config: Struct, box: Vector, jerk: Vector) -> None:
    """Limit the jerk (3,) so that the setpoint approaches the workspace's sides without passing.

    With h the distance to the side, (d/dt + p)³ h >= 0, that is

        jerk <= p³ h - 3 p² velocity - 3 p acceleration,    p = -gains[4] / 2.

    A setpoint whose target lies on a side then comes to rest there. Without this limit, the tracker
    would pass its target a little, begin the fastest stop each time, and oscillate. Beyond a side,
    h is 0: the setpoint moves no farther out, and its targets bring it back.
    """
    p = -0.5 * config.gains[4]
    for i in range(3):
        x = setpoint[0, i]
        v = setpoint[1, i]
        a = setpoint[2, i]
        damping = -3.0 * p * (p * v + a)
        highest = max(p * p * p * max(box[1, i] - x, 0.0) + damping, -config.stop_jerk)
        lowest = min(
            p * p * p * min(max(box[0, i], config.lowest[i]) - x, 0.0) + damping, config.stop_jerk
        )
        jerk[i] = min(max(jerk[i], min(lowest, highest)), max(lowest, highest))


@compiled
def _coasting(speed: float, a: float, jerk: float, change: float, dt: float) -> float:
    """Speed [m/s] when the acceleration has come to 0, after a period dt at a constant jerk.

    v + dt (a + dt jerk / 2) + a' |a'| / (2 change),    a' = a + dt jerk
    """
    a_end = a + dt * jerk
    return speed + dt * (a + 0.5 * dt * jerk) + a_end * abs(a_end) / (2.0 * change)


@compiled
def _largest(costs: Vector, motion: Vector) -> float:
    """Largest share of a joint's limit that a tool motion (3,) needs: max over j |motion · cost_j|.

    `costs` (3, J): share of each joint's limit for a unit of motion along each axis.
    """
    largest = 0.0
    for joint in range(costs.shape[1]):
        needed = (
            costs[0, joint] * motion[0] + costs[1, joint] * motion[1] + costs[2, joint] * motion[2]
        )
        largest = max(largest, abs(needed))
    return largest


@compiled
def _limit_jerk(jerk: Vector, acceleration: Vector, config: Struct, costs: Vector) -> None:
    """Scale the jerk (3,) down to the limits of tool and joints, in place.

    First the acceleration after the period, a + dt jerk, is scaled to its limits, which gives the
    jerk; then the jerk itself is scaled to its own.
    """
    ahead = np.empty(3)
    dt = config.period_s
    for i in range(3):
        ahead[i] = acceleration[i] + dt * jerk[i]
    excess = max(norm(ahead) / config.max_acceleration, _largest(costs[1], ahead))
    if excess > 1.0:
        for i in range(3):
            jerk[i] = (ahead[i] / excess - acceleration[i]) / dt
    excess = max(norm(jerk) / config.max_jerk, _largest(costs[2], jerk))
    if excess > 1.0:
        for i in range(3):
            jerk[i] /= excess


@compiled
def ready(
    states: Records, heres: Records, arms: Records, parameters: Records, share: float, costs: Vector
) -> tuple[float, float]:
    """Write the `joint_costs` of tool motion. Returns the share of speed that `slow_down` allows,
    and the setpoint's distance from the tool [m].
    """
    joint_costs(arms, heres, costs)
    setpoint = states[0].setpoint
    tool = heres[0].position
    return slow_down(setpoint, tool, share, parameters[0]), distance(setpoint[0], tool)


@compiled
def finish(states: Records, frames: Records, parameters: Records) -> None:
    """Turn the orientation setpoint for one period, and write the setpoints into the frame."""
    state = states[0]
    frame = frames[0]
    turn_orientation(state.orientation, state.turning, frame.orientation, frame.turning, parameters)
    write(states, frames)


@compiled
def write(states: Records, frames: Records) -> None:
    """Write the state's setpoints and gripper into the frame."""
    state = states[0]
    frame = frames[0]
    frame.setpoint[:] = state.setpoint[0]
    frame.setpoint_velocity[:] = state.setpoint[1]
    frame.setpoint_acceleration[:] = state.setpoint[2]
    frame.setpoint_orientation[:] = state.orientation
    frame.setpoint_turning[:] = state.turning
    frame.gripper = state.gripper
