"""Limiter stage, the last one: joint commands within all limits, for any wanted velocities.

In a tick each joint moves at constant jerk toward the wanted velocity, if its limits allow this. If
not, it follows Ruckig's time-optimal profile. That profile ends on the ramp of the wanted velocity,
in a frame that moves with the ramp: a profile that ended without acceleration would lag behind the
ramp.

A step is taken only if a stop after it stays within the position limits; otherwise the joint begins
its stop in this tick. The step before was taken on the same condition, so this stop is feasible
too. The limits therefore hold by induction, for any sequence of wanted velocities.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import ruckig

from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Record, Vector, as_array, parameters
from thirdhand.core.joint_limits import LIMIT_MARGIN_RAD, approach_gain
from thirdhand.core.kinematics import Kinematics, tool_speeds
from thirdhand.core.limiter.step import (
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
from thirdhand.core.separation.stage import Separation
from thirdhand.core.stops import stop_together
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import JointSettings, Settings


class Limited(NamedTuple):
    """Joint positions, velocities and accelerations (J,) [rad, rad/s, rad/s²] one period later.

    `limited`: a limit kept the joints from the wanted velocity.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    limited: bool


class Limiter:
    """Position, velocity, acceleration and jerk limits of J joints.

    It has no memory: it continues from its own output, bit for bit. The limits hold from every
    state from which a stop can still keep them. A joint at rest outside of its position limits may
    only move inward. A joint that starts faster than its limits is brought back into them within
    its jerk limit.
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

    def step(
        self,
        q: Vector,
        dq: Vector,
        ddq: Vector,
        velocity: Vector,
        acceleration: Vector | None = None,
    ) -> Limited:
        """Joints one period later, on the way to `velocity`, which changes at `acceleration`.

        All arguments are (J,) [rad, rad/s, rad/s²]; without `acceleration` the velocity is
        constant. A NaN in either of the two requests a stop. Joints in a state that cannot be
        calculated with (not finite, or too large) keep their positions, at velocity 0. Never
        raises.
        """
        return self.advance(np.stack((q, dq, ddq)), velocity, acceleration)

    def advance(
        self, state: Vector, velocity: Vector, acceleration: Vector | None = None
    ) -> Limited:
        """`step` of the joints' state (3, J), which is not changed."""
        moved = np.empty(state.shape)
        target = np.zeros((2, state.shape[1]))
        if acceleration is not None:
            target[1] = acceleration
        met = step(state, velocity, self._parameters, target, moved)
        if met == UNUSABLE:
            return _stuck(state[0])
        if met & CHASED:
            self._chase(state, target, moved)
            # joints that become too fast: again, without the ramp
            if forget_fast(state, moved, self._parameters):
                target[1] = 0.0
                self._chase(state, target, moved)
            make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=met > 0)

    def together(self, q: Vector, dq: Vector, ddq: Vector, velocity: Vector) -> Limited | None:
        """Joints one period later, all by the same share of the change to `velocity` (J,).

        The new velocities lie between the present ones and the wanted ones. So a linear inequality
        that both satisfy is satisfied on the way too. Returns None if the joints' accelerations do
        not allow a common share.
        """
        share = common_share(np.stack((q, dq, ddq, velocity)), self._parameters)
        return self.step(q, dq, ddq, dq + share * (velocity - dq)) if share >= 0.0 else None

    def stop(self, q: Vector, dq: Vector, ddq: Vector) -> Limited:
        """Joints one period later in a stop, in which all joints come to rest at the same time.

        The stop is as fast as the slowest joint allows, and the tool slows down along its path.
        `limited` is true until the joints rest. Never raises.
        """
        state = np.stack((q, dq, ddq))
        if not is_usable(state):
            return _stuck(q)
        limits = self._parameters[0]
        moved = stop_together(
            state[1], state[2], limits["max_acceleration"], limits["max_jerk"], self._period
        )
        moved[0] += q
        make_safe(state, moved, self._parameters)
        return _frozen(moved, limited=bool(moved[1].any()))

    def speed_in_stop(self, moved: Limited, here: Kinematics) -> float:
        """Largest speed [m/s] of the tool in a stop after the step `moved`, from `here` on."""
        speed: float = speed_in_stop(*moved[1:3], here.record, self._parameters)
        return speed

    def _chase(self, state: Vector, wanted: Vector, moved: Vector) -> None:
        """Move the joints that are NaN in `moved` (3, J) one period along Ruckig's profile.

        The profile ends at the wanted velocities and accelerations (2, J). It is computed in a
        frame that moves with them: there it ends at rest, and the acceleration limits are shifted
        by the ramp. If Ruckig finds no profile, the joints stay NaN, and `make_safe` stops them.
        """
        dt = self._period
        most = self._parameters["max_acceleration"][0]
        ramp = wanted[1]
        velocity = wanted[0] - dt * ramp  # wanted[0] is the velocity at the end of the period
        self._input.current_position = state[0].tolist()
        self._input.current_velocity = (state[1] - velocity).tolist()
        self._input.current_acceleration = (state[2] - ramp).tolist()
        self._input.max_acceleration = (most - ramp).tolist()
        self._input.min_acceleration = (-most - ramp).tolist()
        try:
            self._ruckig.calculate(self._input, self._trajectory)
        except (ruckig.RuckigError, ValueError):
            return  # ValueError: a result code that the Python binding lacks
        chased = np.array(self._trajectory.at_time(dt))
        chased[0] += dt * (velocity + 0.5 * dt * ramp)
        chased[1] += velocity + dt * ramp
        chased[2] += ramp
        np.copyto(moved, chased, where=np.isnan(moved))


