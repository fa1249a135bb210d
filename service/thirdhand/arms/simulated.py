"""An ideal arm without physics, to try a cell without a robot."""

from __future__ import annotations

import numpy as np

from thirdhand.arms.arm import Arm
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings


class SimulatedArm(Arm):
    """An arm that follows each command at once, from the posture in its settings."""

    period_s = 0.001

    def __init__(self, settings: Settings, address: str = "") -> None:
        super().__init__(settings, address)
        self.position = np.array(settings.arm.posture)
        self.velocity = np.zeros(len(settings.joints.names))

    def read(self) -> tuple[Vector, Vector]:
        return self.position, self.velocity

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        self.position = position
        self.velocity = velocity
