"""The best causal linear filters for given hands, fitted to the same hands, without limits and arm:
a bound for all linear filters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thirdhand.core.skill.skill import Skill
from thirdhand_sim.lab.people.moving_hands import PERIOD_S, Moving
from thirdhand_sim.lab.results import Array

FILTER_S = 0.5  # length of the filters
LEAST_OUTPUT_HZ = 90  # a slower tracker's samples are filtered to a multiple of its rate
JERK_WEIGHTS = (0.0, 1e-9, 1e-8, 1e-7, 1e-6)  # [s⁶] of squared jerk against squared error


class Floor(NamedTuple):
    """A filter's error, and acceleration and jerk as multiples of the truth's, all root mean
    square.
    """

    error_rms_mm: float
    acceleration_ratio: float
    jerk_ratio: float


def best_linear(sequences: list[Moving], skill: Skill, *, rate_hz: int) -> list[Floor]:
    """The filters of the target's samples with the least squared error plus weight times squared
    jerk, one a weight.

    Gaps in the samples of sequences are ignored: only the order of the samples counts.
    """
    up = max(1, -(-LEAST_OUTPUT_HZ // rate_hz))
    taps = round(FILTER_S * rate_hz)
    step = 1 / (rate_hz * up)
    size = taps * up
    square = np.zeros((size, size))
    cross = np.zeros(size)
    jerk = np.zeros((size, size))
    push = np.zeros((size, size))
    energy = wanted_jerk = wanted_push = 0.0
    count = 0
    for sequence in sequences:
        truth = skill.mean(sequence.truth)
        samples = skill.mean(sequence.samples)
        outputs = np.arange(size, up * len(samples))
        times = sequence.stamps[0] + outputs * step
        outputs = outputs[times < len(truth) * PERIOD_S - step]
        times = times[times < len(truth) * PERIOD_S - step]
        for axis in range(3):
            mean = samples[:, axis].mean()
            x = np.interp(times, np.arange(len(truth)) * PERIOD_S, truth[:, axis]) - mean
            rows = _rows(samples[:, axis] - mean, outputs, up, taps)
            third = np.diff(rows, 3, axis=0) / step**3
            second = np.diff(rows, 2, axis=0) / step**2
            square = square + rows.T @ rows
            cross = cross + rows.T @ x
            jerk = jerk + third.T @ third
            push = push + second.T @ second
            wanted_jerk += float((np.diff(x, 3) ** 2).sum()) / step**6
            wanted_push += float((np.diff(x, 2) ** 2).sum()) / step**4
            energy = energy + float(x @ x)
            count = count + len(x)
    scale = float(np.trace(square)) / size
    whole = np.kron(np.eye(up), np.ones(taps))  # inputs at rest are met exactly
    floors = []
    for weight in JERK_WEIGHTS:
        left = square + weight * jerk + 1e3 * scale * whole.T @ whole + 1e-9 * scale * np.eye(size)
        w = np.linalg.solve(left, cross + 1e3 * scale * whole.T @ np.ones(up))
        error = max(float(w @ square @ w - 2 * w @ cross + energy), 0.0) / count * 3
        ratios = (
            float(np.sqrt(w @ matrix @ w / of))
            for matrix, of in ((push, wanted_push), (jerk, wanted_jerk))
        )
        floors.append(Floor(1000 * float(np.sqrt(error)), *ratios))
    return floors


def error_at(floors: list[Floor], jerk_ratio: float) -> float:
    """The error [mm] of the best filter with a jerk ratio, interpolated in its logarithm."""
    rows = sorted((math.log(floor.jerk_ratio), floor.error_rms_mm) for floor in floors)
    jerks, errors = zip(*rows, strict=True)
    return float(np.interp(math.log(jerk_ratio), jerks, errors))


def _rows(samples: Array, outputs: Array, up: int, taps: int) -> Array:
    """The inputs of each output: the newest samples, in the columns of the output's phase between
    two samples.
    """
    rows = np.zeros((len(outputs), taps * up))
    for row, output in enumerate(outputs):
        newest, phase = divmod(int(output), up)
        rows[row, phase * taps : (phase + 1) * taps] = samples[newest - taps + 1 : newest + 1][::-1]
    return rows
