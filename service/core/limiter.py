"""The last stage: joint commands that hold every limit, whatever is wanted.

Each joint moves by one tick at constant jerk toward the wanted velocity where its limits leave room
for that, and by Ruckig's time-optimal profile where they do not. A step is taken only if a stop
after it stays within the position limits; else the joint stops now. As the step before was taken on
the same condition, that stop is feasible too: the limits hold by induction, for any sequence of
wanted velocities.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import ruckig

from service.config import JointSettings
from service.core.frame import Vector

DECIMALS = 9  # [rad] of the positions: rounded so that a replay on another kind of CPU agrees
MARGIN = 1e-6  # [rad] kept from the position limits, so that rounding along a stop (< 1e-7 rad) does not pass them


class Limited(NamedTuple):
    """The joints one period later, (J,) each [rad, rad/s, rad/s²]; whether a limit kept them from
    what was wanted.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    limited: bool


def approach_gain(limits: JointSettings) -> Vector:
    """Greatest speed toward a position limit per distance to it, (J,) [1/s].

    Braking along it takes at most half of the acceleration and a quarter of the jerk.
    """
    velocity = np.array(limits.velocity)
    gain: Vector = 0.5 * np.minimum(np.array(limits.acceleration) / velocity, np.sqrt(np.array(limits.jerk) / velocity))
    return gain


