"""The gate: above which value of `gate_m` hands are far from the demonstrations, and what it
catches.

Chosen between what held-out demonstrations reach and what planted nonsense reaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from service.core.frame import Vector

HELD_OUT_TIMES = 2.0  # the gate is at most so many times what held-out demonstrations reach
CEILING_M = 0.15  # and no tool is followed that may be so far off, each axis: a thing held is as large
FLOOR_M = 0.02  # nor does a hand count as off its ways that only looks so: twice the noisiest tracker's deviation
MISSED = 0.05  # of the nonsense may pass, and
FALSE = 0.02  # of the time may a gate hold that does not separate the two
BESIDE_M = 0.3


class Caught(NamedTuple):
    """Shares of planted nonsense that a gate holds, 0 to 1."""

    swapped: float  # left and right hand for each other
    beside: float  # both hands 30 cm beside where they were
    one_beside: float  # one of them


class Gate(NamedTuple):
    """A threshold [m] on a prediction's `gate_m`, and what it catches."""

    threshold: float
    caught: Caught
    capped: bool  # whether the ceiling alone made it,
    floored: bool  # or the floor


def gate_between(
    held_out: Vector, wrong: Sequence[Vector], *, ceiling: float, floor: float = 0.0, false: float = FALSE
) -> Gate:
    """The gate between what held-out demonstrations (T,) and each kind of nonsense reach [m]."""
    most = float(held_out.max())
    least = min(float(np.quantile(x, MISSED)) for x in wrong)
    if least > most:
        threshold = min(float(np.sqrt(most * least)), HELD_OUT_TIMES * most)
    else:
        threshold = min(max(least, float(np.quantile(held_out, 1 - false))), most)
    capped, floored, threshold = threshold > ceiling, threshold < floor, max(min(threshold, ceiling), floor)
    return Gate(threshold, Caught(*(float((x > threshold).mean()) for x in wrong)), capped, floored)


def nonsense(hands: Vector) -> tuple[Vector, Vector, Vector]:
    """Hands (M, 6) [m] swapped, both beside, and one beside: 30 cm along each axis, either way."""
    ways = BESIDE_M * np.concatenate([np.eye(3), -np.eye(3)])
    none = np.zeros_like(ways)
    both, one = np.hstack([ways, ways]), np.concatenate([np.hstack([ways, none]), np.hstack([none, ways])])
    moved = ((hands[:, None] + steps).reshape(-1, 6) for steps in (both, one))
    beside, one_beside = moved
    if np.array_equal(hands[:, :3], hands[:, 3:]):  # one conducts alone: it has none to be swapped with or left by
        return beside, beside, beside
    return np.roll(hands, 3, axis=1), beside, one_beside
