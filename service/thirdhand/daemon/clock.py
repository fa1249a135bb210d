"""The daemon's clock: phase-locked deadlines, real-time scheduling if the system grants it, and
statistics of lateness.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from thirdhand.contract.explain import in_words
from thirdhand.contract.requests import Percentiles
from thirdhand.core.frame import STAGES, Frame, Record, Vector, timed

log = logging.getLogger("thirdhand")
SPIN_NS = 100_000  # busy waiting before a deadline, only under real-time scheduling
# the next tick is prepared within this time; at 350 µs, one tick of 100 was 20 to 70 µs late
PREPARING_NS = 480_000
PREPARE_NS = 3 * PREPARING_NS // 2  # preparation begins this long before the deadline
BESIDE_NS = 300_000  # work beside the loop is done in parts, most of which take less
NO_TICK_S = 0.02  # work beside a loop that does not tick is done after this time
STEP_NS = 20_000_000  # a larger difference from the system clock shows that the clock was set
READ_NS = 1_000_000  # two clocks that were read within this time are compared
DRAW = 256  # [deadlines] time constant with which stamps follow a smaller difference
CREEP_NS = 1_000  # stamps grow by this per deadline while the system clock is behind
_LOCK_TOUCHED_PAGES = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of Linux
FIFO_PRIORITY = 80  # priority of the loop
BESIDE_PRIORITY = 10  # priority of threads that may hold the interpreter lock
AWAKE = "/dev/cpu_dma_latency"  # Linux's file for the latency that idle processors may have [µs]
MAX_LATENCY_MS = 1000.0  # a longer latency shows that the clocks differ
_PLACE_OF_STAGE = {stage: place for place, stage in enumerate(STAGES)}


class Deadlines:
    """Deadlines at a fixed rate since start.

    Missed deadlines are skipped and counted; there is no burst to make up for them. `stamp_ns` is
    the time of the newest deadline on the system clock [ns], and always grows. It advances by whole
    periods and follows the system clock slowly. If the clock was set ahead, the next stamp follows;
    if it was set back, stamps grow by CREEP_NS per deadline until the clock has passed them.
    """

    def __init__(
        self,
        rate_hz: int,
        *,
        spin_ns: int = 0,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_ns = 1_000_000_000 // rate_hz
        self.missed = 0
        self._spin_ns = spin_ns
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._sleep = sleep
        self._start_ns = now_ns()
        self.stamp_ns = wall_ns() - self.period_ns
        self._index = -1
        self._sleeps_until_ns = 0
        # locked by `between_ticks`, released at the end of a tick
        self._is_in_tick = threading.Lock()

    def between_ticks(self) -> None:
        """Wait, on another thread, until the loop sleeps for at least BESIDE_NS more, or has just
        begun to sleep.

        A thread that holds the interpreter lock when the loop wakes delays it. Only one thread may
        use this.
        """
        if self._now_ns() > self._sleeps_until_ns - BESIDE_NS:
            # locked, if it is not yet; then locked again once the loop has released it
            self._is_in_tick.acquire(blocking=False)
            self._is_in_tick.acquire(timeout=NO_TICK_S)

    def wait(self, prepare: Callable[[int, int], None] | None = None) -> tuple[int, int]:
        """Wait for the next deadline and return its number and lateness [ns].

        `prepare` is called PREPARE_NS before the deadline with its number and stamp, unless it
        would end after the deadline. If it raises an exception, the deadline is still to come.
        """
        wall_ns = self._wall_ns()
        now_ns = self._now_ns()
        index = max(self._index + 1, (now_ns - self._start_ns) // self.period_ns)
        passed = index - self._index
        deadline = self._start_ns + index * self.period_ns
        stamp_ns = self._stamp_ns(passed, wall_ns + deadline - now_ns)
        self._sleeps_until_ns = deadline - (self._spin_ns if prepare is None else PREPARE_NS)
        if self._is_in_tick.locked():
            self._is_in_tick.release()

        if prepare is not None:
            self._sleep_until(deadline - PREPARE_NS)
            if self._now_ns() < deadline - PREPARING_NS:
                prepare(index, stamp_ns)
        self._sleep_until(deadline - self._spin_ns)
        while (late := self._now_ns() - deadline) < 0:
            pass

        self.missed += passed - 1
        self._index = index
        self.stamp_ns = stamp_ns
        return index, late

    def _stamp_ns(self, passed: int, wall_ns: int) -> int:
        """The stamp of a deadline this many periods after the newest one, when the system clock
        will show `wall_ns`.
        """
        due_ns = self.stamp_ns + passed * self.period_ns
        drift_ns = wall_ns - due_ns
        if drift_ns >= STEP_NS:
            return wall_ns
        return self.stamp_ns + CREEP_NS if drift_ns <= -STEP_NS else due_ns + drift_ns // DRAW

    def _sleep_until(self, at_ns: int) -> None:
        """Sleep until a time [ns], unless it has passed."""
        early = at_ns - self._now_ns()
        if early > 0:
            self._sleep(early / 1e9)

    def rate_hz(self) -> float:
        """Achieved ticks per second since start."""
        elapsed = self._now_ns() - self._start_ns
        return round((self._index + 1 - self.missed) * 1e9 / elapsed, 3) if elapsed > 0 else 0.0


class SystemClock:
    """The system clock, watched for steps against the monotonic one."""

    def __init__(
        self,
        *,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._apart_ns: int | None = None  # difference of the clocks at the last reading

    def set_by(self) -> str:
        """How far the clock was set since the last call, in words; empty if it was not.

        A reading that took long, because others ran meanwhile, is left to the next call.
        """
        begin_ns = self._now_ns()
        apart_ns = self._wall_ns() - begin_ns
        if self._now_ns() - begin_ns > READ_NS:
            return ""
        set_ns = 0 if self._apart_ns is None else apart_ns - self._apart_ns
        self._apart_ns = apart_ns
        if -STEP_NS < set_ns < STEP_NS:
            return ""
        size = f"by {abs(set_ns) / 1e9:.2f} s"
        return (
            f"ahead {size}, or the machine was suspended meanwhile"
            if set_ns > 0
            else f"back {size}"
        )


class Granted(NamedTuple):
    """The requests of the loop that the operating system granted."""

    realtime: bool  # real-time scheduling of the thread
    memory_locked: bool  # memory pages of the process remain in memory once they are used
    awake: bool  # idle processors do not sleep, which would empty their caches


def ask_for_real_time(*, awake: bool = False) -> Granted:
    """Request real-time scheduling for this thread and locked memory, and, if so wished, that the
    processors stay `awake` until this process ends. Returns what was granted.

    Existing objects are exempted from garbage collection in any case, and it is enabled.
    """
    gc.collect()
    gc.freeze()
    gc.enable()
    sys.setswitchinterval(0.0005)
    return Granted(_scheduled(), _locked(), awake and _awake())


def _scheduled() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except (PermissionError, AttributeError, OSError):
        return False
    return True


def _locked() -> bool:
    try:
        return bool(ctypes.CDLL(None).mlockall(_LOCK_TOUCHED_PAGES) == 0)
    except (OSError, AttributeError):
        return False


def _awake() -> bool:
    """Ask for idle processors without latency, which Linux grants while the file is open."""
    try:
        os.write(os.open(AWAKE, os.O_WRONLY), bytes(4))
    except OSError as error:
        log.warning(
            "idle processors may sleep: %s. docs/hardware.md says how to allow it, or set awake = "
            "false under [loop]",
            in_words(error),
        )
        return False
    return True


def run_beside_real_time() -> None:
    """Schedule this thread before other processes, if granted: if it is preempted while it holds
    the interpreter lock, it delays the loop.
    """
    with contextlib.suppress(PermissionError, AttributeError, OSError):
        os.sched_setscheduler(
            0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(BESIDE_PRIORITY)
        )


class Window:
    """A buffer of the last values of a quantity, written by one thread and read by another."""

    def __init__(self, length: int) -> None:
        self._values: Vector = np.zeros(length)
        self._count = 0

    def add(self, value: float) -> None:
        """Add a value."""
        self._values[self._count % len(self._values)] = value
        self._count += 1

    def largest(self, count: int) -> float:
        """The largest of the `count` newest values; 0 while the window is empty."""
        places = np.arange(self._count - min(count, self._count), self._count)
        newest = self._values.take(places, mode="wrap")
        return float(newest.max(initial=0.0))

    def percentiles(self) -> Percentiles:
        """Median, 99th percentile and maximum over the window; zeros while the window is empty."""
        if not self._count:
            return Percentiles()
        return Percentiles(
            *np.percentile(self._values[: self._count], (50, 99, 100)).round(3).tolist()
        )


class TickTimes:
    """Lateness and work of the ticks of the last 10 s, the latency of the hands in them, and the
    durations of the stages of the present tick. `begin`, `lap` and `end` are for the loop.
    """

    def __init__(self, rate_hz: int) -> None:
        self.windows = {
            name: Window(10 * rate_hz) for name in ("lateness_us", "work_us", "latency_ms")
        }
        self._late_ns = self._began_ns = self._lap_ns = 0
        self._stages_us = [0.0] * len(STAGES)

    def begin(self, late_ns: int) -> None:
        """Note that a tick begins, this late [ns]."""
        self._late_ns = late_ns
        self._began_ns = self._lap_ns = time.perf_counter_ns()

    def lap(self, stage: str) -> None:
        """Note that a stage of the tick ends, or of its rehearsal; the first one begins anew."""
        now_ns = time.perf_counter_ns()
        if stage == STAGES[0]:
            self._stages_us = [0.0] * len(STAGES)
        self._stages_us[_PLACE_OF_STAGE[stage]] = (now_ns - self._lap_ns) / 1e3
        self._lap_ns = now_ns

    def end(self, frame: Frame, clock: Deadlines) -> Record:
        """The timing of the tick that decided this frame, as it is recorded."""
        latency_ms = 0.0
        if 0 in frame["hand_ages"].tolist():
            since_stamp_ms = (time.time_ns() - int(frame["hand_stamp_ns"])) / 1e6
            if 0 <= since_stamp_ms < MAX_LATENCY_MS:
                latency_ms = since_stamp_ms
                self.windows["latency_ms"].add(latency_ms)

        late_us = self._late_ns / 1e3
        work_us = (time.perf_counter_ns() - self._began_ns) / 1e3
        self.windows["lateness_us"].add(late_us)
        self.windows["work_us"].add(work_us)
        tick = int(frame["tick"])
        return timed(
            tick,
            clock.stamp_ns,
            clock.missed,
            late_us,
            work_us,
            1e3 * latency_ms,
            self._stages_us,
        )
