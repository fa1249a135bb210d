"""The last stage: joint commands that hold every limit, whatever is wanted.

Each joint moves by one tick at constant jerk toward the wanted velocity where its limits leave room
for that, and by Ruckig's time-optimal profile where they do not. That profile ends on the ramp by
which the wanted velocity goes on: one that ended at rest on it would be late all along the ramp. A
step is taken only if a stop after it stays within the position limits; else the joint stops now. As
the step before was taken on the same condition, that stop is feasible too: the limits hold by
induction, for any sequence of wanted velocities.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import ruckig

from kmp.compiled import compiled
from service.config import JointSettings, Settings
from service.core.arm.arm import MARGIN, Arm, Kinematics, approach_gain
from service.core.arm.inverse_kinematics import tool_speed_after, tool_speeds
from service.core.decision.decision import FAULT
from service.core.frame import Record, Records, Vector, as_array, parameters
from service.core.geometry import quaternion_of
from service.core.separation.separation import Separation
from service.core.setpoint.bounds import braking_together, fastest_stop, stop_together

ROUND_TO = 1e9  # [1/rad] of the positions: machines that differ in the last bits agree
LARGEST = 1e6  # of any number of a state that is calculated with
BOUNDED = 1  # flag of a step: the wanted velocity was cut
CHASED = 2  # some joint cannot have it in a tick
UNSAFE = 4  # some joint could not have stopped after it
STOP_SAMPLES = 16  # times along a stop at which the tool's speed is checked
LEAST_CHANGE = 1e-12  # [rad/s] of a velocity: what is less is rounding
INSIDE = 1.0 - 1e-9  # of limits, that rounding leaves them kept
UNUSABLE = -1  # the state cannot be calculated with


class Limited(NamedTuple):
    """The joints one period later, (J,) each [rad, rad/s, rad/s²]; whether a limit kept them from
    what was wanted.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    limited: bool


class Limiter:
    """Position, velocity, acceleration and jerk limits of J joints.

    Keeps nothing from tick to tick: it continues bit for bit from its output. The limits hold from
    any state that a stop can still save. A joint at rest outside its position limits may move
    inwards only; one that comes faster than its limits is brought back into them as jerk allows.
    """

    def __init__(self, limits: JointSettings, period_s: float) -> None:
        self._period = period_s
        self._parameters = parameters(
            period_s=period_s,
            lower=np.array(limits.lower) + MARGIN,
            upper=np.array(limits.upper) - MARGIN,
            max_velocity=np.array(limits.velocity) * (1.0 - 1e-12),  # leaves room for rounding
            max_acceleration=np.array(limits.acceleration, np.float64),
            max_jerk=np.array(limits.jerk, np.float64),
            approach_gain=approach_gain(limits),
        )
        count = len(limits.velocity)
        self._ruckig = ruckig.Ruckig(count)
        self._input = ruckig.InputParameter(count)
        self._input.control_interface = ruckig.ControlInterface.Velocity
        self._input.target_velocity = [0.0] * count
        self._input.synchronization = ruckig.Synchronization.No
        self._input.max_velocity = list(limits.velocity)
        self._input.max_jerk = list(limits.jerk)
        self._trajectory = ruckig.Trajectory(count)

    def step(self, q: Vector, dq: Vector, ddq: Vector, velocity: Vector, acceleration: Vector | None = None) -> Limited:
        """The joints one period later on the way to `velocity`, which goes on by
        `acceleration`, or stays; all (J,) [rad, rad/s, rad/s²].

        A NaN in either means stop. A state that is not finite stays as it is, at velocity 0.
        Never raises.
        """
        state, moved, wanted = np.empty((3, len(q))), np.empty((3, len(q))), np.zeros((2, len(q)))
        state[0], state[1], state[2] = q, dq, ddq
        if acceleration is not None:
            wanted[1] = acceleration
        met = _step(state, velocity, self._parameters, wanted, moved)
        if met == UNUSABLE:
            return _stuck(q)
        if met & CHASED:
            self._chase(state, wanted, moved)
            if _forget_fast(state, moved, self._parameters):  # where the wanted velocity does not change as was said
                wanted[1] = 0.0
                self._chase(state, wanted, moved)
            _make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=met > 0)

    def together(self, q: Vector, dq: Vector, ddq: Vector, velocity: Vector) -> Limited | None:
        """As `step`, by velocities between those now and those wanted: an inequality that both keep
        is kept on the way. None where the joints' accelerations do not allow for that.
        """
        share = _common_share(np.stack((q, dq, ddq, velocity)), self._parameters)
        return self.step(q, dq, ddq, dq + share * (velocity - dq)) if share >= 0.0 else None

    def stop(self, q: Vector, dq: Vector, ddq: Vector) -> Limited:
        """The joints one period later on the way to rest, at which all come at once and as soon as
        they can: so the tool slows down along its way. `limited` until they are there.

        Never raises.
        """
        state = np.stack((q, dq, ddq))
        if not is_usable(state):
            return _stuck(q)
        limits = self._parameters[0]
        moved = stop_together(state[1], state[2], limits["max_acceleration"], limits["max_jerk"], self._period)
        moved[0] += q
        _make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=bool(moved[1].any()))

    def speed_in_stop(self, moved: Limited, here: Kinematics) -> float:
        """The greatest speed [m/s] of the tool in a stop after a step that brought the arm here."""
        speed: float = _speed_in_stop(*moved[1:3], here.record, self._parameters)
        return speed

    def _chase(self, state: Vector, wanted: Vector, moved: Vector) -> None:
        """Puts those joints of `moved` (3, J) that are NaN one period along Ruckig's profile to the
        wanted velocities, as seen from what moves at these and their accelerations (2, J); or on
        the fastest stop where there is none.
        """
        dt, most, ramp = self._period, self._parameters["max_acceleration"][0], wanted[1]
        velocity = wanted[0] - dt * ramp  # now: they are wanted a period later
        self._input.current_position = state[0].tolist()
        self._input.current_velocity = (state[1] - velocity).tolist()
        self._input.current_acceleration = (state[2] - ramp).tolist()
        self._input.max_acceleration, self._input.min_acceleration = (most - ramp).tolist(), (-most - ramp).tolist()
        try:
            self._ruckig.calculate(self._input, self._trajectory)
        except (ruckig.RuckigError, ValueError):  # ValueError: a result that the binding has no name for
            return
        chased = np.array(self._trajectory.at_time(dt))
        chased[0] += dt * (velocity + 0.5 * dt * ramp)
        chased[1] += velocity + dt * ramp
        chased[2] += ramp
        np.copyto(moved, chased, where=np.isnan(moved))


