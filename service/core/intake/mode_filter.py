"""The interacting-multiple-model filter of a hand (Blom and Bar-Shalom, IEEE TAC 33(8), 1988):
started, moved on, and given a sample.

A hand rests, reaches, or changes its way. Each mode is a Kalman filter of position, velocity and
acceleration (`motion_model`). One that rests or reaches trembles too: an oscillation that its
samples show and that is no part of its motion. Who changes their way does not, as a change would be
taken for tremor at first. One that rests is slow. Its speed and tremor are bounded: without that a
mode that expects most to happen within one sample would win in the quickest motion, which none
explains. Only who has become slow comes to rest, with what was known of its motion and that it is
slow. Who leaves rest begins with all that the samples showed.

Arrays of one hand: means (MODES, STATES, 3), by mode, then position, velocity, acceleration, tremor
and its velocity, by axis [m, m/s, m/s²]; covariances (MODES, STATES, STATES), alike for the axes;
probabilities (MODES,).
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Vector
from service.core.intake import MODES, STATES
from service.core.intake.motion_model import REST
from service.core.intake.tuning import (
    LEAST_MODE_PROBABILITY,
    MAX_INNOVATION,
    MAX_TREMOR_M,
    MODE_PRIOR,
    MODE_SWITCH_RATES_PER_S,
    PROBABILITY_ROUND_TO,
    REST_ACCELERATION_STD_MPS2,
    REST_MAX_SPEED_MPS,
    REST_SPEED_STD_MPS,
    START_ACCELERATION_STD_MPS2,
    START_SPEED_STD_MPS,
    TREMOR_RATE_PER_S,
    TREMOR_STDS_M,
)


@compiled
def start(means: Vector, covariances: Vector, modes: Vector, noise: float, position: Vector) -> None:
    """A hand of which one sample (3,) [m] is known."""
    means[:] = 0.0
    covariances[:] = 0.0
    for mode in range(MODES):
        for axis in range(3):
            means[mode, 0, axis] = position[axis]
        covariances[mode, 0, 0] = noise
        covariances[mode, 1, 1] = START_SPEED_STD_MPS**2
        covariances[mode, 2, 2] = START_ACCELERATION_STD_MPS2**2
        _tremble(means[mode], covariances[mode], mode)
        modes[mode] = MODE_PRIOR[mode]


@compiled
def advance(means: Vector, covariances: Vector, transition: Vector, noise: Vector) -> None:
    """All modes moved on: m = F m, P = F P F' + Q, each by its own F and Q."""
    moved, product = np.empty((STATES, 3)), np.empty((STATES, STATES))
    for mode in range(MODES):
        mean, covariance, over = means[mode], covariances[mode], transition[mode]
        for row in range(STATES):
            first, end = (0, 3) if row < 3 else (3, STATES)  # motion and tremor do not drive each other
            for column in range(STATES):
                p = 0.0
                for k in range(first, end):
                    p += over[row, k] * covariance[k, column]
                product[row, column] = p
            for axis in range(3):
                m = 0.0
                for k in range(first, end):
                    m += over[row, k] * mean[k, axis]
                moved[row, axis] = m
        mean[:] = moved
        for row in range(STATES):
            for column in range(row, STATES):
                p = noise[mode, row, column]
                first, end = (0, 3) if column < 3 else (3, STATES)
                for k in range(first, end):
                    p += product[row, k] * over[column, k]
                covariance[row, column] = covariance[column, row] = p


@compiled
def _tremble(mean: Vector, covariance: Vector, mode: int) -> None:
    """Nothing is known yet of the tremor of a hand of this mode."""
    mean[3:] = 0.0
    covariance[3:, :] = 0.0
    covariance[:, 3:] = 0.0
    covariance[3, 3], covariance[4, 4] = TREMOR_STDS_M[mode] ** 2, (TREMOR_STDS_M[mode] * TREMOR_RATE_PER_S) ** 2


@compiled
def _come_to_rest(mean: Vector, covariance: Vector) -> None:
    """A mode of motion, known to be slow: so are its velocity and its acceleration."""
    for known in range(1, 3):
        spread = REST_SPEED_STD_MPS if known == 1 else REST_ACCELERATION_STD_MPS2
        row_of = covariance[known, :3].copy()
        variance = row_of[known] + spread * spread
        for axis in range(3):
            off = mean[known, axis]
            for row in range(3):
                mean[row, axis] -= row_of[row] / variance * off
        for row in range(3):
            for column in range(3):
                covariance[row, column] -= row_of[row] * row_of[column] / variance


@compiled
def _leave_rest(mean: Vector, covariance: Vector) -> None:
    """The mode of rest as one of motion: all that was seen is."""
    for row in range(2):
        for axis in range(3):
            mean[row, axis] += mean[row + 3, axis]
        for column in range(STATES):
            covariance[row, column] += covariance[row + 3, column]
    for column in range(2):
        for row in range(3):
            covariance[row, column] += covariance[row, column + 3]


