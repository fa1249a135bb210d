"""The clock: deadlines stay in phase and are skipped if missed; figures of its punctuality."""

from __future__ import annotations

import gc
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from thirdhand.daemon import clock as clock_module
from thirdhand.daemon.clock import (
    BESIDE_NS,
    CREEP_NS,
    PREPARE_NS,
    PREPARING_NS,
    READ_NS,
    STEP_NS,
    Deadlines,
    SystemClock,
    ask_for_real_time,
)

PERIOD_NS = 2_000_000
WALL_NS = 1_800_000_000_000_000_000


class FakeClock:
    """A clock that advances when set, during a sleep (longer than requested), and a little at each
    reading.
    """

    def __init__(self, *, oversleep_ns: int = 0, look_ns: int = 0) -> None:
        self.now = 1_000_000_007
        self.oversleep_ns = oversleep_ns
        self.look_ns = look_ns
        self.slept_s: list[float] = []
        self.set_by_ns = 0  # step of the system clock

    def wall_ns(self) -> int:
        return WALL_NS + self.now + self.set_by_ns

    def now_ns(self) -> int:
        self.now += self.look_ns
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now += round(seconds * 1e9) + self.oversleep_ns

    def deadlines(self, *, spin_ns: int = 0) -> Deadlines:
        return Deadlines(
            500, spin_ns=spin_ns, now_ns=self.now_ns, wall_ns=self.wall_ns, sleep=self.sleep
        )


def test_deadlines_stay_in_phase_however_late_each_wake_is() -> None:
    clock = FakeClock(oversleep_ns=300_000)
    start = clock.now
    deadlines = clock.deadlines()
    for tick in range(1000):
        index, late_ns = deadlines.wait()
        assert index == tick
        assert clock.now - start == tick * PERIOD_NS + late_ns
        assert late_ns == (300_000 if tick else 0)
    assert deadlines.missed == 0


@example_settings(max_examples=50, deadline=None, derandomize=True)
@example([3 * PERIOD_NS + 100, 0])
@given(st.lists(st.integers(0, 5 * PERIOD_NS), min_size=1, max_size=60))
def test_there_is_never_a_burst(work_ns: list[int]) -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    last = -1
    for work in work_ns:
        before = clock.now
        index, late_ns = deadlines.wait()
        assert index > last
        assert 0 <= late_ns < PERIOD_NS
        assert clock.now - before <= PERIOD_NS
        last = index
        clock.now += work
    assert last + 1 == len(work_ns) + deadlines.missed


def test_sleep_ends_before_the_deadline_and_spinning_reaches_it() -> None:
    clock = FakeClock(look_ns=1_000)
    deadlines = clock.deadlines(spin_ns=100_000)
    deadlines.wait()
    _, late_ns = deadlines.wait()
    assert clock.slept_s[-1] <= (PERIOD_NS - 100_000) / 1e9
    assert 0 <= late_ns <= 1_000


def stamps(clock: FakeClock, deadlines: Deadlines, count: int) -> list[int]:
    """The stamps of the next deadlines."""
    stamps_ns = []
    for _ in range(count):
        deadlines.wait()
        stamps_ns.append(deadlines.stamp_ns)
    return stamps_ns


def test_stamps_grow_by_the_time_between_deadlines() -> None:
    """Missed deadlines count too."""
    clock = FakeClock(oversleep_ns=300_000)
    deadlines = clock.deadlines()
    assert set(np.diff(stamps(clock, deadlines, 10))) == {PERIOD_NS}
    clock.now += 98 * PERIOD_NS
    before = deadlines.stamp_ns
    deadlines.wait()
    assert deadlines.stamp_ns - before == 98 * PERIOD_NS
    # the time of the deadline, not of waking up
    assert deadlines.stamp_ns == WALL_NS + clock.now - 300_000


def test_stamps_grow_while_a_set_back_clock_catches_up() -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    before = stamps(clock, deadlines, 5)[-1]
    clock.set_by_ns -= 1_000_000_000
    after = stamps(clock, deadlines, 600)
    steps = np.diff([before, *after])
    assert (steps > 0).all()
    assert (steps[:480] == CREEP_NS).all()
    assert abs(after[-1] - clock.wall_ns()) < STEP_NS


def test_stamps_follow_a_drifting_clock_without_a_jump() -> None:
    """The system clock drifts; stamps approach it without a jump."""
    clock = FakeClock()
    deadlines = clock.deadlines()
    stamps(clock, deadlines, 5)
    for _ in range(3000):
        # 500 parts in a million, the largest slew of a clock
        clock.set_by_ns += 1_000
        before = deadlines.stamp_ns
        deadlines.wait()
        assert abs(deadlines.stamp_ns - before - PERIOD_NS) <= 1_000
    assert abs(deadlines.stamp_ns - clock.wall_ns()) < 1_000_000


def test_suspended_machine_has_missed_nothing() -> None:
    """During the suspension only the system clock advances."""
    clock = FakeClock()
    deadlines = clock.deadlines()
    before = stamps(clock, deadlines, 5)[-1]
    clock.set_by_ns += 8 * 3_600_000_000_000
    index, _ = deadlines.wait()
    assert (index, deadlines.missed) == (5, 0)
    assert deadlines.stamp_ns - before == PERIOD_NS + 8 * 3_600_000_000_000