@compiled
def _step(state: Vector, velocity: Vector, parameters: Records, wanted: Vector, moved: Vector) -> int:
    """As `_toward`, and made safe where no joint is to be chased; UNUSABLE for such a state."""
    if not is_usable(state):
        return UNUSABLE
    met = _toward(state, velocity, parameters, wanted, moved)
    if not met & CHASED and not _make_safe(state, moved, parameters):
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
        most = min(INSIDE * given.max_acceleration[i], math.sqrt(2.0 * max_jerk * room))
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
def _forget_fast(state: Vector, moved: Vector, parameters: Records) -> bool:
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
def _common_share(state: Vector, parameters: Records) -> float:
    """The greatest share of the way to the wanted velocities, the last row of state (4, J), that
    all joints can go in a tick without passing these, as their acceleration comes to 0; -1: none.
    """
    given, least, most = parameters[0], 0.0, 1.0
    dt = given.period_s
    for i in range(state.shape[1]):
        way, change = state[3, i] - state[1, i], INSIDE * dt * given.max_jerk[i]
        a = state[2, i] if way >= 0.0 else -state[2, i]
        way = max(abs(way), LEAST_CHANGE)
        least = max(least, (a - change) * dt / way)
        most = min(most, min(a + change, INSIDE * given.max_acceleration[i]) * dt / way)
        bend, left = way / (2.0 * change * dt), max(1.0 - 0.5 * dt * a / way, 0.0)
        most = min(most, (math.sqrt(0.25 + 4.0 * bend * left) - 0.5) / (2.0 * bend))
    return max(least, most) if most >= INSIDE * least else -1.0


@compiled
def _make_safe(state: Vector, moved: Vector, parameters: Records) -> bool:
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
            if not abs(value) < LARGEST:
                return False
    return True


@compiled
def _speed_in_stop(dq: Vector, ddq: Vector, heres: Records, parameters: Records) -> float:
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


def _stuck(q: Vector) -> Limited:
    return _frozen(np.stack((q, np.zeros(len(q)), np.zeros(len(q)))), limited=True)


def _frozen(moved: Vector, *, limited: bool) -> Limited:
    moved.setflags(write=False)
    return Limited(moved[0], moved[1], moved[2], limited)


