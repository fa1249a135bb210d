"""Selection of the frames that fit into a drawing within the budget of its file."""

from __future__ import annotations

import math

import numpy as np

from service.core.frame import TIMING, Record
from service.viewer.dynamic import DrawnFrame

SHARE = 0.8  # share of the budget that is used
LEAST_SHARE = 0.2  # least share of the budget for frames
FRAME_BYTES = 1800.0  # size of a drawn frame, before it is estimated from the file
MAX_FRAME_BYTES = 2.0 * FRAME_BYTES  # limit of the estimate, which contains everything that grows in the file
PEAKS = ("lateness_us", "work_us", "latency_us", "stages_us")


class Thinning:
    """Keep one of several frames, so that files of `segment_s` [s] take at most `mb_per_hour`.

    Frames at which mode or reason change are always kept. A kept frame has the largest times of the
    frames left out before it. The number left out follows from the size of the file.
    """

    def __init__(self, mb_per_hour: float, *, rate_hz: int, segment_s: float) -> None:
        self._budget_bytes_s, self._segment_s, self._rate_hz = mb_per_hour * 1e6 / 3600, segment_s, rate_hz
        self._left_out: list[Record] = []
        self._last_tick, self._last_outcome = -1, (-1, -1)
        self._frame_bytes = FRAME_BYTES
        self.restart(0)

    @property
    def every(self) -> int:
        """Number of frames of which one is kept."""
        share = max(LEAST_SHARE, SHARE - self._static / self._segment_s / self._budget_bytes_s)
        every = math.ceil(self._frame_bytes * self._rate_hz / (share * self._budget_bytes_s))
        return min(max(1, every), self._rate_hz)

    def restart(self, size: int) -> None:
        """Start another file, which has `size` bytes before the first frame."""
        self._static, self._sent, self._last_tick = size, 0, -1
        self._every = self.every

    def kept(self, shown: DrawnFrame) -> DrawnFrame | None:
        """The frame to be drawn; None if it is left out."""
        frame = shown.frame
        tick, outcome = int(frame["tick"]), (int(frame["mode"]), int(frame["reason"]))
        if tick // self._every == self._last_tick // self._every and outcome == self._last_outcome:
            if shown.timing is not None:
                self._left_out.append(shown.timing)
            return None
        self._last_tick, self._last_outcome = tick, outcome
        if shown.timing is None or not self._left_out:
            return shown
        times = np.array([*self._left_out, shown.timing], TIMING)
        self._left_out = []
        timing = times[-1]
        for name in PEAKS:
            timing[name] = times[name].max(axis=0)
        return shown._replace(timing=timing)

    def sent(self, count: int, size: int) -> None:
        """Count frames on their way to the file, which has `size` bytes without them."""
        if self._sent and size > self._static:
            self._frame_bytes = min((size - self._static) / self._sent, MAX_FRAME_BYTES)
            self._every = self.every
        self._sent += count
