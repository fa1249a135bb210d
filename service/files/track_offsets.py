"""Find the stretches of a track that are displaced by a few centimetres: a step and its return.

A step d at the middle of 2n samples x(t) of an otherwise smooth motion is estimated by least
squares, together with the line of the motion: x = a + b t + d h(t), h = -1/2 before and 1/2 behind
the middle. With h' the part of h that no line a + b t explains, d = (h' . x) / (h' . h).

A stretch is displaced if it begins with a step and ends with the opposite one. Either must be
larger than the steps that the track usually shows, by noise and by what is no line in its motion.

A step that is never taken back stays: which side of it is right, a track does not show.

Found so are jumps of 2 cm and more of trackers whose noise is up to 1 mm an axis, at 24 to 240 Hz.
In noise of 2 mm at 30 Hz, or where hands swing at 1 m/s at 30 Hz, jumps below 5 cm look like noise
and motion.

Beside each number stand its range, its effect, and its measured sensitivity: bad samples missed and
clean samples removed, with the number as it is, halved and doubled, over the takes of
`tests/files/test_track_sensitivity.py` and over recorded hands.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, percentile_filter

from service.core.frame import Vector

# samples before a step and as many behind it, 3 to 5: fewer tell less of noise, more less of motion
HALF_WINDOW = 4  # missed 0.5, 6.7, 5.9 %; removed 0.03, 0.59, 0.11 %
# [m], 0.008 to 0.02: smaller steps are none
STEP_M = 0.01  # missed 0.5, 0.5, 0.7 %; removed 0.03, 0.37, 0.03 %
# of the steps within USUAL_S on either side, 70 to 90 (here 60 and 90 beside it)
USUAL_PERCENTILE = 80  # missed 0.5, 0.5, 0.6 %; removed 0.03, 1.00, 0.00 %
# [s], 0.7 to 2: shorter follows the motion sooner, longer contains less of the jump itself
USUAL_S = 1.5  # missed 0.5, 0.5, 0.5 %; removed 0.03, 0.03, 0.10 %
# a step is unusual from so many times the usual one, 2 to 3.5: more misses small jumps
UNUSUAL = 2.5  # missed 0.5, 0.5, 0.8 %; removed 0.03, 3.73, 0.00 %
# what may be left of a step and its return, as a share of their difference, 0.15 to 0.35
ALIKE = 0.25  # missed 0.5, 0.7, 0.5 %; removed 0.03, 0.03, 0.14 %
# what may be left of the estimates beside a step, as a share of it, 0.25 to 0.5: more takes fast
# motion for a step
BESIDE = 0.35  # missed 0.5, 6.5, 0.5 %; removed 0.03, 0.00, 0.38 %
# [s] from a step to its return, 3 to 6: longer, more pairs of steps look like a jump and its return
LONGEST_S = 5.0  # missed 0.5, 8.1, 0.5 %; removed 0.03, 0.03, 0.03 %


def displaced(seconds: Vector, positions: Vector) -> NDArray[np.bool_]:
    """A mask (N,) of the samples that are displaced, of positions (N, 3) [m] at times (N,) [s]."""
    mask = np.zeros(len(seconds), bool)
    if len(seconds) < 2 * HALF_WINDOW:
        return mask
    steps = _steps(seconds, positions)
    rows = _unusual(steps, round(USUAL_S / float(np.median(np.diff(seconds)))))
    after = 0
    for i, begin in enumerate(rows.tolist()):
        if begin < after:
            continue
        for end in rows[i + 1 :].tolist():
            if seconds[end] - seconds[begin] > LONGEST_S:
                break
            left, moved = steps[begin] + steps[end], steps[begin] - steps[end]
            if np.linalg.norm(left) < ALIKE * np.linalg.norm(moved):
                mask[begin + 1 : end + 1] = True
                after = end + 1
                break
    return mask


def _steps(seconds: Vector, positions: Vector) -> Vector:
    """The step (N - 1, 3) [m] between each sample and the next; 0 where less than HALF_WINDOW
    samples lie on either side, or where a pause hides it.
    """
    times = np.lib.stride_tricks.sliding_window_view(seconds, 2 * HALF_WINDOW)
    rest = _without_line(times - times.mean(axis=1, keepdims=True))
    told = rest @ _side()
    windows = np.lib.stride_tricks.sliding_window_view(positions, 2 * HALF_WINDOW, axis=0)
    found = np.einsum("ij,ikj->ik", rest, windows) / told[:, None]
    found[told < 0.5 * np.median(told)] = 0.0
    return np.pad(found, ((HALF_WINDOW - 1, HALF_WINDOW - 1), (0, 0)))


def _side(beside: int = 0) -> Vector:
    """A step of 1 in the middle of a window, or so many samples `beside` it."""
    return np.where(np.arange(2 * HALF_WINDOW) < HALF_WINDOW + beside, -0.5, 0.5)


def _without_line(times: Vector) -> Vector:
    """What no line explains of a step of 1 at times (M, 2 HALF_WINDOW), whose mean is 0."""
    out: Vector = _side() - times * (times @ _side() / np.einsum("ij,ij->i", times, times))[:, None]
    return out


def _unusual(steps: Vector, around: int) -> NDArray[np.intp]:
    """The indices of steps that are larger than usual and happen from one sample to the next: the
    estimates beside them are what a single step leaves in their windows.
    """
    size = np.linalg.norm(steps, axis=1)
    usual = percentile_filter(size, USUAL_PERCENTILE, size=2 * around + 1, mode="mirror")
    largest = maximum_filter(size, 2 * HALF_WINDOW - 1)
    (rest,) = _without_line(np.arange(0.5 - HALF_WINDOW, HALF_WINDOW)[None])
    share = (rest @ _side(1)) / (rest @ _side())
    padded = np.pad(steps, ((1, 1), (0, 0)))
    off = np.linalg.norm(0.5 * (padded[:-2] + padded[2:]) - share * steps, axis=1)
    return np.flatnonzero((size > np.maximum(STEP_M, UNUSUAL * usual)) & (size >= largest) & (off < BESIDE * size))