# Joints end their accelerations at different times in a stop, so their motions cancel less of each
# other: the tool gains at most this share of the sum of what they contribute (0.16 seen).
CANCELLED_SHARE = 0.3
STOP_SHARE = 0.99  # of that speed, from which it stops: what is left out in finding it adds to that in long ticks


class Moved(NamedTuple):
    """What came of a step: where the arm is then; whether a limit kept the joints from what was
    wanted, and whether that was separation; the tool's speed [m/s] where it is too fast, else 0.
    """

    here: Kinematics
    limited: bool
    separated: bool
    too_fast: float
    moving: bool  # before


class LimiterStage:
    """Moves the state's joints (3, J): position, velocity, acceleration [rad, rad/s, rad/s²]."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        self._arm, self._max_speed = arm, settings.tool.max_speed
        self._limiter = Limiter(settings.joints, settings.period_s)
        self._still, self._jerk = np.zeros(len(settings.joints.names)), np.array(settings.joints.jerk)

    def begin(self, state: Record, joints: Vector) -> None:
        """The joints (J,) [rad] at rest where the arm is."""
        state["joints"] = 0.0
        state["joints"][0] = joints

    def step(self, state: Record, frame: Record, wanted: Vector, ramp: Vector, separation: Separation) -> Moved:
        """Moves the joints on toward wanted velocities (J,) [rad/s], which go on by a ramp (J,)
        [rad/s²].

        They brake where the tool would pass its greatest speed, and one that does all the same is
        too fast. Where they would approach something too fast on the way, which each goes as fast
        as it can, they go it together, or brake, or, where that brakes less, change the least.
        """
        q, dq, ddq = state["joints"]
        moved = self._limiter.step(q, dq, ddq, wanted, ramp)
        limited, excess = moved.limited, separation.excess(*moved[1:3])
        separated = excess > 0.0
        if separated:
            other = self._limiter.together(q, dq, ddq, wanted)
            if other is None or separation.excess(*other[1:3]) > 0.0:
                other = self._limiter.stop(q, dq, ddq)
            if separation.excess(*other[1:3]) >= excess:  # these two in turn would be neither
                other = self._limiter.step(q, dq, ddq, separation.less(dq, moved[1:3]))
            separated = separation.excess(*other[1:3]) < excess
            moved, limited = (other, True) if separated else (moved, limited)
        here, too_fast = self._arm.at(moved.position), 0.0
        if self._comes_to(moved, here) > STOP_SHARE * self._max_speed:
            moved, limited = self._limiter.stop(q, dq, ddq), True
            here = self._arm.at(moved.position)
            speed = tool_speeds(here.record, *moved[1:3], self._jerk)[0]
            too_fast = speed if speed > self._max_speed else 0.0
        moving = _take(as_array(state), as_array(frame), here.record, *moved[:3])
        return Moved(here, limited, separated, too_fast, moving)

    def stop(self, state: Record, frame: Record, separation: Separation) -> Moved:
        """Move the joints one period on their way to rest: all together, or each as fast as it can
        where that approaches things less and does not bring the tool beyond its speed limit.
        """
        q, dq, ddq = state["joints"]
        moved = self._limiter.stop(q, dq, ddq)
        here, excess = self._arm.at(moved.position), separation.excess(*moved[1:3])
        if excess > 0.0:
            other = self._limiter.step(q, dq, ddq, self._still)
            if separation.excess(*other[1:3]) < excess:
                there = self._arm.at(other.position)
                speed = self._comes_to(other, there)
                if speed <= self._max_speed or speed <= self._comes_to(moved, here):
                    moved, here = other, there
        moving = _take(as_array(state), as_array(frame), here.record, *moved[:3])
        return Moved(here, limited=False, separated=False, too_fast=0.0, moving=moving)

    def _comes_to(self, moved: Limited, here: Kinematics) -> float:
        """Greatest speed [m/s] of the tool if the joints stop after a step.

        The stop is sampled only where it may pass the limit. That includes all speeds above 77 % of
        the limit, since the sum of what the joints contribute is at least the speed.
        """
        _, speed, total = tool_speeds(here.record, *moved[1:3], self._jerk)
        most = self._max_speed
        if speed <= STOP_SHARE * most and speed + CANCELLED_SHARE * total > most:
            return max(float(speed), self._limiter.speed_in_stop(moved, here))
        return float(speed)


@compiled
def _take(
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
