"""The orientation that the tool is led to: it turns toward the predicted one with limited speed and
acceleration, however that jumps.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.core.record import Record, Vector
from service.core.rotation import axis_of, quaternion_of, swing, turn_between, turn_on

GAIN = 12.0  # [1/s] of a small error's decay
BRAKE_SHARE = 0.7  # of the acceleration, with which a large one's turn is planned to end
SPEED_SHARE = 0.9  # of the tool's greatest: the arm needs the rest to catch up
STEPS = 1e9  # [s/rad] of the angular velocity: rounded so that a replay on another kind of CPU agrees


class OrientationSetpoint:
    """Turns the state's orientation (4,), at an angular velocity (3,) [rad/s], toward targets."""

    def __init__(self, settings: Settings) -> None:
        tool = settings.tool
        self._limits = np.array([SPEED_SHARE * tool.max_turn_speed, tool.max_turn_acceleration])
        self._about = float(tool.orientation == "full")
        self._period_s = settings.period_s

    def begin(self, state: Record, rotation: Vector, turning: Vector) -> None:
        """Puts it where the tool is, before there are targets: rotation (3, 3), turning (3,)
        [rad/s].
        """
        quaternion_of(rotation, state["orientation"])
        state["turning"] = turning

    def step(self, state: Record, orientation: Vector, turning: Vector) -> None:
        """Turns it one period on toward an orientation (4,) that turns itself (3,) [rad/s].

        Where the settings say that a direction is followed, +z goes the shortest way.
        """
        _lead(state["orientation"], state["turning"], orientation, turning, self._about, self._limits, self._period_s)


@compiled
def _lead(
    quaternion: Vector,
    turning: Vector,
    target: Vector,
    target_turning: Vector,
    about: float,
    limits: Vector,
    dt: float,
) -> None:
    """One period, in place."""
    error, wanted, axis, target_axis = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    axis_of(quaternion, axis)
    along = 0.0
    if about > 0.0:
        turn_between(quaternion, target, error)
    else:
        axis_of(target, target_axis)
        swing(axis, target_axis, error)
        for i in range(3):
            along += target_turning[i] * axis[i]
    angle = math.sqrt(error[0] * error[0] + error[1] * error[1] + error[2] * error[2])
    # in proportion to the error when near, braking evenly from afar
    brake, rate = BRAKE_SHARE * limits[1], GAIN
    near = brake / GAIN**2
    if angle > near:
        rate = math.sqrt(2.0 * brake * (angle - 0.5 * near)) / angle
    speed = 0.0
    for i in range(3):
        wanted[i] = target_turning[i] - along * axis[i] + rate * error[i]
        speed += wanted[i] * wanted[i]
    slower = min(1.0, limits[0] / max(math.sqrt(speed), 1e-12))
    change = 0.0
    for i in range(3):
        wanted[i] = slower * wanted[i] - turning[i]
        change += wanted[i] * wanted[i]
    share = min(1.0, limits[1] * dt / max(math.sqrt(change), 1e-12))
    for i in range(3):
        turning[i] = np.rint((turning[i] + share * wanted[i]) * STEPS) / STEPS
        wanted[i] = dt * turning[i]
    turn_on(quaternion, wanted)
