"""Detection of a machine that is too busy for real-time work: missed deadlines, a late loop, and
processes that wait for a processor.
"""

from __future__ import annotations

import contextlib
import resource
from collections import deque
from pathlib import Path
from typing import NamedTuple

from thirdhand.contract.records import Mode, Reason

BUSY_WINDOW_S = 2.0  # load is measured over this time
MISSED_SHARE = 0.01  # the machine is too busy if a larger share of deadlines is missed
LATE_LOOP_MS = 20.0  # an arm brakes if its commands are this late
# the machine is overloaded if some process waits for a processor in a larger share of the time
WAITING_SHARE = 0.8
# a file of Linux; if it is missing, only the loop is measured
PRESSURE = Path("/proc/pressure/cpu")


def resident_mb(**processes: int | None) -> dict[str, float]:
    """Resident memory [MB] of processes by name, given by their numbers, of those that exist."""
    sizes_mb = {}
    for name, number in processes.items():
        with contextlib.suppress(OSError):
            pages = int(Path(f"/proc/{number}/statm").read_text().split()[1])
            sizes_mb[name] = round(pages * resource.getpagesize() / 1e6, 1)
    return sizes_mb


class _Sample(NamedTuple):
    at_s: float
    tick: int
    missed: int
    waited_s: float


class Machine:
    """The load of this machine over the last BUSY_WINDOW_S, and at the time when the arm
    stopped.
    """

    def __init__(self, pressure: Path = PRESSURE) -> None:
        self._pressure = pressure
        self._samples: deque[_Sample] = deque()
        self._outcome: tuple[Mode, Reason] | None = None
        self.now = ""  # message on a machine that is too busy; empty if it is not
        # the message at the begin of the present hold or fault; empty while the arm follows
        self.at_stop = ""

    def update(
        self, now_s: float, *, tick: int, missed: int, late_ms: float, outcome: tuple[Mode, Reason]
    ) -> None:
        """Measure the load again; call it several times a second. `late_ms` is the loop's largest
        lateness in the window, `outcome` the mode and reason of the newest frame.
        """
        self._samples.append(_Sample(now_s, tick, missed, self._waited_s()))
        while self._samples[0].at_s < now_s - BUSY_WINDOW_S:
            self._samples.popleft()
        self.now = self._judged(late_ms)
        if outcome != self._outcome:
            self._outcome = outcome
            self.at_stop = "" if outcome[0] is Mode.FOLLOW else self.now

    def _judged(self, late_ms: float) -> str:
        first = self._samples[0]
        last = self._samples[-1]
        missed = last.missed - first.missed
        ticks = last.tick - first.tick
        lasts_s = last.at_s - first.at_s
        waiting = (last.waited_s - first.waited_s) / lasts_s if lasts_s > BUSY_WINDOW_S / 2 else 0.0
        reasons = []
        if missed > MISSED_SHARE * max(ticks, 1):
            reasons.append(f"{missed} of {ticks} deadlines were missed")
        if late_ms > LATE_LOOP_MS:
            reasons.append(f"the loop was up to {late_ms:.0f} ms late")
        if waiting > WAITING_SHARE:
            reasons.append(f"processes waited for a processor {min(waiting, 1.0):.0%} of the time")
        return ", ".join(reasons)

    def _waited_s(self) -> float:
        """Time since the machine's start in which some process waited for a processor [s]; 0 if not
        known.
        """
        try:
            return int(self._pressure.read_text().partition("total=")[2].split()[0]) * 1e-6
        except (OSError, ValueError, IndexError):
            return 0.0
