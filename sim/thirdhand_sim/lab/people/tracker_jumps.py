"""Mistakes of a tracker in a recording of hands: samples that jump off a hand's path, and samples
in which left and right are exchanged.

A run of samples is wrong if the samples before and after it predict that no hand can have been
there. The prediction is a Gaussian process with the covariance of a very quick hand, conditioned on
the samples of both sides, as in a smoother. Its squared Mahalanobis distance decides. Paths that
this covariance allows are not changed, so quick motion is kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thirdhand_sim.lab.results import Array

# A quick hand: standard deviation and time scale of a squared exponential. Its acceleration has a
# standard deviation of 27 m/s^2 an axis: a reach of 0.2 m at 2 m/s has 33 m/s^2 at most.
SPREAD_M = 0.1
SCALE_S = 0.08
# above this speed of a recording, the spread is proportional to the speed
USUAL_MPS = 2.0
SPEED_SPAN_S = 0.1
SCALES_S = (SCALE_S, 0.12, 0.18, 0.27, 0.4)  # from quick to calm hands
# standard deviations of position and speed over a window
PLACE_M = 1.0
DRIFT_MPS = 1.0
TRACKED_NOISE_FLOOR_M = 0.002  # includes a hand's tremor
SAMPLES_BESIDE = 8  # samples on each side that predict
LONGEST_S = 0.5  # duration of the longest run
RUN_GROWTH = 1.25  # ratio of the lengths of runs, above the first few
# least squared distance of a wrong run, and its increase for each sample
THRESHOLD = 30.0
THRESHOLD_EACH = 6.0
LEAST_JUMP_M = 0.01  # rms distance of a wrong run from its prediction
# the candidates are runs with at least this share of the largest excess over the threshold
ALIKE = 0.5
CANDIDATES = 40  # the shortest of these are compared
# a predicted sample may exceed the box of its neighbours by this share of the box
BRIDGE_MARGIN = 0.25
STAMP_S = 1e-3  # stamps are rounded to this, so that windows of samples are equal
EXCHANGE_MPS = 3.0  # two hands do not exchange their positions faster than this
NOISE_ORDER = 5  # differences of this order contain a tracker's noise and hardly a hand's motion


class Repaired(NamedTuple):
    """Hands (T, 6) [m] without a tracker's mistakes; True for replaced samples of each hand (T, 2),
    and for samples with exchanged hands (T,).
    """

    hands: Array
    wrong: NDArray[np.bool_]
    exchanged: NDArray[np.bool_]


class Process(NamedTuple):
    """A hand's path as a Gaussian process, seen with a tracker's noise (standard deviation)."""

    noise_m: float
    spread_m: float
    scale_s: float = SCALE_S

    def covariance(self, t: Array) -> Array:
        """Covariances (K, M, M) [m^2] of samples at times (K, M) [s], equal for each axis."""
        from_middle = t - t.mean(axis=1, keepdims=True)
        between = t[:, :, None] - t[:, None, :]
        motion = self.spread_m**2 * np.exp(-0.5 * (between / self.scale_s) ** 2)
        drift = PLACE_M**2 + DRIFT_MPS**2 * from_middle[:, :, None] * from_middle[:, None, :]
        return np.asarray(motion + drift + self.noise_m**2 * np.eye(t.shape[1]))

    def log_likelihood(self, t: Array, x: Array) -> float:
        """Logarithm of the probability density of samples (M, 3) [m] at times (M,) [s]."""
        covariance = self.covariance(t[None])[0]
        centred = x - x.mean(axis=0)
        squared = float(np.sum(centred * np.linalg.solve(covariance, centred)))
        return -0.5 * (
            squared + 3 * (float(np.linalg.slogdet(covariance)[1]) + len(t) * math.log(2 * math.pi))
        )

    def best(self, t: Array, x: Array) -> tuple[float, Process]:
        """The largest log-likelihood of samples, over time scales, and its process."""
        kinds = [self._replace(scale_s=scale_s) for scale_s in SCALES_S]
        return max(((kind.log_likelihood(t, x), kind) for kind in kinds), key=lambda pair: pair[0])


def repair(t: Array, hands: Array) -> Repaired:
    """Recorded hands (T, 6) [m] at times (T,) [s], each wrong sample replaced by its prediction
    from the samples around it.
    """
    exchanged = exchanged_samples(t, hands)
    out = np.where(exchanged[:, None], np.roll(hands, 3, axis=1), hands)
    wrong = np.zeros((len(t), 2), bool)
    for side in (0, 1):
        part = slice(3 * side, 3 * side + 3)
        quick = quick_process(t, out[:, part])
        wrong[:, side] = jumped_samples(t, out[:, part], quick)
        out[:, part] = _bridged(t, out[:, part], wrong[:, side], quick)
    return Repaired(out, wrong, exchanged)


def noise_std_m(x: Array) -> float:
    """Standard deviation of a tracker's noise per axis [m], robustly from differences of a path
    (T, 3) [m]. 0 if it is too short.
    """
    if len(x) <= NOISE_ORDER:
        return 0.0
    gain = np.sqrt(np.sum(np.diff(np.eye(NOISE_ORDER + 1), NOISE_ORDER, axis=0) ** 2))
    return float(np.median(np.abs(np.diff(x, NOISE_ORDER, axis=0))) / 0.6745 / gain)


def quick_process(t: Array, x: Array) -> Process:
    """The process of the quickest motion expected in a hand's path (T, 3) [m]: the hand of a
    walking person is quicker than that of a seated one.
    """
    span = max(1, round(SPEED_SPAN_S / float(np.median(np.diff(t)))))
    speed = np.linalg.norm(x[span:] - x[:-span], axis=1) / (t[span:] - t[:-span])
    usual = float(np.percentile(speed, 95)) if len(speed) else 0.0
    return Process(
        max(noise_std_m(x), TRACKED_NOISE_FLOOR_M), SPREAD_M * max(1.0, usual / USUAL_MPS)
    )


def exchanged_samples(t: Array, hands: Array) -> NDArray[np.bool_]:
    """True (T,) for samples with exchanged hands: an exchange is a jump of both hands to the
    position of the other one, faster than hands move. Most samples are assumed right.
    """
    left = hands[:, :3]
    right = hands[:, 3:]

    def moved(a: Array, b: Array) -> Array:
        return np.asarray(np.linalg.norm(b[1:] - a[:-1], axis=1))

    straight = np.minimum(moved(left, left), moved(right, right))
    crossed = np.maximum(moved(left, right), moved(right, left))
    is_switch = (straight > EXCHANGE_MPS * np.diff(t)) & (crossed < straight / 3)
    exchanged = np.concatenate([[False], np.cumsum(is_switch) % 2 == 1])
    return ~exchanged if exchanged.mean() > 0.5 else exchanged


def jumped_samples(t: Array, x: Array, quick: Process) -> NDArray[np.bool_]:
    """True (T,) for samples of a path (T, 3) [m] that jump off it. The most improbable runs are
    removed first, until the remaining ones are probable.
    """
    wrong = np.zeros(len(t), bool)
    while True:
        valid = np.flatnonzero(~wrong)
        runs = _improbable_runs(t[valid], x[valid], quick)
        if not runs:
            return wrong
        for begin, end in runs:
            wrong[valid[begin:end]] = True


def _improbable_runs(t: Array, x: Array, quick: Process) -> list[tuple[int, int]]:
    """Improbable runs [begin, end), each more improbable than all runs near it."""
    if len(t) <= 2 * SAMPLES_BESIDE:
        return []
    longest = max(1, round(LONGEST_S / float(np.median(np.diff(t)))))
    rows = []
    length = 1
    while length <= min(longest, len(t) - 2 * SAMPLES_BESIDE):
        squared, off_m = _off_prediction(t, x, length, quick)
        excess = squared - THRESHOLD - THRESHOLD_EACH * length
        begins = np.flatnonzero((excess > 0) & (off_m > LEAST_JUMP_M))
        rows.append(np.stack([excess[begins], begins, begins + length], axis=1))
        length = max(length + 1, round(RUN_GROWTH * length))
    candidates = np.concatenate(rows)
    runs = []
    reach = longest + SAMPLES_BESIDE
    while len(candidates):
        excess, first, last = candidates[np.argmax(candidates[:, 0])]
        alike = candidates[
            (candidates[:, 0] >= ALIKE * excess)
            & (candidates[:, 1] < last)
            & (candidates[:, 2] > first)
        ]
        alike = alike[np.argsort(alike[:, 2] - alike[:, 1], kind="stable")[:CANDIDATES]]
        begin, end = _most_probable(t, x, alike[:, 1:].astype(int), quick)
        runs.append((begin, end))
        candidates = candidates[
            (candidates[:, 1] >= max(last, end) + reach)
            | (candidates[:, 2] <= min(first, begin) - reach)
        ]
    return runs


def _most_probable(t: Array, x: Array, runs: NDArray[np.int_], quick: Process) -> tuple[int, int]:
    """The run [begin, end) of several (K, 2) without which the samples around them are most
    probable. A wrong sample is anywhere within 1 m^3: the logarithm of its density is 0.
    """
    around = np.arange(
        max(0, runs[:, 0].min() - SAMPLES_BESIDE), min(len(t), runs[:, 1].max() + SAMPLES_BESIDE)
    )
    right = [around[(around < begin) | (around >= end)] for begin, end in runs]
    begin, end = runs[np.argmax([quick.best(t[indices], x[indices])[0] for indices in right])]
    return int(begin), int(end)


def _off_prediction(t: Array, x: Array, length: int, quick: Process) -> tuple[Array, Array]:
    """Squared Mahalanobis distance, and rms distance [m], of each run of a length from its
    prediction by its neighbours, by the run's first sample.
    """
    size = 2 * SAMPLES_BESIDE + length
    begins = np.arange(len(t) - length + 1)
    firsts = np.clip(begins - SAMPLES_BESIDE, 0, len(t) - size)
    squared, off_m = np.empty((2, len(begins)))
    for offset in np.unique(begins - firsts):
        of = np.flatnonzero(begins - firsts == offset)
        windows = firsts[of, None] + np.arange(size)
        spans, span_index = np.unique(
            np.round((t[windows] - t[windows[:, :1]]) / STAMP_S), axis=0, return_inverse=True
        )
        precision = np.linalg.inv(quick.covariance(STAMP_S * spans))
        run = slice(offset, offset + length)
        # For y ~ N(0, P^-1) the run is off by r = P_rr^-1 (P y)_r, whose covariance is P_rr^-1.
        pull = precision[span_index.ravel(), run] @ x[windows]
        residual = np.linalg.solve(precision[span_index.ravel(), run, run], pull)
        squared[of] = np.sum(residual * pull, axis=(1, 2))
        off_m[of] = np.sqrt(np.mean(np.sum(residual**2, axis=2), axis=1))
    return squared, off_m


def _bridged(t: Array, x: Array, wrong: NDArray[np.bool_], quick: Process) -> Array:
    """A path (T, 3) [m] with its wrong samples predicted from the right ones around them, by the
    process under which these are most probable; limited to a box around them.
    """
    out = x.copy()
    valid = np.flatnonzero(~wrong)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong, [False]]).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        around = np.concatenate(
            [valid[valid < begin][-SAMPLES_BESIDE:], valid[valid >= end][:SAMPLES_BESIDE]]
        )
        process = quick.best(t[around], x[around])[1]
        covariance = process.covariance(t[None, np.concatenate([around, np.arange(begin, end)])])[0]
        middle = x[around].mean(axis=0)
        size = len(around)
        weighted = np.linalg.solve(covariance[:size, :size], x[around] - middle)
        low = x[around].min(axis=0)
        high = x[around].max(axis=0)
        beyond = BRIDGE_MARGIN * (high - low)
        out[begin:end] = np.clip(
            middle + covariance[size:, :size] @ weighted, low - beyond, high + beyond
        )
    return out
