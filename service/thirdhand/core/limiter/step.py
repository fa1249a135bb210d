"""Compiled step of the limiter: `stage` describes the method."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import FAULT
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.geometry import quaternion_of
from thirdhand.core.kinematics import tool_speed_after
from thirdhand.core.numerics import INSIDE_LIMIT_SHARE, LARGEST_USABLE, ROUNDING, STOP_SAMPLES
from thirdhand.core.stops import braking_together, fastest_stop
from thirdhand.core.vectors import rounded

BOUNDED = 1  # flag of a step: a wanted velocity was limited
CHASED = 2  # flag of a step: a joint cannot reach its velocity in a tick at constant jerk
# flag of a step: a joint could not stop within its limits after the step, so it stops now
UNSAFE = 4
UNUSABLE = -1  # result of a step: the state is not finite, or too large


@compiled
def step(
    state: Vector, velocity: Vector, parameters: Records, wanted: Vector, moved: Vector
) -> int:
    """Run `_toward`, and `make_safe` if no joint needs Ruckig's profile; return the flags.

    Returns UNUSABLE, and changes nothing, if the state cannot be calculated with.
    """
    if not is_usable(state):
        return UNUSABLE
    met = _toward(state, velocity, parameters[0], wanted, moved)
    if not met & CHASED and not make_safe(state, moved, parameters):
        met |= UNSAFE
    return met


@compiled
def _toward(state: Vector, velocity: Vector, config: Struct, wanted: Vector, moved: Vector) -> int:
    """Move each joint one period toward its wanted velocity at constant jerk; return flags.

    With q, v, a of a joint, u its wanted velocity and r the ramp of u (wanted[1] on entry):

        lowest  = max(-max_velocity, approach_gain min(lower - q, 0))
        highest = min( max_velocity, approach_gain max(upper - q, 0))
        aim     = u, limited to lowest ... highest
        ramp    = r, limited to ± min(max_acceleration, sqrt(2 max_jerk margin))
        a' = (aim - v) / dt,    jerk = (a' - a) / dt
        v' = v + dt (a + a') / 2
        q' = q + dt v + dt² (a / 3 + a' / 6)

    margin is the distance [rad/s] of aim from `highest` (from `lowest` for a negative ramp).
    `wanted` (2, J) receives aim and ramp; `moved` (3, J) receives q', v', a', or NaN where jerk,
    acceleration, speed, or the speed once a' has been brought to 0, exceed a limit (CHASED).
    Outside of the position limits that speed must point inward. A NaN among u or r requests a stop
    of all joints.

    A smooth input passes without lag: on a ramp, a' = a and v' = aim. A time-optimal profile that
    ends without acceleration would lag behind it by acceleration² / 2 jerk.
    """
    met = 0
    stopping = False
    dt = config.period_s
    for i in range(len(velocity)):
        stopping = stopping or math.isnan(velocity[i]) or math.isnan(wanted[1, i])
    for i in range(len(velocity)):
        q = state[0, i]
        v = state[1, i]
        a = state[2, i]
        top = config.max_velocity[i]
        max_jerk = config.max_jerk[i]

        highest = min(top, config.approach_gain[i] * max(config.upper[i] - q, 0.0))
        lowest = max(-top, config.approach_gain[i] * min(config.lower[i] - q, 0.0))
        aim = 0.0 if stopping else min(max(velocity[i], lowest), highest)
        if aim != velocity[i]:
            met |= BOUNDED
        ramp = 0.0 if stopping else wanted[1, i]
        margin = aim - lowest if ramp < 0.0 else highest - aim
        most = min(
            INSIDE_LIMIT_SHARE * config.max_acceleration[i], math.sqrt(2.0 * max_jerk * margin)
        )
        wanted[0, i] = aim
        wanted[1, i] = min(max(ramp, -most), most)

        acceleration = (aim - v) / dt
        v_then = v + 0.5 * dt * (a + acceleration)
        # speed once the acceleration is 0
        crest = v_then + acceleration * abs(acceleration) / (2.0 * max_jerk)
        outside = int(q > config.upper[i]) - int(q < config.lower[i])
        if (
            outside * crest <= 0.0
            and abs(acceleration - a) <= max_jerk * dt
            and abs(acceleration) <= config.max_acceleration[i]
            and max(abs(v_then), abs(crest)) <= top
        ):
            moved[0, i] = q + dt * (v + dt * (a / 3.0 + acceleration / 6.0))
            moved[1, i] = v_then
            moved[2, i] = acceleration
        else:
            moved[0, i] = moved[1, i] = moved[2, i] = math.nan
            met |= CHASED
    return met


@compiled
def forget_fast(state: Vector, moved: Vector, parameters: Records) -> bool:
    """Set the joints of `moved` (3, J) that exceed their speed limit to NaN; True if there are any.

    The velocity counts at the end of the period, on average over it, and once the acceleration has
    been brought to 0.
    """
    config = parameters[0]
    is_fast = False
    for i in range(moved.shape[1]):
        v = moved[1, i]
        a = moved[2, i]
        on_the_way = (moved[0, i] - state[0, i]) / config.period_s
        crest = v + a * abs(a) / (2.0 * config.max_jerk[i])
        if max(abs(v), abs(crest), abs(on_the_way)) > config.max_velocity[i]:
            is_fast = True
            moved[0, i] = moved[1, i] = moved[2, i] = math.nan
    return is_fast


@compiled
def common_share(state: Vector, parameters: Records) -> float:
    """Largest share of the change of velocity that all joints can make in a tick; -1 for none.

    `state` (4, J): position, velocity v, acceleration a, wanted velocity u. With d = u - v, a taken
    positive along d, and a' = share |d| / dt the acceleration after the tick, each joint needs

        a - max_jerk dt <= a' <= min(a + max_jerk dt, max_acceleration)
        dt (a + a') / 2 + a'² / (2 max_jerk) <= |d|,    so that it does not pass u

    and 0 <= share <= 1.
    """
    config = parameters[0]
    least = 0.0
    most = 1.0
    dt = config.period_s
    for i in range(state.shape[1]):
        change = state[3, i] - state[1, i]
        jerk_change = INSIDE_LIMIT_SHARE * dt * config.max_jerk[i]
        a = state[2, i] if change >= 0.0 else -state[2, i]
        change = max(abs(change), ROUNDING)
        least = max(least, (a - jerk_change) * dt / change)
        most = min(
            most,
            min(a + jerk_change, INSIDE_LIMIT_SHARE * config.max_acceleration[i]) * dt / change,
        )
        curvature = change / (2.0 * jerk_change * dt)
        left = max(1.0 - 0.5 * dt * a / change, 0.0)
        most = min(most, (math.sqrt(0.25 + 4.0 * curvature * left) - 0.5) / (2.0 * curvature))
    return max(least, most) if most >= INSIDE_LIMIT_SHARE * least else -1.0


@compiled
def make_safe(state: Vector, moved: Vector, parameters: Records) -> bool:
    """Round the positions, and replace the step of each joint that could not stop after it.

    A step is replaced if the stop after it would leave the position limits, or if it is NaN. In
    `moved` (3, J) the joint then moves along its fastest stop from `state`. For a joint outside of
    its limits, its position is the limit.

    Returns True if no joint was replaced.
    """
    config = parameters[0]
    safe = True
    stop = np.empty(6)
    dt = config.period_s
    for i in range(moved.shape[1]):
        moved[0, i] = rounded(moved[0, i])
        fastest_stop(
            moved[1, i], moved[2, i], config.max_acceleration[i], config.max_jerk[i], dt, stop
        )
        lowest = min(config.lower[i], state[0, i])
        highest = max(config.upper[i], state[0, i])
        if not (moved[0, i] + stop[3] >= lowest and moved[0, i] + stop[4] <= highest):
            safe = False
            fastest_stop(
                state[1, i], state[2, i], config.max_acceleration[i], config.max_jerk[i], dt, stop
            )
            moved[0, i] = rounded(state[0, i] + stop[2])
            moved[1, i] = stop[0]
            moved[2, i] = stop[1]
    return safe


@compiled
def is_usable(state: Vector) -> bool:
    """True if all numbers of a state (3, J) are finite and smaller than LARGEST_USABLE."""
    for row in state:
        for value in row:
            if not abs(value) < LARGEST_USABLE:
                return False
    return True


@compiled
def speed_in_stop(dq: Vector, ddq: Vector, heres: Records, parameters: Records) -> float:
    """Largest speed [m/s] of the tool at STOP_SAMPLES - 1 times of a stop with the duration D:

        t_k = D (k / STOP_SAMPLES)²,    k = 1 ... STOP_SAMPLES - 1

    The times are dense at the beginning, where the joints end their accelerations.
    """
    config = parameters[0]
    joints = len(dq)
    braking = np.empty(joints)
    stop = np.empty(6)
    displacement = np.empty(joints)
    speed = np.empty(joints)
    braking_together(dq, ddq, config.max_acceleration, config.max_jerk, braking)
    duration = most = 0.0
    for j in range(joints):
        fastest_stop(dq[j], ddq[j], braking[j], config.max_jerk[j], 0.0, stop)
        duration = max(duration, stop[5])
    for sample in range(1, STOP_SAMPLES):
        for j in range(joints):
            time = duration * (sample / STOP_SAMPLES) ** 2
            fastest_stop(dq[j], ddq[j], braking[j], config.max_jerk[j], time, stop)
            speed[j] = stop[0]
            displacement[j] = stop[2]
        most = max(most, tool_speed_after(heres[0], displacement, speed))
    return most


@compiled
def take(
    states: Records,
    frames: Records,
    heres: Records,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
) -> bool:
    """Write the new joints into state and frame, and the tool's pose into the frame.

    Returns True if the joints moved before.
    """
    state = states[0]
    frame = frames[0]
    kinematics = heres[0]
    moving = False
    for joint in range(len(position)):
        moving = moving or state.joints[1, joint] != 0.0 or state.joints[2, joint] != 0.0
    state.joints[0, :] = position
    state.joints[1, :] = velocity
    state.joints[2, :] = acceleration
    frame.joints[:] = position
    frame.joint_velocities[:] = velocity
    frame.joint_accelerations[:] = acceleration
    frame.commanded = moving or (state.arm_ready and state.mode != FAULT)
    frame.tool[:] = kinematics.position
    quaternion_of(kinematics.rotation, frame.tool_orientation)
    return moving
