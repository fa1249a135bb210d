"""Postures from which an arm may start."""

from __future__ import annotations

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.core.separation.clearance import NOBODY
from thirdhand.core.separation.stage import Separation
from thirdhand.settings.config import Settings, robot_description


def free_postures(cell: Settings, count: int, seed: int) -> list[Vector]:
    """Postures within the limits in which the arm is clear of all obstacles."""
    random = np.random.default_rng(seed)
    separation = Separation(cell, robot_description(cell))
    drawn = (random.uniform(cell.joints.lower, cell.joints.upper) for _ in iter(int, 1))
    free = (q for q in drawn if separation.clearance(q, NOBODY)[0] > 0.0)
    return [next(free) for _ in range(count)]
