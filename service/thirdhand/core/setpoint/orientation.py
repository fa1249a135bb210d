"""Orientation setpoint: a turn to the target within limits of angular speed and acceleration."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Record, Records, Vector, as_array, parameters
from thirdhand.core.geometry import axis_of, quaternion_of, swing, turn_between, turn_on
from thirdhand.core.numerics import ROUNDING
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.vectors import dot, norm, rounded
from thirdhand.settings.config import Settings


class OrientationSetpoint:
    """Orientation setpoint of the state: a quaternion (4,) and an angular velocity (3,) [rad/s]."""

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        tool = settings.tool
        numbers = tuning.arm
        speed_share, brake_share, _ = numbers.planned_limit_shares
        self._parameters = parameters(
            max_speed=speed_share * tool.max_turn_speed,
            max_acceleration=float(tool.max_turn_acceleration),
            planned_brake_share=brake_share,
            gain=numbers.turn_gain_share * numbers.position_gain_per_s,  # as of quick joints
            # 1: the turn about +z is followed too
            about=int(tool.orientation == "full"),
            period_s=settings.period_s,
        )
        self._engaging = self._parameters.copy()
        self._engaging["max_speed"] *= tool.engaging_speed / tool.max_speed

    def limits(self, state: Record) -> Records:
        """Parameters (1,) of a step from this state: while the position engages, the angular speed
        is limited to the same share of its own limit.
        """
        return self._engaging if as_array(state)["engaging"][0] else self._parameters

    def begin(self, state: Record, rotation: Vector, turning: Vector) -> None:
        """Start from the tool's rotation (3, 3) and angular velocity `turning` (3,) [rad/s]."""
        quaternion_of(rotation, state["orientation"])
        state["turning"] = turning

    def step(self, state: Record, orientation: Vector, turning: Vector) -> None:
        """Turn the setpoint for one period toward an orientation (4,) that turns at (3,) [rad/s].

        If the settings say that only a direction is followed, the setpoint turns +z on the shortest
        path.
        """
        turn_orientation(
            state["orientation"], state["turning"], orientation, turning, self.limits(state)
        )


@compiled
def turn_orientation(
    quaternion: Vector, turning: Vector, target: Vector, target_turning: Vector, parameters: Records
) -> None:
    """Turn a quaternion (4,), in place, for one period toward a target (4,).

    `turning` and `target_turning` (3,) [rad/s] are their angular velocities; `turning` is updated
    too. With e (3,) [rad] the rotation vector to the target, g the gain and B the planned braking:

        desired = target_turning + rate e
        rate    = g                                      if |e| <= B / g²
        rate    = sqrt(2 B (|e| - B / 2g²)) / |e|        otherwise

    The desired velocity is scaled down to max_speed. The angular velocity moves toward it by at
    most max_acceleration * period, and turns the quaternion for one period. If only the direction
    of +z is followed, e is its shortest turn and target_turning loses its component about +z.
    """
    config = parameters[0]
    dt = config.period_s
    error = np.empty(3)
    desired = np.empty(3)
    axis = np.empty(3)
    axis_of(quaternion, axis)
    along = 0.0
    if config.about:
        turn_between(quaternion, target, error)
    else:
        swing(axis, target, error)
        along = dot(target_turning, axis)
    angle = norm(error)
    # rate is constant for small errors; for large ones the turn ends at constant deceleration
    brake = config.planned_brake_share * config.max_acceleration
    rate = config.gain
    near = brake / config.gain**2
    if angle > near:
        rate = math.sqrt(2.0 * brake * (angle - 0.5 * near)) / angle
    for i in range(3):
        desired[i] = target_turning[i] - along * axis[i] + rate * error[i]
    slower = min(1.0, config.max_speed / max(norm(desired), ROUNDING))
    for i in range(3):
        desired[i] = slower * desired[i] - turning[i]
    share = min(1.0, config.max_acceleration * dt / max(norm(desired), ROUNDING))
    for i in range(3):
        turning[i] = rounded(turning[i] + share * desired[i])
        desired[i] = dt * turning[i]
    turn_on(quaternion, desired)
