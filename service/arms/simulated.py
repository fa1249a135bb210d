"""An arm that is ideal and only a list of numbers: to try a cell without one."""

from __future__ import annotations

import time

import numpy as np

from service.arms.drive import Measured
from service.arms.playback import SpeedLimits
from service.core.frame import Vector
from service.settings.config import Settings

PERIOD_S = 0.001
MOST_BEHIND_S = 0.05  # that is made up for; after a longer pause it goes on from then


class SimulatedArm:
    """Does what it is told at once, from the posture in its settings."""

    speed_limits: SpeedLimits | None = None
    period_s: float = PERIOD_S
    takes_velocity: bool = False

    def __init__(self, settings: Settings) -> None:
        self.limits = settings.joints
        self.position, self.velocity = np.array(settings.arm.posture), np.zeros(len(settings.joints.names))

    def __enter__(self) -> SimulatedArm:
        self._read_s = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        """It stands."""

    def stands_at(self) -> Vector:
        """As `Drive` says, as all here."""
        return self.position

    def read(self) -> Measured:
        before, due_s = self._read_s, self._read_s + PERIOD_S
        time.sleep(max(due_s - time.monotonic(), 0.0))
        self._read_s = max(due_s, time.monotonic() - MOST_BEHIND_S)
        return Measured(self.position, self.velocity, self._read_s - before)

    def write(self, position: Vector, velocity: Vector) -> None:
        self.position, self.velocity = position, velocity