@compiled
def _switched(means: Vector, covariances: Vector, modes: Vector, interval_s: float, shares: Vector) -> None:
    """The probabilities (MODES, MODES) that a hand was of the first mode and is of the second an
    interval later; it comes to rest when it is slow.
    """
    for i in range(MODES):
        stay = math.exp(-MODE_SWITCH_RATES_PER_S[i] * interval_s)
        for j in range(MODES):
            shares[i, j] = modes[i] * ((1.0 - stay) * MODE_PRIOR[j] + (stay if i == j else 0.0))
        if i != REST:
            square = 0.0
            for axis in range(3):
                square += means[i, 1, axis] ** 2
            slow = math.exp(
                -0.5 * min(square / (covariances[i, 1, 1] + REST_SPEED_STD_MPS * REST_SPEED_STD_MPS), MAX_INNOVATION)
            )
            shares[i, i] += (1.0 - slow) * shares[i, REST]
            shares[i, REST] *= slow


@compiled
def _mix(means: Vector, covariances: Vector, shares: Vector, expected: Vector) -> None:
    """Each mode mixed of all, by those shares: the modes' probabilities (MODES,) are `expected`."""
    of_means, of_covariances = np.empty((MODES, MODES, STATES, 3)), np.empty((MODES, MODES, STATES, STATES))
    for j in range(MODES):
        for i in range(MODES):
            of_means[j, i], of_covariances[j, i] = means[i], covariances[i]
            if i != j:
                if j == REST:
                    _come_to_rest(of_means[j, i], of_covariances[j, i])
                elif i == REST:
                    _leave_rest(of_means[j, i], of_covariances[j, i])
                _tremble(of_means[j, i], of_covariances[j, i], j)
    for j in range(MODES):
        expected[j], mixed, spread = 0.0, means[j], covariances[j]
        for i in range(MODES):
            expected[j] += shares[i, j]
        mixed[:], spread[:] = 0.0, 0.0
        for i in range(MODES):
            share = shares[i, j] / expected[j]
            for a in range(STATES):
                for b in range(3):
                    mixed[a, b] += share * of_means[j, i, a, b]
        for i in range(MODES):
            share, mean = shares[i, j] / expected[j], of_means[j, i]
            for a in range(STATES):
                for b in range(a, STATES):
                    between = 0.0
                    for k in range(3):
                        between += (mean[a, k] - mixed[a, k]) * (mean[b, k] - mixed[b, k])
                    spread[a, b] += share * (of_covariances[j, i, a, b] + between / 3.0)


@compiled
def _beyond_rest(mean: Vector) -> float:
    """By how much a hand is faster, and trembles more, than one that rests: squared, normalised."""
    speed = tremor = 0.0
    for axis in range(3):
        speed += mean[1, axis] ** 2
        tremor += mean[3, axis] ** 2 + (mean[4, axis] / TREMOR_RATE_PER_S) ** 2
    trembles = max(tremor - MAX_TREMOR_M**2, 0.0) / float(TREMOR_STDS_M[REST]) ** 2
    return max(speed - REST_MAX_SPEED_MPS**2, 0.0) / REST_SPEED_STD_MPS**2 + trembles


@compiled
def update(
    means: Vector, covariances: Vector, modes: Vector, noise: float, position: Vector, interval_s: float
) -> None:
    """One sample (3,) [m] of a noise variance [m²] filtered in: modes mixed over the interval, each
    updated, weighed by its likelihood.
    """
    shares, expected, likelihood, seen = np.empty((MODES, MODES)), np.empty(MODES), np.empty(MODES), np.empty(STATES)
    _switched(means, covariances, modes, interval_s, shares)
    _mix(means, covariances, shares, expected)
    best = -1e300
    for i in range(MODES):
        mean, p = means[i], covariances[i]
        for row in range(STATES):
            for column in range(row):
                p[row, column] = p[column, row]
            seen[row] = p[row, 0] + p[row, 3]  # a sample shows position and tremor
        variance, square = seen[0] + seen[3] + noise, 0.0
        for axis in range(3):
            innovation = position[axis] - mean[0, axis] - mean[3, axis]
            square += innovation * innovation
            for row in range(STATES):
                mean[row, axis] += seen[row] / variance * innovation
        for row in range(STATES):
            for column in range(row, STATES):
                p[row, column] -= seen[row] * seen[column] / variance
                p[column, row] = p[row, column]
        likelihood[i] = -1.5 * math.log(variance) - 0.5 * min(square / variance, MAX_INNOVATION)
        if i == REST:
            likelihood[i] -= 0.5 * _beyond_rest(mean)
        best = max(best, likelihood[i])
    for i in range(MODES):
        modes[i] = expected[i] * math.exp(likelihood[i] - best)
    _normalise(modes)
    for i in range(MODES):
        modes[i] = max(modes[i], LEAST_MODE_PROBABILITY)
    _normalise(modes)
    for i in range(MODES):
        modes[i] = np.rint(modes[i] * PROBABILITY_ROUND_TO) / PROBABILITY_ROUND_TO


@compiled
def _normalise(modes: Vector) -> None:
    total = 0.0
    for i in range(MODES):
        total += modes[i]
    for i in range(MODES):
        modes[i] /= total