def _stuck(q: Vector) -> Limited:
    """Joints at rest at the positions q (J,)."""
    return _frozen(np.stack((q, np.zeros(len(q)), np.zeros(len(q)))), limited=True)


def _frozen(moved: Vector, *, limited: bool) -> Limited:
    """Read-only `Limited` of joints `moved` (3, J)."""
    moved.setflags(write=False)
    return Limited(moved[0], moved[1], moved[2], limited)


class Moved(NamedTuple):
    """Result of a step of the stage.

    `here`: kinematics at the new joints. `limited`: a limit kept the joints from the wanted
    velocities. `separated`: this limit was separation. `excess_speed`: speed of the tool
    [m/s] if it exceeds max_speed, else 0. `moving`: the joints moved before the step.
    """

    here: Kinematics
    limited: bool
    separated: bool
    excess_speed: float
    moving: bool


class LimiterStage:
    """Joints of the state (3, J): position, velocity, acceleration [rad, rad/s, rad/s²]."""

    def __init__(self, settings: Settings, arm: ArmStage, *, tuning: Tuning = TUNING) -> None:
        self._arm = arm
        self._max_speed = settings.tool.max_speed
        # Speed above which the joints stop: midway between that of closing in and max_speed.
        self._stop_speed = 0.5 * (1.0 + tuning.arm.tool_speed_share) * self._max_speed
        self._limiter = Limiter(settings.joints, settings.period_s)
        self._jerk = np.array(settings.joints.jerk)

    def begin(self, state: Record, joints: Vector) -> None:
        """Start with the joints (J,) [rad] at rest."""
        state["joints"] = 0.0
        state["joints"][0] = joints

    def step(
        self, state: Record, frame: Record, wanted: Vector, ramp: Vector, separation: Separation
    ) -> Moved:
        """Move the joints one period toward velocities `wanted` (J,), which change at `ramp` (J,).

        If the step exceeds an `allowed` limit of separation, the synchronised step
        (`Limiter.together`) is taken if it exceeds none. Otherwise the joints brake (`_brake`), if
        this exceeds less than the step.

        If the tool would come too near its speed limit, in the step or in the stop after it, the
        joints stop. If the tool exceeds its limit in this stop, its speed is reported as
        `excess_speed`.
        """
        moved = self._limiter.advance(state["joints"], wanted, ramp)
        limited = moved.limited

        # separation: the synchronised step, or a stop
        excess = separation.excess(moved.velocity, moved.acceleration)
        separated = excess > 0.0
        if separated:
            q, dq, ddq = state["joints"]
            other = self._limiter.together(q, dq, ddq, wanted)
            if other is None or separation.excess(*other[1:3]) > 0.0:
                other = self._brake(state, separation)[0]
            separated = separation.excess(*other[1:3]) < excess
            moved, limited = (other, True) if separated else (moved, limited)

        # the tool's speed
        kinematics = self._arm.at(moved.position)
        excess_speed = 0.0
        if self._largest_speed_in_stop(moved, kinematics) > self._stop_speed:
            moved = self._limiter.stop(*state["joints"])
            limited = True
            kinematics = self._arm.at(moved.position)
            speed = tool_speeds(kinematics.record, *moved[1:3], self._jerk)[0]
            excess_speed = speed if speed > self._max_speed else 0.0

        moving = take(as_array(state), as_array(frame), kinematics.record, *moved[:3])
        return Moved(kinematics, limited, separated, excess_speed, moving)

    def stop(self, state: Record, frame: Record, separation: Separation) -> Moved:
        """Move the joints one period further in a stop.

        The joints brake (`_brake`), provided that the tool keeps its speed limit, or is no faster
        than in the stop without a correction.
        """
        moved, stop = self._brake(state, separation)
        kinematics = self._arm.at(moved.position)
        if moved is not stop:
            stop_kinematics = self._arm.at(stop.position)
            speed = self._limiter.speed_in_stop(moved, kinematics)
            allowed = max(self._max_speed, self._limiter.speed_in_stop(stop, stop_kinematics))
            if speed > allowed:
                moved = stop
                kinematics = stop_kinematics
        moving = take(as_array(state), as_array(frame), kinematics.record, *moved[:3])
        return Moved(kinematics, limited=False, separated=False, excess_speed=0.0, moving=moving)

    def _brake(self, state: Record, separation: Separation) -> tuple[Limited, Limited]:
        """Step of a stop in which all joints come to rest at the same time, corrected if necessary.

        If it exceeds an `allowed` limit of separation, the smallest correction of its velocities
        (`Separation.less`) replaces it, provided that this exceeds less. Returns the step that is
        taken, and that of the stop without a correction.
        """
        q, dq, ddq = state["joints"]
        stop = self._limiter.stop(q, dq, ddq)
        excess = separation.excess(*stop[1:3])
        if excess > 0.0:
            corrected = self._limiter.step(q, dq, ddq, separation.less(*stop[1:3]))
            if separation.excess(*corrected[1:3]) < excess:
                return corrected, stop
        return stop, stop

    def _largest_speed_in_stop(self, moved: Limited, here: Kinematics) -> float:
        """Largest speed [m/s] of the tool if the joints stop after the step `moved`.

        The stop is sampled only if the tool could exceed its limit there: if the sum of the joints'
        contributions to its speed exceeds it. Joints end their accelerations at different times in
        a stop, so their motions may cancel less of each other.
        """
        _, speed, total = tool_speeds(here.record, *moved[1:3], self._jerk)
        most = self._max_speed
        if speed <= self._stop_speed and total > most:
            return max(float(speed), self._limiter.speed_in_stop(moved, here))
        return float(speed)
