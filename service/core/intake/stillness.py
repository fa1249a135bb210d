"""How still a hand is, 0 to 1: what tells a hand that waits at a via-point from one on its way.

Stillness comes slowly and goes at once, and neither a tremor nor a turn on the way is still.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.record import Vector

LOWPASS_S = 0.1  # time constant of the velocity: a tremor of 8 to 12 Hz is nearly gone from it
STILL_SPEED = 0.05  # [m/s] a hand this fast is on its way
RISE_S = 0.2  # in which a hand comes to be still
FALL_S = 0.03  # in which it is still no more
ROUND_TO = 1e9  # of what is remembered: machines that differ in the last bits agree
STILL = np.ones(2)  # both hands


def smoothing(period_s: float) -> Vector:
    """By how much (3,) the lowpass velocity, rising and falling stillness change in a period."""
    return 1.0 - np.exp(-period_s / np.array([LOWPASS_S, RISE_S, FALL_S]))


@compiled
def stillness_after(velocity: Vector, smoothing: Vector, lowpass: Vector, stillness: float) -> float:
    """The stillness of a hand a period later, when it moves so (3,) [m/s]; `lowpass` (3,) is its
    velocity without tremor, moved on too.
    """
    square = 0.0
    for axis in range(3):
        lowpass[axis] = np.rint((lowpass[axis] + smoothing[0] * (velocity[axis] - lowpass[axis])) * ROUND_TO) / ROUND_TO
        square += lowpass[axis] * lowpass[axis]
    share = square / STILL_SPEED**2
    now = math.exp(-share * share)
    after = stillness + (smoothing[1] if now > stillness else smoothing[2]) * (now - stillness)
    return float(np.rint(after * ROUND_TO) / ROUND_TO)


def stillness_of(velocities: Vector, period_s: float) -> Vector:
    """The stillness (T, 2) of both hands that moved so (T, 6) [m/s], from stillness."""
    out, stillness = np.empty((len(velocities), 2)), STILL.copy()
    changed, lowpass = smoothing(period_s), np.zeros((2, 3))
    for row, velocity in zip(out, np.ascontiguousarray(velocities).reshape(-1, 2, 3), strict=True):
        for side in (0, 1):
            stillness[side] = stillness_after(velocity[side], changed, lowpass[side], stillness[side])
        row[:] = stillness
    return out
