"""An ideal arm without physics, to try a cell without a robot."""

from __future__ import annotations

import time

import numpy as np

from thirdhand.arms.drive import Measured
from thirdhand.arms.playback import SpeedLimits
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

SIMULATED_PERIOD_S = 0.001
MAX_BEHIND_S = 0.05  # a loop that is later than this does not make up for its delay


class SimulatedArm:
    """The drive of an arm that follows each command at once, from the posture in its settings."""

    speed_limits: SpeedLimits | None = None
    period_s: float = SIMULATED_PERIOD_S
    takes_velocity: bool = False

    def __init__(self, settings: Settings) -> None:
        self.limits = settings.joints
        self.position = np.array(settings.arm.posture)
        self.velocity = np.zeros(len(settings.joints.names))

    def __enter__(self) -> SimulatedArm:
        self._read_s = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        """End the control; the arm stands."""

    def stands_at(self) -> Vector:
        """The joints (J,) [rad] before the arm is controlled."""
        return self.position

    def read(self) -> Measured:
        before = self._read_s
        due_s = self._read_s + SIMULATED_PERIOD_S
        time.sleep(max(due_s - time.monotonic(), 0.0))
        self._read_s = max(due_s, time.monotonic() - MAX_BEHIND_S)
        return Measured(self.position, self.velocity, self._read_s - before)

    def write(self, position: Vector, velocity: Vector) -> None:
        self.position = position
        self.velocity = velocity