class Limiter:
    """Position, velocity, acceleration and jerk limits of J joints.

    Keeps nothing from tick to tick: it continues bit for bit from its output. The limits hold from
    any state that a stop can still save. A joint at rest outside its position limits may move
    inwards only; one that comes faster than its limits is brought back into them as jerk allows.
    """

    def __init__(self, limits: JointSettings, period_s: float) -> None:
        self._period = period_s
        self._lower, self._upper = np.array(limits.lower) + MARGIN, np.array(limits.upper) - MARGIN
        self._velocity = np.array(limits.velocity) * (1.0 - 1e-12)  # leaves room for rounding
        self._acceleration = np.array(limits.acceleration)
        self._jerk = np.array(limits.jerk)
        self._jerk_step = self._jerk * period_s
        self._gain = approach_gain(limits)
        count = len(limits.velocity)
        self._ruckig = ruckig.Ruckig(count)
        self._input = ruckig.InputParameter(count)
        self._input.control_interface = ruckig.ControlInterface.Velocity
        self._input.synchronization = ruckig.Synchronization.No
        self._input.max_velocity = list(limits.velocity)
        self._input.max_acceleration = list(limits.acceleration)
        self._input.max_jerk = list(limits.jerk)
        self._trajectory = ruckig.Trajectory(count)
        self._rest = [0.0] * count
        self._origin = np.zeros(count)

    def step(self, q: Vector, dq: Vector, ddq: Vector, velocity: Vector) -> Limited:
        """The joints one period later on the way to `velocity`; all (J,) [rad, rad/s, rad/s²].

        A NaN in `velocity` means stop. A state that is not finite stays as it is, at velocity 0.
        Never raises.
        """
        if not _usable(q, dq, ddq):
            return _frozen(q.copy(), np.zeros(len(q)), np.zeros(len(q)), limited=True)
        wanted, bounded = self._within_bounds(q, velocity)
        position, speed, acceleration, linear = self._linear(q, dq, ddq, wanted)
        if not linear.all():
            chased = self._profile(q, dq, ddq, wanted.tolist())
            position = np.where(linear, position, chased[0])
            speed = np.where(linear, speed, chased[1])
            acceleration = np.where(linear, acceleration, chased[2])
        position = position.round(DECIMALS)
        lowest, highest = self._stop_range(position, speed, acceleration)
        safe = (highest <= np.maximum(self._upper, q)) & (lowest >= np.minimum(self._lower, q))
        if not safe.all():
            stop = self.stop(q, dq, ddq)
            position = np.where(safe, position, stop.position)
            speed = np.where(safe, speed, stop.velocity)
            acceleration = np.where(safe, acceleration, stop.acceleration)
        return _frozen(position, speed, acceleration, limited=bounded or not linear.all() or not safe.all())

    def stop(self, q: Vector, dq: Vector, ddq: Vector) -> Limited:
        """The joints one period later on the fastest way to rest; `limited` until they are.

        Never raises.
        """
        if not _usable(q, dq, ddq):
            return _frozen(q.copy(), np.zeros(len(q)), np.zeros(len(q)), limited=True)
        position, velocity, acceleration = self._profile(q, dq, ddq, self._rest)
        return _frozen(position.round(DECIMALS), velocity, acceleration, limited=bool(velocity.any()))

    def _within_bounds(self, q: Vector, velocity: Vector) -> tuple[Vector, bool]:
        """The wanted velocity (J,) within speed limits, slower near position limits; whether that
        changed it.
        """
        if np.isnan(velocity).any():
            return np.zeros(len(q)), True
        fastest = np.minimum(self._velocity, self._gain * np.maximum(self._upper - q, 0.0))
        slowest = np.maximum(-self._velocity, self._gain * np.minimum(self._lower - q, 0.0))
        wanted = np.minimum(np.maximum(velocity, slowest), fastest)
        return wanted, bool((wanted != velocity).any())

    def _linear(
        self, q: Vector, dq: Vector, ddq: Vector, wanted: Vector
    ) -> tuple[Vector, Vector, Vector, npt.NDArray[np.bool_]]:
        """Each joint one tick on at the jerk that reaches the wanted velocity; and which may.

        A smooth input passes without lag: its ramps leave the acceleration as it is. A time-optimal
        profile, which ends without acceleration, would lag behind them by acceleration² / 2 jerk.
        """
        acceleration = (wanted - dq) / self._period
        change = acceleration - ddq
        velocity = dq + (0.5 * self._period) * (ddq + acceleration)
        position = q + self._period * (dq + self._period * (ddq / 3.0 + acceleration / 6.0))
        size = np.abs(acceleration)
        crest = np.abs(velocity + acceleration * size / (2.0 * self._jerk))  # the speed when acceleration has come to 0
        allowed = (np.abs(change) <= self._jerk_step) & (size <= self._acceleration) & (crest <= self._velocity)
        return position, velocity, acceleration, allowed & (np.abs(velocity) <= self._velocity)

    def _profile(self, q: Vector, dq: Vector, ddq: Vector, target: list[float]) -> tuple[Vector, Vector, Vector]:
        """One period along Ruckig's profile to the target velocities, or on a stop by hand where
        there is none.
        """
        if self._calculate(q, dq, ddq, target) or self._calculate(q, dq, ddq, self._rest):
            position, velocity, acceleration = self._trajectory.at_time(self._period)
            return np.array(position), np.array(velocity), np.array(acceleration)
        return self._stop_by_hand(q, dq, ddq)

    def _stop_range(self, q: Vector, dq: Vector, ddq: Vector) -> tuple[Vector, Vector]:
        """Lowest and highest position (J,) [rad] of a stop; unbounded where there is none."""
        # Ruckig's extrema of a velocity profile count 0 among the positions, so each joint stops as
        # from there.
        if not self._calculate(self._origin, dq, ddq, self._rest):
            return np.full(len(q), -np.inf), np.full(len(q), np.inf)
        extrema = self._trajectory.position_extrema
        return q + np.array([bound.min for bound in extrema]), q + np.array([bound.max for bound in extrema])

    def _calculate(self, q: Vector, dq: Vector, ddq: Vector, target: list[float]) -> bool:
        """Whether Ruckig found a profile; it is then in `_trajectory`."""
        self._input.current_position = q.tolist()
        self._input.current_velocity = dq.tolist()
        self._input.current_acceleration = ddq.tolist()
        self._input.target_velocity = target
        try:
            self._ruckig.calculate(self._input, self._trajectory)
        except (ruckig.RuckigError, ValueError):  # ValueError: a result that the binding has no name for
            return False
        return True

    def _stop_by_hand(self, q: Vector, dq: Vector, ddq: Vector) -> tuple[Vector, Vector, Vector]:
        """One tick of a stop that jerk allows at once; for states from which Ruckig finds none."""
        speed = np.abs(dq)
        brake = np.minimum(np.minimum(self._acceleration, np.sqrt(2.0 * self._jerk * speed)), speed / self._period)
        change = np.minimum(np.maximum(-np.sign(dq) * brake - ddq, -self._jerk_step), self._jerk_step)
        acceleration = ddq + change
        velocity = dq + 0.5 * self._period * (ddq + acceleration)
        return q + self._period * 0.5 * (dq + velocity), velocity, acceleration


def _usable(q: Vector, dq: Vector, ddq: Vector) -> bool:
    """Whether a state is finite, and small enough to calculate with: false for NaN too."""
    return bool(np.abs(np.concatenate((q, dq, ddq))).max() < 1e6)


def _frozen(position: Vector, velocity: Vector, acceleration: Vector, *, limited: bool) -> Limited:
    for array in (position, velocity, acceleration):
        array.setflags(write=False)
    return Limited(position, velocity, acceleration, limited)
