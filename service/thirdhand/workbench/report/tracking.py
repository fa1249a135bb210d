"""Figures of a tool that follows moving hands: error, lag, jerk, and overshoot at stops.

Errors are distances of the tool from the target at the same instant, lag included. All paths are
positions (T, 3) [m], one for each tick.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thirdhand.core.frame import Vector

TRIED_LAGS_S = (-0.06, 0.2)  # lags that are tried
STOP_FROM_MPS, STOP_TO_MPS = 0.1, 0.02  # a target stops if its speed falls from above the first to below the second
BRAKING_S = 0.25  # it does so within this time
RESTING_S = 0.25  # and then rests for this time, in which the tool may pass it
LEAST_PATH_M = 0.02  # a target moves in a second in which its path is longer


class TrackingFigures(NamedTuple):
    """Error: root mean square in each second in which the target moves, of these the median [mm];
    95th percentile of all [mm]. Lag [ms], root mean square of the tool's jerk [m/s³], largest
    overshoot [mm], and number of stops. NaN: not defined, as the lag of a target that rests.
    """

    error_mm: float
    error_p95_mm: float
    lag_ms: float
    jerk: float
    overshoot_mm: float
    stops: int


def tracking(target: Vector, tool: Vector, period_s: float, judged: NDArray[np.bool_]) -> TrackingFigures:
    """The figures at the ticks that are `judged` (T,), of which there must be one."""
    lag = lag_ms(target, tool, period_s, judged)
    is_inner = TRIED_LAGS_S[0] + period_s / 2 < lag / 1000 < TRIED_LAGS_S[1] - period_s / 2  # else no maximum
    off_mm = 1000 * np.linalg.norm(tool - target, axis=1)[judged]
    passed_mm = 1000 * overshoots(target, tool, period_s, judged)
    return TrackingFigures(
        error_mm=_usual_error_mm(target, tool, period_s, judged),
        error_p95_mm=float(np.percentile(off_mm, 95)),
        lag_ms=lag if is_inner else math.nan,
        jerk=rms(derivative(tool, period_s, order=3)[judged]),
        overshoot_mm=float(passed_mm.max(initial=0.0)) if len(passed_mm) else math.nan,
        stops=len(passed_mm),
    )


def _usual_error_mm(target: Vector, tool: Vector, period_s: float, judged: NDArray[np.bool_]) -> float:
    """The error of `TrackingFigures`; of all judged ticks if the target rests.

    A few episodes, as a target that leaps at a new via-point, would dominate the root mean square
    of all ticks.
    """
    squared = np.sum((tool - target) ** 2, axis=1)
    ticks = round(1.0 / period_s)
    errors = []
    for begin in range(0, len(squared), ticks):
        rows = np.flatnonzero(judged[begin : begin + ticks]) + begin
        if len(rows) > ticks / 2 and np.linalg.norm(np.diff(target[rows], axis=0), axis=1).sum() > LEAST_PATH_M:
            errors.append(squared[rows].mean())
    return 1000 * math.sqrt(float(np.median(errors)) if errors else float(squared[judged].mean()))


def derivative(path: Vector, period_s: float, *, order: int) -> Vector:
    """The derivative of an order by central differences, of the path's shape [m/s^order]."""
    for _ in range(order):
        path = np.gradient(path, period_s, axis=0)
    return path


def rms(rows: Vector) -> float:
    """Root mean square of the norms of rows (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def lag_ms(target: Vector, tool: Vector, period_s: float, judged: NDArray[np.bool_] | None = None) -> float:
    """The lag [ms] within TRIED_LAGS_S with the largest cross-correlation of the speeds; NaN for a
    path that is too short, or a target that does not move.
    """
    first, last = (round(limit_s / period_s) for limit_s in TRIED_LAGS_S)
    begin, end = -2 * first, len(target) - last + 2 * first
    if end <= begin:
        return math.nan
    a, b = (np.linalg.norm(derivative(path, period_s, order=1), axis=1) for path in (target, tool))
    if judged is None:
        a, b = a - a.mean(), b - b.mean()
    else:
        a, b = np.where(judged, a - a[judged].mean(), 0.0), b - b[judged].mean()
    inner = a[begin:end]
    if not inner.any():
        return math.nan
    score = [float(inner @ b[begin + k : end + k]) for k in range(first, last + 1)]
    return 1000 * period_s * (int(np.argmax(score)) + first)


def overshoots(target: Vector, tool: Vector, period_s: float, judged: NDArray[np.bool_]) -> Vector:
    """The distance by which the tool passes each stop of the target (S,) [m], along the target's
    last motion.
    """
    speed = np.linalg.norm(derivative(target, period_s, order=1), axis=1)
    braking, resting = round(BRAKING_S / period_s), round(RESTING_S / period_s)
    found = []
    for at in np.flatnonzero((speed[1:] < STOP_TO_MPS) & (speed[:-1] >= STOP_TO_MPS)) + 1:
        before, after = slice(at - braking, at), slice(at, at + resting)
        if at < braking or at + resting > len(speed) or not judged[at - braking : at + resting].all():
            continue
        if speed[before].max() > STOP_FROM_MPS and speed[after].max() < STOP_TO_MPS:
            way = target[at] - target[at - braking + int(np.argmax(speed[before]))]
            past = (tool[after] - target[at]) @ (way / max(float(np.linalg.norm(way)), 1e-9))
            found.append(max(0.0, float(past.max())))
    return np.array(found)
