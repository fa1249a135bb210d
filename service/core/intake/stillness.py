"""How much a hand rests, 0 to 1: what tells one that waits at a place from one that is on its way.

It comes slowly and goes at once, and neither a tremor nor a turn on the way is a rest.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Vector

PACE_S = 0.1  # over which a velocity is averaged: a tremor of 8 to 12 Hz is nearly gone from it
REST_MPS = 0.05  # a hand this fast is on its way
COMES_S, GOES_S = 0.2, 0.03  # in which a hand comes to rest, and leaves it
RESTING = np.ones(2)  # both hands


def shares(period_s: float) -> Vector:
    """The shares (3,) of pace, of coming to rest and of leaving it that a period changes."""
    return 1.0 - np.exp(-period_s / np.array([PACE_S, COMES_S, GOES_S]))


@compiled
def rest_on(velocity: Vector, shares: Vector, pace: Vector, rest: float) -> float:
    """The rest of a hand a period later, when it moves so (3,) [m/s]; `pace` (3,) is its velocity
    without tremor, moved on too.
    """
    square = 0.0
    for axis in range(3):
        pace[axis] += shares[0] * (velocity[axis] - pace[axis])
        square += pace[axis] * pace[axis]
    now = math.exp(-((square / REST_MPS**2) ** 2))
    return float(rest + (shares[1] if now > rest else shares[2]) * (now - rest))


def rested(velocities: Vector, period_s: float) -> Vector:
    """The rest (T, 2) of both hands that moved so (T, 6) [m/s], from rest."""
    out, rest = np.empty((len(velocities), 2)), RESTING.copy()
    changed, paces = shares(period_s), np.zeros((2, 3))
    for row, velocity in zip(out, np.ascontiguousarray(velocities).reshape(-1, 2, 3), strict=True):
        for side in (0, 1):
            rest[side] = rest_on(velocity[side], changed, paces[side], rest[side])
        row[:] = rest
    return out
