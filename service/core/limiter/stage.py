"""The last stage: joint commands that hold every limit, whatever is wanted.

Each joint moves by one tick at constant jerk toward the wanted velocity where its limits leave room
for that, and by Ruckig's time-optimal profile where they do not. That profile ends on the ramp by
which the wanted velocity goes on: one that ended at rest on it would be late all along the ramp. A
step is taken only if a stop after it stays within the position limits; else the joint stops now. As
the step before was taken on the same condition, that stop is feasible too: the limits hold by
induction, for any sequence of wanted velocities.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import ruckig

from service.config import JointSettings, Settings
from service.core.arm.stage import Arm
from service.core.frame import Record, Vector, as_array, parameters
from service.core.joint_limits import LIMIT_MARGIN_RAD, approach_gain
from service.core.kinematics import Kinematics, tool_speeds
from service.core.limiter.step import (
    CHASED,
    UNUSABLE,
    common_share,
    forget_fast,
    is_usable,
    make_safe,
    speed_in_stop,
    step,
    take,
)
from service.core.limiter.tuning import CANCELLED_MOTION_SHARE, STOP_SPEED_SHARE
from service.core.separation.stage import Separation
from service.core.stops import stop_together


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
            lower=np.array(limits.lower) + LIMIT_MARGIN_RAD,
            upper=np.array(limits.upper) - LIMIT_MARGIN_RAD,
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
        met = step(state, velocity, self._parameters, wanted, moved)
        if met == UNUSABLE:
            return _stuck(q)
        if met & CHASED:
            self._chase(state, wanted, moved)
            if forget_fast(state, moved, self._parameters):  # where the wanted velocity does not change as was said
                wanted[1] = 0.0
                self._chase(state, wanted, moved)
            make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=met > 0)

    def together(self, q: Vector, dq: Vector, ddq: Vector, velocity: Vector) -> Limited | None:
        """As `step`, by velocities between those now and those wanted: an inequality that both keep
        is kept on the way. None where the joints' accelerations do not allow for that.
        """
        share = common_share(np.stack((q, dq, ddq, velocity)), self._parameters)
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
        make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=bool(moved[1].any()))

    def speed_in_stop(self, moved: Limited, here: Kinematics) -> float:
        """The greatest speed [m/s] of the tool in a stop after a step that brought the arm here."""
        speed: float = speed_in_stop(*moved[1:3], here.record, self._parameters)
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


def _stuck(q: Vector) -> Limited:
    return _frozen(np.stack((q, np.zeros(len(q)), np.zeros(len(q)))), limited=True)


def _frozen(moved: Vector, *, limited: bool) -> Limited:
    moved.setflags(write=False)
    return Limited(moved[0], moved[1], moved[2], limited)


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
        if self._comes_to(moved, here) > STOP_SPEED_SHARE * self._max_speed:
            moved, limited = self._limiter.stop(q, dq, ddq), True
            here = self._arm.at(moved.position)
            speed = tool_speeds(here.record, *moved[1:3], self._jerk)[0]
            too_fast = speed if speed > self._max_speed else 0.0
        moving = take(as_array(state), as_array(frame), here.record, *moved[:3])
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
        moving = take(as_array(state), as_array(frame), here.record, *moved[:3])
        return Moved(here, limited=False, separated=False, too_fast=0.0, moving=moving)

    def _comes_to(self, moved: Limited, here: Kinematics) -> float:
        """Greatest speed [m/s] of the tool if the joints stop after a step.

        The stop is sampled only where it may pass the limit. That includes all speeds above 77 % of
        the limit, since the sum of what the joints contribute is at least the speed.
        """
        _, speed, total = tool_speeds(here.record, *moved[1:3], self._jerk)
        most = self._max_speed
        if speed <= STOP_SPEED_SHARE * most and speed + CANCELLED_MOTION_SHARE * total > most:
            return max(float(speed), self._limiter.speed_in_stop(moved, here))
        return float(speed)
