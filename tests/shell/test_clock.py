"""The clock: deadlines kept in phase, skipped where they were missed, and the figures that tell how
well.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from service.contract.requests import Percentiles
from service.shell.clock import PREPARE_NS, Deadlines, Window

PERIOD_NS = 2_000_000


class FakeClock:
    """A clock that moves when it is told to, when someone sleeps (by more than was asked), and by a
    little with each look.
    """

    def __init__(self, *, oversleep_ns: int = 0, look_ns: int = 0) -> None:
        self.now = 1_000_000_007
        self.oversleep_ns = oversleep_ns
        self.look_ns = look_ns
        self.slept_s: list[float] = []

    def now_ns(self) -> int:
        self.now += self.look_ns
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now += round(seconds * 1e9) + self.oversleep_ns

    def deadlines(self, *, rate_hz: int = 500, spin_ns: int = 0) -> Deadlines:
        return Deadlines(rate_hz, spin_ns=spin_ns, now_ns=self.now_ns, sleep=self.sleep)


def test_the_first_deadline_is_the_start() -> None:
    clock = FakeClock()
    assert clock.deadlines().wait() == (0, 0)
    assert clock.slept_s == []


def test_deadlines_stay_in_phase_however_late_each_wake_is() -> None:
    clock = FakeClock(oversleep_ns=300_000)
    start, deadlines = clock.now, clock.deadlines()
    for tick in range(1000):
        index, late_ns = deadlines.wait()
        assert index == tick
        assert clock.now - start == tick * PERIOD_NS + late_ns
        assert late_ns == (300_000 if tick else 0)
    assert deadlines.missed == 0


def test_deadlines_that_passed_are_skipped_and_counted() -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    deadlines.wait()
    deadlines.wait()
    clock.now += 5 * PERIOD_NS + 100
    assert deadlines.wait() == (6, 100)
    assert deadlines.missed == 4
    assert deadlines.wait() == (7, 0)
    assert deadlines.missed == 4


def test_being_late_by_less_than_a_period_misses_nothing() -> None:
    clock = FakeClock()
    deadlines = clock.deadlines()
    deadlines.wait()
    clock.now += 2 * PERIOD_NS - 1
    assert deadlines.wait() == (1, PERIOD_NS - 1)
    assert deadlines.missed == 0


@example_settings(max_examples=50, deadline=None, derandomize=True)
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


def test_the_wall_time_of_ticks_grows_by_a_period_whatever_is_missed() -> None:
    deadlines = FakeClock().deadlines()
    times = [deadlines.time_ns(index) for index in (0, 1, 2, 100)]
    assert np.diff(times).tolist() == [PERIOD_NS, PERIOD_NS, 98 * PERIOD_NS]


def test_an_empty_window_tells_zeros() -> None:
    assert Window(10).percentiles() == Percentiles(0.0, 0.0, 0.0)


def test_a_window_tells_percentiles_of_its_last_values_only() -> None:
    window = Window(101)
    for value in (7.0, 7.0, 7.0):
        window.add(value)
    assert window.percentiles() == Percentiles(7.0, 7.0, 7.0)
    for value in range(1000, 1101):
        window.add(float(value))
    assert window.percentiles() == Percentiles(1050.0, 1099.0, 1100.0)


def test_the_next_tick_is_prepared_where_there_is_time_and_the_deadline_kept() -> None:
    clock, prepared = FakeClock(), []
    start, deadlines = clock.now, clock.deadlines()

    def prepare() -> None:
        prepared.append(clock.now - start)
        clock.now += 200_000

    deadlines.wait(prepare)  # the first deadline is now: no time
    assert deadlines.wait(prepare) == (1, 0)
    assert prepared == [PERIOD_NS - PREPARE_NS]
    clock.now = start + 2 * PERIOD_NS - PREPARE_NS + 1
    assert deadlines.wait(prepare) == (2, 0)
    assert len(prepared) == 1
