"""The limiter's compiled step: see `stage` for the method."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.codes import FAULT
from service.core.frame import Records, Vector
from service.core.geometry import ROUND_TO, quaternion_of
from service.core.kinematics import tool_speed_after
from service.core.limiter.tuning import INSIDE_LIMIT_SHARE, LARGEST_USABLE, LEAST_CHANGE_RADPS, STOP_SAMPLES
from service.core.stops import braking_together, fastest_stop

BOUNDED = 1  # flag of a step: the wanted velocity was cut
CHASED = 2  # some joint cannot have it in a tick
UNSAFE = 4  # some joint could not have stopped after it
UNUSABLE = -1  # the state cannot be calculated with


@compiled
def step(state: Vector, velocity: Vector, parameters: Records, wanted: Vector, moved: Vector) -> int:
    """As `_toward`, and made safe where no joint is to be chased; UNUSABLE for such a state."""
    if not is_usable(state):
        return UNUSABLE
    met = _toward(state, velocity, parameters, wanted, moved)
    if not met & CHASED and not make_safe(state, moved, parameters):
        met |= UNSAFE
    return met


@compiled
def _toward(state: Vector, velocity: Vector, parameters: Records, wanted: Vector, moved: Vector) -> int:
    """Into `wanted` (2, J) the velocity within speed limits, slower near position limits, and as
    much of its acceleration, which it is given, as keeps it there; into `moved` (3, J) each joint
    one tick on at the jerk that reaches it, NaN where a limit forbids.

    A smooth input passes without lag: its ramps leave the acceleration as it is. A time-optimal
    profile, which ends without acceleration, would lag behind them by acceleration² / 2 jerk.
    """
    given, met, stopping = parameters[0], 0, False
    dt = given.period_s
    for i in range(len(velocity)):
        stopping = stopping or math.isnan(velocity[i]) or math.isnan(wanted[1, i])
    for i in range(len(velocity)):
        q, v, a = state[0, i], state[1, i], state[2, i]
        top, max_jerk = given.max_velocity[i], given.max_jerk[i]
        highest = min(top, given.approach_gain[i] * max(given.upper[i] - q, 0.0))
        lowest = max(-top, given.approach_gain[i] * min(given.lower[i] - q, 0.0))
        aim = 0.0 if stopping else min(max(velocity[i], lowest), highest)
        if aim != velocity[i]:
            met |= BOUNDED
        ramp = 0.0 if stopping else wanted[1, i]
        room = aim - lowest if ramp < 0.0 else highest - aim
        most = min(INSIDE_LIMIT_SHARE * given.max_acceleration[i], math.sqrt(2.0 * max_jerk * room))
        wanted[0, i], wanted[1, i] = aim, min(max(ramp, -most), most)
        acceleration = (aim - v) / dt
        v_then = v + 0.5 * dt * (a + acceleration)
        crest = v_then + acceleration * abs(acceleration) / (2.0 * max_jerk)  # when acceleration has come to 0
        outside = int(q > given.upper[i]) - int(q < given.lower[i])
        if (
            outside * crest <= 0.0
            and abs(acceleration - a) <= max_jerk * dt
            and abs(acceleration) <= given.max_acceleration[i]
            and max(abs(v_then), abs(crest)) <= top
        ):
            moved[0, i] = q + dt * (v + dt * (a / 3.0 + acceleration / 6.0))
            moved[1, i], moved[2, i] = v_then, acceleration
        else:
            moved[0, i] = moved[1, i] = moved[2, i] = math.nan
            met |= CHASED
    return met


@compiled
def forget_fast(state: Vector, moved: Vector, parameters: Records) -> bool:
    """Makes those joints of `moved` (3, J) NaN that pass their greatest speed on the way from where
    they are, or as their acceleration comes to 0; whether there are some.
    """
    given, found = parameters[0], False
    for i in range(moved.shape[1]):
        v, a, on_the_way = moved[1, i], moved[2, i], (moved[0, i] - state[0, i]) / given.period_s
        crest = v + a * abs(a) / (2.0 * given.max_jerk[i])
        if max(abs(v), abs(crest), abs(on_the_way)) > given.max_velocity[i]:
            found = True
            moved[0, i] = moved[1, i] = moved[2, i] = math.nan
    return found


@compiled
def common_share(state: Vector, parameters: Records) -> float:
    """The greatest share of the way to the wanted velocities, the last row of state (4, J), that
    all joints can go in a tick without passing these, as their acceleration comes to 0; -1: none.
    """
    given, least, most = parameters[0], 0.0, 1.0
    dt = given.period_s
    for i in range(state.shape[1]):
        way, change = state[3, i] - state[1, i], INSIDE_LIMIT_SHARE * dt * given.max_jerk[i]
        a = state[2, i] if way >= 0.0 else -state[2, i]
        way = max(abs(way), LEAST_CHANGE_RADPS)
        least = max(least, (a - change) * dt / way)
        most = min(most, min(a + change, INSIDE_LIMIT_SHARE * given.max_acceleration[i]) * dt / way)
        bend, left = way / (2.0 * change * dt), max(1.0 - 0.5 * dt * a / way, 0.0)
        most = min(most, (math.sqrt(0.25 + 4.0 * bend * left) - 0.5) / (2.0 * bend))
    return max(least, most) if most >= INSIDE_LIMIT_SHARE * least else -1.0


@compiled
def make_safe(state: Vector, moved: Vector, parameters: Records) -> bool:
    """Rounds the moved joints (3, J); those that could not stop within their position limits after
    it, or that are NaN, go on the fastest stop instead. Whether there were none.
    """
    given, safe, stop = parameters[0], True, np.empty(6)
    dt = given.period_s
    for i in range(moved.shape[1]):
        moved[0, i] = np.rint(moved[0, i] * ROUND_TO) / ROUND_TO
        fastest_stop(moved[1, i], moved[2, i], given.max_acceleration[i], given.max_jerk[i], dt, stop)
        lowest, highest = min(given.lower[i], state[0, i]), max(given.upper[i], state[0, i])
        if not (moved[0, i] + stop[3] >= lowest and moved[0, i] + stop[4] <= highest):
            safe = False
            fastest_stop(state[1, i], state[2, i], given.max_acceleration[i], given.max_jerk[i], dt, stop)
            moved[0, i] = np.rint((state[0, i] + stop[2]) * ROUND_TO) / ROUND_TO
            moved[1, i], moved[2, i] = stop[0], stop[1]
    return safe


@compiled
def is_usable(state: Vector) -> bool:
    """Whether a state (3, J) is finite, and small enough to calculate with: false for NaN too."""
    for row in state:
        for value in row:
            if not abs(value) < LARGEST_USABLE:
                return False
    return True


@compiled
def speed_in_stop(dq: Vector, ddq: Vector, heres: Records, parameters: Records) -> float:
    """Greatest speed [m/s] of the tool at STOP_SAMPLES times of a stop that lasts D, at

        t_k = D (k / STOP_SAMPLES)²,    k = 1 ... STOP_SAMPLES - 1,

    close together at its begin, where the joints end their accelerations.
    """
    given, joints = parameters[0], len(dq)
    braking, stop, way, speed = np.empty(joints), np.empty(6), np.empty(joints), np.empty(joints)
    braking_together(dq, ddq, given.max_acceleration, given.max_jerk, braking)
    duration = most = 0.0
    for j in range(joints):
        fastest_stop(dq[j], ddq[j], braking[j], given.max_jerk[j], 0.0, stop)
        duration = max(duration, stop[5])
    for sample in range(1, STOP_SAMPLES):
        for j in range(joints):
            time = duration * (sample / STOP_SAMPLES) ** 2
            fastest_stop(dq[j], ddq[j], braking[j], given.max_jerk[j], time, stop)
            speed[j], way[j] = stop[0], stop[2]
        most = max(most, tool_speed_after(heres, way, speed))
    return most


@compiled
def take(
    states: Records, frames: Records, heres: Records, position: Vector, velocity: Vector, acceleration: Vector
) -> bool:
    """Into state and frame the joints, and where they put the tool; whether they moved before."""
    state, frame, here, moving = states[0], frames[0], heres[0], False
    for joint in range(len(position)):
        moving = moving or state.joints[1, joint] != 0.0 or state.joints[2, joint] != 0.0
    state.joints[0, :], state.joints[1, :], state.joints[2, :] = position, velocity, acceleration
    frame.joints[:], frame.joint_velocities[:], frame.joint_accelerations[:] = position, velocity, acceleration
    frame.commanded = moving or (state.arm_ready and state.mode != FAULT)
    frame.tool[:] = here.position
    quaternion_of(here.rotation, frame.tool_orientation)
    return moving
