"""From the predicted target to a setpoint that an arm can follow: smooth where it is quiet, limited
where it is not, without lag.

A linear tracker is smooth but knows no limits; Ruckig keeps limits but, chasing a target that moves
a little each tick, slams between them. So the tracker leads, and its next full state is what Ruckig
is asked for.
"""

from __future__ import annotations

import math

import numpy as np
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from service.config import ToolSettings
from service.core.frame import Vector

SHARE, SPEED_SHARE = 0.8, 0.97  # of the limits the tracker uses; the rest is Ruckig's to correct with


class Smoother:
    """A third-order tracker, critically damped with saturated stages, whose state one period ahead
    is Ruckig's target.
    """

    def __init__(self, tool: ToolSettings, period_s: float) -> None:
        self._period_s = period_s
        self._bandwidth = tool.bandwidth
        self._max_speed = tool.max_speed
        self._max_acceleration = tool.max_acceleration
        self._max_jerk = tool.max_jerk
        self._ruckig = Ruckig(3, period_s)
        # Made once for speed; each question sets all that differs, so that nothing is remembered.
        self._path = Trajectory(3)
        self._question = InputParameter(3)
        self._question.synchronization = Synchronization.No
        self._question.max_velocity = [self._max_speed] * 3
        self._question.max_acceleration = [self._max_acceleration] * 3
        self._question.max_jerk = [self._max_jerk] * 3

    def step(self, state: Vector, position: Vector, velocity: Vector, acceleration: Vector) -> tuple[Vector, bool]:
        """The setpoint's position, velocity and acceleration (3, 3) one period on, by axis, and
        whether a limit was met.

        state: (3, 3) the setpoint now; position, velocity, acceleration: (3,) the target now [m,
        m/s, m/s²].
        """
        ahead, limited = self._track(state, position, velocity, acceleration)
        if self._is_within(ahead) and self._is_within(state):
            return ahead, limited  # one period at constant jerk: just what Ruckig would answer, found sooner
        reached = self._reach(state, ahead)
        if reached is None:
            reached, limited = self._stop(state), True
        return reached, limited

    def _track(self, state: Vector, position: Vector, velocity: Vector, acceleration: Vector) -> tuple[Vector, bool]:
        """The tracker's state one period ahead.

        Unsaturated, the cascade is u = w³ (x_t - x) + 3 w² (v_t - v) + 3 w (a_t - a). The outer
        stage grows linearly with the error while braking from it is gentle, and with its square
        root beyond, so that a far target is approached without overshoot.
        """
        w, dt = self._bandwidth, self._period_s
        push, jerk = SHARE * self._max_acceleration, SHARE * self._max_jerk
        gain, brake = w / 3, push / 2
        knee = brake / gain**2
        x, v, a = state.tolist()
        wanted_velocity = []
        for i in range(3):
            error = float(position[i]) - x[i]
            far = abs(error)
            approach = gain * error if far < knee else math.copysign(math.sqrt(2 * brake * (far - knee / 2)), error)
            wanted_velocity.append(float(velocity[i]) + approach)
        speed = math.hypot(*wanted_velocity)
        slow_down = min(1.0, SPEED_SHARE * self._max_speed / speed) if speed > 0 else 1.0
        limited = slowed = slow_down < 1.0
        ahead = []
        for i in range(3):
            # at the speed limit what the target does beyond it is not followed
            asked = (0.0 if slowed else float(acceleration[i])) + w * (slow_down * wanted_velocity[i] - v[i])
            wanted_acceleration = min(push, max(-push, asked))
            limited |= wanted_acceleration != asked
            u = min(jerk, max(-jerk, 3 * w * (wanted_acceleration - a[i])))
            ahead.append(
                (x[i] + dt * (v[i] + dt * (a[i] / 2 + dt * u / 6)), v[i] + dt * (a[i] + dt * u / 2), a[i] + dt * u)
            )
        return np.array(ahead).T, limited

    def _is_within(self, state: Vector) -> bool:
        """Whether speed and acceleration keep their limits; jerk does by the way the tracker is
        made.
        """
        _, velocity, acceleration = state.tolist()
        return math.hypot(*velocity) <= self._max_speed and max(map(abs, acceleration)) <= self._max_acceleration

    def _reach(self, state: Vector, ahead: Vector) -> Vector | None:
        """Ruckig's state one period on, on its way to the tracker's; None where it knows no way."""
        question = self._question
        question.control_interface = ControlInterface.Position
        question.target_position, question.target_velocity, question.target_acceleration = ahead.tolist()
        return self._answer(state)

    def _stop(self, state: Vector) -> Vector:
        question = self._question
        question.control_interface = ControlInterface.Velocity
        question.target_velocity, question.target_acceleration = [0.0] * 3, [0.0] * 3
        stopped = self._answer(state)
        if stopped is None:  # from a state no limit allows: brake by hand, without jerk limit
            dt, push = self._period_s, self._max_acceleration
            velocity = state[1] - np.clip(state[1], -push * dt, push * dt)
            stopped = np.stack([state[0] + dt * velocity, velocity, np.zeros(3)])
        return stopped

    def _answer(self, state: Vector) -> Vector | None:
        question = self._question
        question.current_position, question.current_velocity, question.current_acceleration = state.tolist()
        try:
            if self._ruckig.calculate(question, self._path) not in (Result.Working, Result.Finished):
                return None
            reached = np.array(self._path.at_time(self._period_s))
        except (RuckigError, ValueError):  # the latter where its result has no name
            return None
        return reached if np.isfinite(reached).all() else None
