"""Quantities derived from joint limits, for the stages that plan joint motion."""

from __future__ import annotations

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.settings.config import JointSettings

# distance kept from the position limits; rounding along a stop is below 1e-7 rad
LIMIT_MARGIN_RAD = 1e-6


def acceleration_rate(limits: JointSettings) -> float:
    """Smallest ratio of jerk to acceleration [1/s], over the joints."""
    return float((np.array(limits.jerk) / np.array(limits.acceleration)).min())


def approach_gain(limits: JointSettings) -> Vector:
    """Largest speed toward a position limit per distance to it, (J,) [1/s].

        gain = min(acceleration / velocity, sqrt(jerk / velocity)) / 2

    At this gain, braking takes at most half of the acceleration and a quarter of the jerk.
    """
    velocity = np.array(limits.velocity)
    gain: Vector = 0.5 * np.minimum(
        np.array(limits.acceleration) / velocity, np.sqrt(np.array(limits.jerk) / velocity)
    )
    return gain
