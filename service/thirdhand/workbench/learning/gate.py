"""Gate of a skill: the value of `gate_m` above which hands are too far from the demonstrations.

With u the largest value on held-out takes, w the smallest over the kinds of wrong samples of their
5 % quantiles, and h the quantile of the held-out values above which the gate may hold,

    gate = min(sqrt(u w), 2 u)        if w > u: the gate separates both
           min(max(w, h), u)          otherwise

then limited to the range from a floor to a ceiling.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thirdhand.core.frame import Vector

HELD_OUT_TIMES = 2.0  # the gate is at most this multiple of the largest held-out value
# no target with a larger deviation on each axis is followed: objects have about this size
CEILING_M = 0.15
# twice the standard deviation of the noisiest tracker, whose noise must not look like a detour
FLOOR_M = 0.02
PASSED_SHARE = 0.05  # this share of the wrong samples may pass
MAX_HOLD_SHARE = 0.02  # a gate that does not separate both holds at most this share of the time
BESIDE_M = 0.3  # wrong samples are displaced by this distance along each axis, in either direction
WRONG_SAMPLES = 50  # samples of a take from which wrong ones are made


class Caught(NamedTuple):
    """The shares of wrong samples that a gate holds, 0 to 1."""

    swapped: float  # left and right hand swapped
    beside: float  # both hands displaced
    one_beside: float  # one hand displaced


class Gate(NamedTuple):
    """A threshold [m] on a prediction's `gate_m`, and the wrong samples that it holds."""

    threshold: float
    caught: Caught
    capped: bool  # true if the ceiling is the threshold
    floored: bool  # true if the floor is the threshold


def gate_between(
    held_out: Vector,
    wrong: Sequence[Vector],
    *,
    ceiling: float,
    floor: float = 0.0,
    hold_share: float = MAX_HOLD_SHARE,
) -> Gate:
    """The gate between the values [m] of held-out takes (T,) and of each kind of wrong samples."""
    most = float(held_out.max())
    least = min(float(np.quantile(values, PASSED_SHARE)) for values in wrong)
    if least > most:
        threshold = min(float(np.sqrt(most * least)), HELD_OUT_TIMES * most)
    else:
        threshold = min(max(least, float(np.quantile(held_out, 1 - hold_share))), most)
    capped = threshold > ceiling
    floored = threshold < floor
    threshold = max(min(threshold, ceiling), floor)
    return Gate(
        threshold,
        Caught(*(float((values > threshold).mean()) for values in wrong)),
        capped,
        floored,
    )


def every_few(samples: Vector) -> Vector:
    """About WRONG_SAMPLES of the samples (T, ...), even in time."""
    return samples[:: max(1, len(samples) // WRONG_SAMPLES)]


def nonsense(hands: Vector) -> tuple[Vector, Vector, Vector]:
    """Wrong samples of hands (M, 6) [m]: both swapped, both displaced, and one displaced.

    A hand that conducts alone can only be displaced.
    """
    steps = BESIDE_M * np.concatenate([np.eye(3), -np.eye(3)])
    none = np.zeros_like(steps)
    both_steps = np.hstack([steps, steps])
    single_steps = np.concatenate([np.hstack([steps, none]), np.hstack([none, steps])])
    both_beside, one_beside = (
        (hands[:, None] + moved).reshape(-1, 6) for moved in (both_steps, single_steps)
    )
    if np.array_equal(hands[:, :3], hands[:, 3:]):
        return both_beside, both_beside, both_beside
    return np.roll(hands, 3, axis=1), both_beside, one_beside
