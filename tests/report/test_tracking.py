"""Figures of a tool that follows a known path."""

from __future__ import annotations

import math

import numpy as np
import pytest

from thirdhand.workbench.report.tracking import (
    derivative,
    lag_ms,
    overshoots,
    rms,
    tracking,
)

PERIOD_S = 0.002
TIMES = np.arange(0.0, 8.0, PERIOD_S)
ALL = np.ones(len(TIMES), bool)


def wave(times: np.ndarray) -> np.ndarray:
    """A motion whose speed does not repeat itself within the lags that are tried."""
    return np.stack([0.1 * np.sin(2.0 * times), 0.03 * np.sin(5.3 * times), 0.02 * np.cos(3.1 * times)], axis=1)


@pytest.mark.parametrize("lag", [-40, 0, 30, 120])
def test_a_delayed_path_has_that_lag_and_the_error_of_the_way_it_makes_meanwhile(lag: int) -> None:
    target, tool = wave(TIMES), wave(TIMES - lag / 1000)
    found = tracking(target, tool, PERIOD_S, ALL)
    assert found.lag_ms == pytest.approx(lag, abs=2.0)
    assert found.error_mm == pytest.approx(abs(lag) * rms(derivative(target, PERIOD_S, order=1)), rel=0.15)
    assert found.stops == 0
    assert math.isnan(found.overshoot_mm)


def test_a_lag_at_the_end_of_those_that_are_tried_is_not_known() -> None:
    assert tracking(wave(TIMES), wave(TIMES - 0.19), PERIOD_S, ALL).lag_ms == pytest.approx(190.0, abs=2.0)
    for lag_s in (0.3, -0.15):
        assert math.isnan(tracking(wave(TIMES), wave(TIMES - lag_s), PERIOD_S, ALL).lag_ms)


def test_ticks_that_are_not_judged_do_not_count() -> None:
    target, judged = wave(TIMES), ALL.copy()
    tool, judged[1000:2000] = wave(TIMES - 0.05), False
    away = tool.copy()
    away[1200:1800] += 0.5 * np.hanning(600)[:, None]
    seen, asked = tracking(target, away, PERIOD_S, judged), tracking(target, tool, PERIOD_S, judged)
    assert seen.error_p95_mm == asked.error_p95_mm
    assert seen.error_mm == asked.error_mm
    assert seen.lag_ms == pytest.approx(asked.lag_ms, abs=4.0)
    assert tracking(target, away, PERIOD_S, ALL).error_p95_mm > 100


def test_jerk_is_that_of_the_path() -> None:
    path, inner = np.zeros((len(TIMES), 3)), ALL.copy()
    inner[:5] = inner[-5:] = False  # differences at the ends are one-sided
    path[:, 0] = 0.01 * np.sin(10.0 * TIMES)
    assert tracking(path, path, PERIOD_S, inner).jerk == pytest.approx(0.01 * 10.0**3 / math.sqrt(2.0), rel=0.02)


@pytest.mark.parametrize("passed_mm", [0.0, 3.0, 20.0])
def test_the_overshoot_at_a_stop_is_measured_along_the_motion(passed_mm: float) -> None:
    moved = 0.3 * np.minimum(TIMES, 4.0)
    target = np.stack([moved, 0.5 * moved, np.zeros_like(moved)], axis=1)
    way = target[-1] / np.linalg.norm(target[-1])
    after = np.where(TIMES > 4.0, np.exp(-((TIMES - 4.1) ** 2) / 0.001), 0.0)
    tool = target + 0.001 * passed_mm * after[:, None] * way
    assert overshoots(target, tool, PERIOD_S, ALL) * 1000 == pytest.approx([passed_mm], abs=0.8)


def test_a_target_that_rests_has_no_lag() -> None:
    still = np.ones((len(TIMES), 3))
    assert math.isnan(lag_ms(still, wave(TIMES), PERIOD_S))
    assert tracking(still, still + np.array([0.003, 0.0, 0.0]), PERIOD_S, ALL).error_mm == pytest.approx(3.0)
    assert math.isnan(lag_ms(still[:50], still[:50], PERIOD_S))  # too short for the lags that are tried
