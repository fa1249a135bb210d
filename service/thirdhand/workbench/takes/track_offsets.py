"""Detection of the stretches of a track that are displaced by a few centimetres.

A step d at the middle of 2n samples x(t) of an otherwise smooth motion is estimated by least
squares, together with the line of the motion: x = a + b t + d h(t), with h = -1/2 before and 1/2
after the middle. With h' the part of h that is orthogonal to all lines a + b t,
d = (h' . x) / (h' . h).

A stretch is displaced if it begins with a step and ends with the opposite step. One or two samples
that leave the track and return are no step. Both must be larger
than the usual steps of the track, which are caused by noise and by the curvature of its motion. A
step without a return is accepted, because a track does not show which side of it is right.

The method finds jumps from 2 cm on of trackers with a noise of up to 1 mm per axis at 24 to 240 Hz.
With a noise of 2 mm at 30 Hz, or for hands that swing at 1 m/s at 30 Hz, jumps below 5 cm cannot be
distinguished from noise and motion.

Each number has its range, its effect, and its measured sensitivity: the shares of bad samples
missed and of clean samples removed with the number as it is, halved and doubled, over the takes of
`tests/files/test_track_sensitivity.py` and over recorded hands.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter, percentile_filter

from thirdhand.core.frame import Vector

# n, the samples before and after a step. Range 3 to 5: smaller values average less noise, larger
# ones include more of the motion's curvature.
HALF_WINDOW = 4  # missed 0.5, 6.7, 5.9 %; removed 0.03, 0.59, 0.11 %
# [m] Smaller steps are ignored. Range 0.008 to 0.02.
STEP_M = 0.01  # missed 0.5, 0.5, 0.7 %; removed 0.03, 0.37, 0.03 %
# The usual step is this percentile within USUAL_S to both sides. Range 70 to 90 (measured: 60, 90).
USUAL_PERCENTILE = 80  # missed 0.5, 0.5, 0.6 %; removed 0.03, 1.00, 0.00 %
# [s] Range 0.7 to 2: smaller values follow the motion sooner, larger ones include less of the jump.
USUAL_S = 1.5  # missed 0.5, 0.5, 0.5 %; removed 0.03, 0.03, 0.10 %
# A step is unusual from this multiple of the usual step on. Range 2 to 3.5: larger values miss
# small jumps.
UNUSUAL_RATIO = 2.5  # missed 0.5, 0.5, 0.8 %; removed 0.03, 3.73, 0.00 %
GLITCH_WINDOW = 5  # samples of a median, on which up to two wrong ones have no effect
# A sample is off from this multiple of the usual distance from that median on. Range 2.5 to 5.
GLITCH_RATIO = 3.0
# |step + return| / |step - return| of a jump. Range 0.15 to 0.35.
MAX_REMAINDER = 0.25  # missed 0.5, 0.7, 0.5 %; removed 0.03, 0.03, 0.14 %
# Residual of the estimates beside a single step / step. Range 0.25 to 0.5: with larger values, fast
# motion looks like a step.
MAX_BESIDE = 0.35  # missed 0.5, 6.5, 0.5 %; removed 0.03, 0.00, 0.38 %
# [s] Time from a step to its return. Range 3 to 6: with larger values, more pairs of steps look
# like a jump.
MAX_JUMP_S = 5.0  # missed 0.5, 8.1, 0.5 %; removed 0.03, 0.03, 0.03 %


def displaced(seconds: Vector, positions: Vector) -> NDArray[np.bool_]:
    """A mask (N,) of the displaced samples among positions (N, 3) [m] at times (N,) [s]."""
    mask = np.zeros(len(seconds), bool)
    if len(seconds) < 2 * HALF_WINDOW:
        return mask
    around = round(USUAL_S / float(np.median(np.diff(seconds))))
    steps = _steps(seconds, _without_glitches(positions, around))
    rows = _unusual(steps, around)
    after = 0
    for i, begin in enumerate(rows.tolist()):
        if begin < after:
            continue
        for end in rows[i + 1 :].tolist():
            if seconds[end] - seconds[begin] > MAX_JUMP_S:
                break
            left = steps[begin] + steps[end]
            moved = steps[begin] - steps[end]
            if np.linalg.norm(left) < MAX_REMAINDER * np.linalg.norm(moved):
                mask[begin + 1 : end + 1] = True
                after = end + 1
                break
    return mask


def _without_glitches(positions: Vector, around: int) -> Vector:
    """The positions (N, 3) [m]; one or two positions that are farther from the median of their
    neighbourhood than usual among `around` neighbours are replaced by it.
    """
    medians = median_filter(positions, (GLITCH_WINDOW, 1), mode="nearest")
    distances_m = np.linalg.norm(positions - medians, axis=1)
    return np.where(
        (distances_m > GLITCH_RATIO * _usual(distances_m, around))[:, None], medians, positions
    )


def _usual(sizes: Vector, around: int) -> Vector:
    """The usual size near each of the sizes (N,): a percentile over `around` neighbours on both
    sides.
    """
    return np.asarray(
        percentile_filter(sizes, USUAL_PERCENTILE, size=2 * around + 1, mode="mirror")
    )


def _steps(seconds: Vector, positions: Vector) -> Vector:
    """The estimated steps (N - 1, 3) [m] between each sample and the next; 0 if one side has fewer
    than HALF_WINDOW samples, or if a pause hides the step.
    """
    times = np.lib.stride_tricks.sliding_window_view(seconds, 2 * HALF_WINDOW)
    residual = _without_line(times - times.mean(axis=1, keepdims=True))
    scale = residual @ _side()  # h' . h
    windows = np.lib.stride_tricks.sliding_window_view(positions, 2 * HALF_WINDOW, axis=0)
    steps_m = np.einsum("ij,ikj->ik", residual, windows) / scale[:, None]
    steps_m[scale < 0.5 * np.median(scale)] = 0.0
    return np.pad(steps_m, ((HALF_WINDOW - 1, HALF_WINDOW - 1), (0, 0)))


def _side(beside: int = 0) -> Vector:
    """A unit step h (2 HALF_WINDOW,) in the middle of a window, or `beside` samples after it."""
    return np.where(np.arange(2 * HALF_WINDOW) < HALF_WINDOW + beside, -0.5, 0.5)


def _without_line(times: Vector) -> Vector:
    """The part h' of a unit step that is orthogonal to all lines, for times (M, 2 HALF_WINDOW) with
    mean 0.
    """
    out: Vector = _side() - times * (times @ _side() / np.einsum("ij,ij->i", times, times))[:, None]
    return out


def _unusual(steps: Vector, around: int) -> NDArray[np.intp]:
    """The indices of steps that are larger than usual and happen between two samples: the estimates
    beside them equal those that a single step causes there.
    """
    size = np.linalg.norm(steps, axis=1)
    usual = _usual(size, around)
    largest = maximum_filter(size, 2 * HALF_WINDOW - 1)
    (residual,) = _without_line(np.arange(0.5 - HALF_WINDOW, HALF_WINDOW)[None])
    share = (residual @ _side(1)) / (residual @ _side())
    padded = np.pad(steps, ((1, 1), (0, 0)))
    deviations_m = np.linalg.norm(0.5 * (padded[:-2] + padded[2:]) - share * steps, axis=1)
    return np.flatnonzero(
        (size > np.maximum(STEP_M, UNUSUAL_RATIO * usual))
        & (size >= largest)
        & (deviations_m < MAX_BESIDE * size)
    )
