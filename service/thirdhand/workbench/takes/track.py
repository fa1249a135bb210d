"""Tracks, which are the recorded poses of one hand or of the tool."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thirdhand.core.frame import Vector
from thirdhand.core.tuning import TUNING

WINDOW = 3  # a restart of a clock is found by comparing three stamps with the three before

Stamps = NDArray[np.int64]
Rows = NDArray[np.intp]


class Track(NamedTuple):
    """Poses (N, 7) of one stream, x y z and quaternion x y z w, in `frame`; their stamps (N,) [ns]
    and the times at which they were recorded (N,) [ns].
    """

    name: str
    source: str
    stamps_ns: Stamps
    logged_ns: Stamps
    poses: Vector
    frame: str

    def at(self, rows: Rows | NDArray[np.bool_]) -> Track:
        """The track with only these of its poses, by index or mask."""
        return self._replace(
            stamps_ns=self.stamps_ns[rows], logged_ns=self.logged_ns[rows], poses=self.poses[rows]
        )


def clock_parts(stamps: Stamps) -> list[Rows]:
    """The indices of stamps (N,) [ns], in the order of recording, split where their clock restarts.

    A clock restarts where three stamps are older than the three before by more than the largest
    delay. A single wrong stamp does not split them.
    """
    if len(stamps) < 2 * WINDOW:
        return [np.arange(len(stamps))]
    windows = np.lib.stride_tricks.sliding_window_view(stamps, WINDOW)
    before = np.median(windows[:-WINDOW], axis=1)
    behind = windows[WINDOW:].max(axis=1)
    is_anew = behind < before - 1e9 * TUNING.intake.max_late_s
    is_anew[1:] &= ~is_anew[:-1]
    return np.split(np.arange(len(stamps)), np.flatnonzero(is_anew) + WINDOW)