@pytest.mark.parametrize(
    ("set_by_s", "words"),
    [
        (0.3, "ahead by 0.30 s, or the machine was suspended meanwhile"),
        (-0.3, "back by 0.30 s"),
        (10 * 365 * 86_400, "ahead by 315360000.00 s, or the machine was suspended meanwhile"),
        (-3600, "back by 3600.00 s"),
    ],
)
def test_a_system_clock_that_is_set_is_reported_once(set_by_s: float, words: str) -> None:
    clock = FakeClock()
    system = SystemClock(now_ns=clock.now_ns, wall_ns=clock.wall_ns)
    reports = []
    for k in range(100):
        clock.now += 100_000_000
        # besides a step, the clock is slewed by 500 parts in a million
        clock.set_by_ns += round(set_by_s * 1e9) * (k == 50) + 50_000
        reports.append(system.set_by())
    assert [(k, text) for k, text in enumerate(reports) if text] == [(50, words)]


def test_next_tick_is_prepared_and_the_deadline_kept() -> None:
    """A tick is prepared only if there is time. Its number and stamp are known by then."""
    clock = FakeClock()
    prepared: list[int] = []
    announced: list[tuple[int, int]] = []
    start = clock.now
    deadlines = clock.deadlines()

    def prepare(index: int, stamp_ns: int) -> None:
        prepared.append(clock.now - start)
        announced.append((index, stamp_ns))
        clock.now += 200_000

    deadlines.wait(prepare)  # the first deadline is now, so there is no time
    assert deadlines.wait(prepare) == (1, 0)
    assert prepared == [PERIOD_NS - PREPARE_NS]
    clock.now = start + 2 * PERIOD_NS - PREPARING_NS  # the previous tick ended late
    assert deadlines.wait(prepare) == (2, 0)
    assert len(prepared) == 1
    clock.oversleep_ns = PREPARE_NS - PREPARING_NS  # another thread held the interpreter lock
    deadlines.wait(prepare)
    assert len(prepared) == 1

    # the clock drifts by 500 parts in a million and is set, and deadlines are missed
    clock.oversleep_ns = 0
    announced.clear()
    decided = []
    for k in range(400):
        clock.set_by_ns += 1_000 - 10**9 * (k == 100) + 10**12 * (k == 300)
        clock.now += 2 * PERIOD_NS * (k % 50 == 49)
        index, _ = deadlines.wait(prepare)
        decided.append((index, deadlines.stamp_ns))
    assert len(announced) > 380
    assert set(announced) <= set(decided)


def test_deadline_whose_preparation_fails_is_still_to_come() -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    before = stamps(clock, deadlines, 5)[-1]

    def fail(index: int, stamp_ns: int) -> None:
        raise RuntimeError

    with pytest.raises(RuntimeError):
        deadlines.wait(fail)
    assert deadlines.wait() == (5, 0)
    assert (deadlines.stamp_ns - before, deadlines.missed) == (PERIOD_NS, 0)


def test_processors_stay_awake_only_if_wished_and_allowed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for owner, name in (
        (clock_module, "_scheduled"),
        (clock_module, "_locked"),
        (gc, "freeze"),
        (sys, "setswitchinterval"),
    ):
        monkeypatch.setattr(owner, name, lambda *_: False)
    latency = tmp_path / "cpu_dma_latency"
    monkeypatch.setattr(clock_module, "AWAKE", str(latency))
    assert not ask_for_real_time().awake
    assert not caplog.messages
    assert not ask_for_real_time(awake=True).awake
    assert f"processors may sleep: {latency}: No such file" in caplog.messages[0]
    latency.write_bytes(b"")
    assert ask_for_real_time(awake=True).awake
    assert latency.read_bytes() == bytes(4)  # a number of 32 bits [µs]


def test_work_beside_the_loop_is_done_while_it_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work beside the loop is done if the loop sleeps for long enough."""
    monkeypatch.setattr(clock_module, "NO_TICK_S", 60.0)
    clock = FakeClock()
    deadlines = clock.deadlines()
    deadlines.wait()
    deadlines.wait()
    clock.now -= BESIDE_NS  # the loop would still sleep
    deadlines.between_ticks()  # returns at once
    clock.now += 1
    thread = threading.Thread(target=deadlines.between_ticks, daemon=True)
    thread.start()
    thread.join(0.1)
    assert thread.is_alive()
    clock.now += BESIDE_NS
    for _ in range(100):
        deadlines.wait()  # the tick has ended
        thread.join(0.1)
    assert not thread.is_alive()


def test_an_interrupted_reading_of_the_clocks_is_no_step() -> None:
    clock = FakeClock()

    waits_ns = iter([0, 40 * READ_NS, 0])  # waiting times for a processor

    def wall_ns() -> int:
        clock.now += next(waits_ns)
        return clock.wall_ns()

    system = SystemClock(now_ns=clock.now_ns, wall_ns=wall_ns)
    assert [system.set_by() for _ in range(3)] == ["", "", ""]


def test_the_rate_is_that_achieved() -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    assert deadlines.rate_hz() == 0.0
    for _ in range(501):
        deadlines.wait()
    assert deadlines.rate_hz() == pytest.approx(500, rel=0.01)
    clock.now += 500 * PERIOD_NS
    deadlines.wait()
    assert deadlines.rate_hz() == pytest.approx(250, rel=0.01)
