"""Interacting-multiple-model filter of one hand (Blom and Bar-Shalom, IEEE TAC 33(8), 1988).

A hand rests, moves slowly and steadily, reaches, or changes its motion. Each mode is a Kalman
filter with the linear system of `motion_model`: position p, velocity v, acceleration a, tremor y
and its velocity w. A sample measures p + y; tremor is seen by the tracker but is no part of the
hand's motion.

Modes are mixed at the time of a sample, after the prediction. Three rules are added to the
published filter:

* The mode CHANGE has no tremor (σ = 0) until one is evident (`tremor`), because the beginning of a
  change would otherwise be explained as tremor. An evident tremor is the same in all modes.
* In the calm modes REST and STEADY, a hand is slow and its tremor is bounded (`_beyond_calm`). No
  mode explains the fastest motions; without the bound, the mode that allows the largest change
  between two samples wins.
* A hand enters a calmer mode only when it is slow (`_switched`), conditioned on being slow
  (`_calm_down`). On leaving the calm modes, its tremor becomes motion (`_leave_calm`).

Arrays of one hand: `mode_means` (MODES, STATES, 3) hold (p, v, a, y, w) of each mode, by axis [m,
m/s, m/s², m, m/s]; `mode_covariances` (MODES, STATES, STATES) are shared by the three axes;
`mode_probabilities` are (MODES,). `tremors` (1 + MODES,) are the rate ω of the tremor and its
variance σ² in each mode. All functions change means and covariances in place.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp, log
from thirdhand.core.frame import Struct, Vector
from thirdhand.core.intake import MODES, STATES
from thirdhand.core.intake.motion_model import CHANGE, ENDLESS, REACH, STEADY
from thirdhand.core.vectors import dot, square, squared_amplitude


@compiled
def start(state: Struct, config: Struct, side: int, position: Vector) -> None:
    """Initial estimate from a single sample (3,) [m] with noise variance r [m²]: in each mode

        mean (position, 0, 0, 0, 0),   covariance diag(r, σ_v², q / (2 k_a), σ², (ω σ)²)

    with σ_v = start_speed_std_mps, and the tremor's ω and σ². The variance of the acceleration is
    the stationary one of the mode CHANGE. The probabilities are mode_prior.
    """
    means = state.mode_means[side]
    covariances = state.mode_covariances[side]
    means[:] = 0.0
    covariances[:] = 0.0
    for mode in range(MODES):
        means[mode, 0] = position
        covariances[mode, 0, 0] = state.noise_variance[side]
        covariances[mode, 1, 1] = config.start_speed_std_mps**2
        covariances[mode, 2, 2] = config.mode_intensities_m2ps5[CHANGE] / (
            2.0 * config.mode_acceleration_reversions_per_s[CHANGE]
        )
        _tremble(means[mode], covariances[mode], state.tremors[side], mode)
    state.mode_probabilities[side] = config.mode_prior


@compiled
def advance(state: Struct, side: int, over: Struct) -> None:
    """Prediction of all modes of a hand over the interval of a record of `motion_model.models`.

    With an evident tremor, REACH has the motion ENDLESS: otherwise the steady innovation of a hand
    whose velocity does not revert would count as a change, and a change follows the tremor.
    """
    variances = state.tremors[side, 1:]
    for mode in range(MODES):
        motion = ENDLESS if mode == REACH and variances[CHANGE] > 0.0 else mode
        mean = state.mode_means[side, mode]
        covariance = state.mode_covariances[side, mode]
        move_on(mean, covariance, over, motion, state.tremor_rate[side], variances[mode])


@compiled
def move_on(
    mean: Vector, covariance: Vector, over: Struct, motion: int, rate: int, tremor: float
) -> None:
    """Prediction of one filter: m = F m, P = F P Fᵀ + Q, in place.

    F and Q (STATES, STATES) have a motion block (3, 3), number `motion` of `motion_model.model`,
    and a tremor block (2, 2), that of the `rate`. That of Q is multiplied by the variance `tremor`
    [m²].
    """
    # the blocks of F, below each other: F is block-diagonal, motion and tremor
    blocks = np.empty((STATES, 3))
    blocks[:3] = over.transition[motion]
    blocks[3:, :2] = over.tremor[rate]
    moved = np.empty((STATES, 3))
    product = np.empty((STATES, STATES))
    for row in range(STATES):
        first, count = (0, 3) if row < 3 else (3, 2)
        for column in range(STATES):
            p = 0.0
            for k in range(count):
                p += blocks[row, k] * covariance[first + k, column]
            product[row, column] = p
        for axis in range(3):
            m = 0.0
            for k in range(count):
                m += blocks[row, k] * mean[first + k, axis]
            moved[row, axis] = m
    mean[:] = moved

    # F P Fᵀ + Q
    covariance[:] = 0.0
    covariance[:3, :3] = over.noise[motion]
    for row in range(STATES):
        for column in range(row, STATES):
            p = covariance[row, column]
            if row >= 3:
                p = tremor * over.tremor_noise[rate, row - 3, column - 3]
            first, count = (0, 3) if column < 3 else (3, 2)
            for k in range(count):
                p += product[row, first + k] * blocks[column, k]
            covariance[row, column] = covariance[column, row] = p


@compiled
def _mirror(covariance: Vector) -> None:
    """Copy the upper triangle of a matrix to the lower one."""
    for row in range(STATES):
        for column in range(row):
            covariance[row, column] = covariance[column, row]


@compiled
def measure(mean: Vector, p: Vector, noise: float, position: Vector) -> tuple[float, float]:
    """Update of one filter, in place, by a sample z (3,) [m] of noise variance r [m²], with H = [1,
    0, 0, 1, 0]:

        S = H P Hᵀ + r,   K = P Hᵀ / S,   m = m + K (z - H m),   P = P - K S Kᵀ

    Returns S and |z - H m|² / S before the update.
    """
    cross = np.empty(STATES)
    error = 0.0
    for row in range(STATES):
        cross[row] = p[row, 0] + p[row, 3]  # P Hᵀ: a sample measures position plus tremor
    variance = cross[0] + cross[3] + noise
    for axis in range(3):
        innovation = position[axis] - mean[0, axis] - mean[3, axis]
        error += innovation * innovation
        for row in range(STATES):
            mean[row, axis] += cross[row] / variance * innovation
    for row in range(STATES):
        for column in range(row, STATES):
            p[row, column] -= cross[row] * cross[column] / variance
            p[column, row] = p[row, column]
    return variance, error / variance


@compiled
def _tremble(mean: Vector, covariance: Vector, tremor: Vector, mode: int) -> None:
    """Reset the tremor of one mode to its stationary distribution: mean 0, variances σ² of y and (ω
    σ)² of w, uncorrelated with the motion.
    """
    mean[3:] = 0.0
    covariance[3:, :] = 0.0
    covariance[:, 3:] = 0.0
    covariance[3, 3] = tremor[1 + mode]
    covariance[4, 4] = tremor[1 + mode] * tremor[0] ** 2


@compiled
def _calm_down(config: Struct, mean: Vector, covariance: Vector, mode: int) -> None:
    """Condition a faster mode on being as slow as a calm `mode`: a Kalman update by v = 0 with
    standard deviation σ_v = calm_speed_stds_mps, then by a = 0 with the same number in m/s²: the
    drift of a resting hand changes within a second.
    """
    spread = config.calm_speed_stds_mps[mode]
    for order in range(1, 3):
        row_of = covariance[order].copy()
        variance = row_of[order] + spread * spread
        for axis in range(3):
            residual = mean[order, axis]
            for row in range(STATES):
                mean[row, axis] -= row_of[row] / variance * residual
        for row in range(STATES):
            for column in range(STATES):
                covariance[row, column] -= row_of[row] * row_of[column] / variance


@compiled
def _leave_calm(mean: Vector, covariance: Vector) -> None:
    """Turn the tremor of a calm mode into motion: p = p + y and v = v + w, in mean and
    covariance. The samples showed both, so the filter restarts from the unsmoothed state.
    """
    mean[:2] += mean[3:]
    covariance[:2] += covariance[3:]
    covariance[:3, :2] += covariance[:3, 3:]


@compiled
def bounded(config: Struct, innovation: float) -> float:
    """Squared, normalised innovation x on three axes, limited to 6 outlier_variances, where exp(-½
    x) is least_mode_probability on each axis: a less probable sample does not distinguish modes.
    """
    most: float = 6.0 * config.outlier_variances
    return min(innovation, most)


@compiled
def _switched(
    config: Struct,
    means: Vector,
    covariances: Vector,
    modes: Vector,
    interval_s: float,
    shares: Vector,
) -> None:
    """Joint probabilities s (MODES, MODES), written to `shares`, of mode i before an interval Δ and
    mode j after it:

        s_ij = μ_i ((1 - exp(-λ_i Δ)) ρ_j + δ_ij exp(-λ_i Δ))

    μ are the probabilities `modes`, λ is mode_switch_rates_per_s, ρ is mode_prior. The transition
    from a faster mode i to a calm mode j is weighted by how slow mode i is; s_ii keeps the rest:

        slow_ij = exp(-½ bounded(|v_i|² / (P_i[v, v] + σ_j²))),   σ_j = calm_speed_stds_mps
    """
    for i in range(MODES):
        stay = exp(-config.mode_switch_rates_per_s[i] * interval_s)
        for j in range(MODES):
            shares[i, j] = modes[i] * (
                (1.0 - stay) * config.mode_prior[j] + (stay if i == j else 0.0)
            )
        for calm in range(min(i, REACH)):
            variance = covariances[i, 1, 1] + config.calm_speed_stds_mps[calm] ** 2
            slow = exp(-0.5 * bounded(config, square(means[i, 1]) / variance))
            shares[i, i] += (1.0 - slow) * shares[i, calm]
            shares[i, calm] *= slow


@compiled
def _mix(  # noqa: C901, PLR0912 - one nest of loops
    config: Struct,
    means: Vector,
    covariances: Vector,
    shares: Vector,
    expected: Vector,
    tremor: Vector,
) -> None:
    """Mixed initial condition of each mode j from the `shares` s (MODES, MODES) of `_switched`, in
    place; the predicted probabilities c (MODES,) are written to `expected`.

        c_j = Σ_i s_ij,   m_j = Σ_i s_ij m_ij / c_j
        P_j = Σ_i s_ij (P_ij + Σ_axes (m_ij - m_j)(m_ij - m_j)ᵀ / 3) / c_j

    m_ij and P_ij are those of mode i; for a faster i and a calm j, after `_calm_down`. Between a
    calm mode and another one, without an evident tremor (σ = 0 in CHANGE), the tremor of mode j is
    reset, after `_leave_calm` (i is calm); so is that between REACH and CHANGE. Of each P_j, only
    the upper triangle is computed.
    """
    of_means = np.empty((MODES, MODES, STATES, 3))
    of_covariances = np.empty((MODES, MODES, STATES, STATES))
    is_evident = tremor[1 + CHANGE] > 0.0
    for j in range(MODES):
        for i in range(MODES):
            of_means[j, i] = means[i]
            of_covariances[j, i] = covariances[i]
            if j < min(i, REACH):
                _calm_down(config, of_means[j, i], of_covariances[j, i], j)
            if i != j and max(i, j) >= REACH and not is_evident:
                if i <= STEADY:
                    _leave_calm(of_means[j, i], of_covariances[j, i])
                _tremble(of_means[j, i], of_covariances[j, i], tremor, j)

    for j in range(MODES):
        mean = means[j]
        covariance = covariances[j]
        expected[j] = 0.0
        mean[:] = 0.0
        covariance[:] = 0.0
        for i in range(MODES):
            expected[j] += shares[i, j]
        for i in range(MODES):
            share = shares[i, j] / expected[j]
            for a in range(STATES):
                for axis in range(3):
                    mean[a, axis] += share * of_means[j, i, a, axis]
        for i in range(MODES):
            share = shares[i, j] / expected[j]
            deviations = of_means[j, i]
            deviations -= mean
            for a in range(STATES):
                for b in range(a, STATES):
                    variance = of_covariances[j, i, a, b] + dot(deviations[a], deviations[b]) / 3.0
                    covariance[a, b] += share * variance


@compiled
def _beyond_calm(config: Struct, mean: Vector, tremor: Vector, mode: int) -> float:
    """Squared, normalised excess of the speed and tremor of a calm mode over their bounds:

        max(|v|² / σ_v² - outlier_variances, 0) + max(|y|² + |w|² / ω² - y_max², 0) / σ²

    with σ_v = calm_speed_stds_mps, y_max = max_tremor_m and the tremor's σ.
    """
    speed = square(mean[1]) / config.calm_speed_stds_mps[mode] ** 2
    beyond_m2 = max(squared_amplitude(mean[3], mean[4], tremor[0]) - config.max_tremor_m**2, 0.0)
    return float(max(speed - config.outlier_variances, 0.0) + beyond_m2 / tremor[1 + mode])


@compiled
def update(state: Struct, config: Struct, side: int, position: Vector, interval_s: float) -> None:
    """Posterior of all modes after a sample z (3,) [m] with noise variance r [m²], `interval_s`
    after the sample before. The modes must have been advanced to the time of the sample.

    Without an evident tremor, that of CHANGE is cleared first, as it may have been evident before.
    The modes are mixed (`_switched`, `_mix`), then each is updated (`measure`):

        log L = -3/2 log S - ½ bounded(|z - H m|² / S),   μ_j ∝ c_j L_j

    The innovation in log L is that before the update. In the calm modes, log L is reduced by half
    of `_beyond_calm`. The probabilities μ stay above about least_mode_probability.
    """
    means = state.mode_means[side]
    covariances = state.mode_covariances[side]
    modes = state.mode_probabilities[side]
    tremor = state.tremors[side]
    shares = np.empty((MODES, MODES))
    expected = np.empty(MODES)
    likelihood = np.empty(MODES)
    if tremor[1 + CHANGE] == 0.0:
        _tremble(means[CHANGE], covariances[CHANGE], tremor, CHANGE)
    _switched(config, means, covariances, modes, interval_s, shares)
    _mix(config, means, covariances, shares, expected, tremor)

    for i in range(MODES):
        _mirror(covariances[i])
        variance, error = measure(means[i], covariances[i], state.noise_variance[side], position)
        likelihood[i] = -1.5 * log(variance) - 0.5 * bounded(config, error)
        if i <= STEADY:
            likelihood[i] -= 0.5 * _beyond_calm(config, means[i], tremor, i)

    # Relative to the best one, no likelihood underflows in all modes.
    best = likelihood.max()
    for i in range(MODES):
        modes[i] = expected[i] * exp(likelihood[i] - best)
    _normalise(modes)
    for i in range(MODES):
        modes[i] = max(modes[i], config.least_mode_probability)
    _normalise(modes)


@compiled
def _normalise(modes: Vector) -> None:
    """Divide the probabilities (MODES,) by their sum, in place."""
    total = 0.0
    for i in range(MODES):
        total += modes[i]
    for i in range(MODES):
        modes[i] /= total
