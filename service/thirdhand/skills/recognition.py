"""Segments and stillness of a whole take at once, by the functions with which a cell recognises
them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kmp.compiled import compiled
from thirdhand.core.frame import Records, Vector
from thirdhand.core.intake.hand_estimator import STILL, smoothing, stillness_after
from thirdhand.core.skill.segments import add_followed, along_both, on_way, recognise
from thirdhand.core.skill.tuning import FIRST_SEGMENT_ODDS
from thirdhand.core.tuning import TUNING


@compiled
def recognised(moving: Vector, periods_s: float, segments: Records, out: Vector) -> None:
    """Write the beliefs (T, K) in the segments for hands that move (T, 3, 6) to `out`."""
    for t in range(len(moving)):
        if t:
            out[t] = out[t - 1]
        recognise(out[t], moving[t], periods_s, segments, FIRST_SEGMENT_ODDS)


def covered(
    hands: Vector, stillness: Vector, labels: NDArray[np.int64], segments: Records
) -> Vector:
    """Shares of the segments (T,) that hands (T, 6 or more) with this stillness (T, 2) have
    covered, and their distances from the paths [m]: (T, 4).
    """
    out = np.empty((len(hands), 4))
    _cover(np.ascontiguousarray(hands), np.ascontiguousarray(stillness), labels, segments, out)
    return out


@compiled
def _cover(
    hands: Vector, stillness: Vector, labels: NDArray[np.int64], segments: Records, out: Vector
) -> None:
    for t in range(len(hands)):
        segment = segments[labels[t]]
        out[t, 0], out[t, 1] = along_both(hands[t], stillness[t], segment)
        for side in range(2):
            _, out[t, 2 + side] = on_way(hands[t, 3 * side : 3 * side + 3], segment, side)


@compiled
def all_followed(
    hands: Vector, shares: Vector, labels: NDArray[np.int64], segments: Records, out: Vector
) -> None:
    """Add the motion of the followed hands in the segments (T,) to `out` (T, 3), see
    `add_followed`.
    """
    for t in range(len(hands)):
        add_followed(hands[t], shares[t], segments[labels[t]], out[t])


def stillness_of(velocities: Vector, period_s: float) -> Vector:
    """Stillness (T, 2) of both hands with the velocities (T, 6) [m/s]. Both start still."""
    out = np.empty((len(velocities), 2))
    stillness = STILL.copy()
    gains = smoothing(period_s)
    still_mps = TUNING.intake.hand_still_mps
    lowpass = np.zeros((2, 3))
    for row, velocity in zip(out, np.ascontiguousarray(velocities).reshape(-1, 2, 3), strict=True):
        for side in (0, 1):
            stillness[side] = stillness_after(
                velocity[side], gains, still_mps, lowpass[side], stillness[side]
            )
        row[:] = stillness
    return out
