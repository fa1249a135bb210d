"""Rate and strength of each hand's tremor, estimated by a bank of Kalman filters.

The first two filters of the bank have no tremor, and the motions ENDLESS and CHANGE
(`motion_model`). Each of the others has the motion ENDLESS and a tremor of one of the
tremor_rates_per_s, so tremor is found at rest and in a reach. It is evident when the recent samples
are much more probable with it than with any motion without one.

The bank takes a sample when SETTLED_SAMPLES newer ones are retained: most late samples have been
put in order then, and wrong ones have been dropped.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp, log
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.intake import BANK, NO_TREMOR, USUAL_RATE
from thirdhand.core.intake.mode_filter import measure, move_on
from thirdhand.core.intake.motion_model import CHANGE, ENDLESS, REST
from thirdhand.core.vectors import rounded, squared_amplitude


@compiled
def no_tremor(state: Struct, config: Struct, side: int) -> None:
    """Set the tremor of one hand to that of a hand of which nothing is known: the usual rate, and
    tremor_stds_m.
    """
    state.trembles[side] = 0
    state.tremor_rate[side] = USUAL_RATE
    state.tremors[side, 0] = config.tremor_rates_per_s[USUAL_RATE]
    state.tremors[side, 1:] = config.tremor_stds_m * config.tremor_stds_m


@compiled
def note_tremor(state: Struct, config: Struct, models: Records, side: int, at: int) -> None:
    """Update the bank of one hand by the retained sample at ring index `at`, and the tremor of the
    hand's filter.

    The evidence of filter k relative to filter 0, with the likelihood L_k of the sample, and the
    square σ_k² of the amplitude of its tremor (y, w), after the interval Δ:

        e_k = e_k exp(-Δ / tracker_memory_s) + log L_k - log L_0
        σ_k² = σ_k² + (1 - exp(-Δ / tracker_memory_s)) (min(|y|² + |w|² / ω_k², y_max²) - σ_k²)

    with y_max = max_tremor_m. |z|² / S in log L is at most outlier_variances: one outlier is no
    evidence.
    """
    position = state.kept_positions[side, at]
    means = state.bank_means[side]
    covariances = state.bank_covariances[side]
    evidence = state.bank_evidence[side]
    ticks = state.kept_ticks[side, at] - state.bank_ticks[side]
    noise = state.noise_variance[side]
    if state.kept_stamps_ns[side, at] <= state.bank_stamps_ns[side] and 0 <= ticks < len(models):
        return
    state.bank_stamps_ns[side] = state.kept_stamps_ns[side, at]
    state.bank_ticks[side] = state.kept_ticks[side, at]
    if not 0 <= ticks < len(models) or state.kept_restarts[side, at] > 0:
        _start(config, means, covariances, noise, position)
        return

    fade = exp(-ticks * config.period_s / config.tracker_memory_s)
    null = 0.0
    for k in range(BANK):
        mean = means[k]
        covariance = covariances[k]
        rate = max(k - NO_TREMOR, 0)
        if ticks > 0:
            driven = config.tremor_stds_m[REST] ** 2 if k >= NO_TREMOR else 0.0
            motion = CHANGE if k == 1 else ENDLESS
            move_on(mean, covariance, models[ticks], motion, rate, driven)
        variance, error = measure(mean, covariance, noise, position)
        likelihood = -1.5 * log(variance) - 0.5 * min(error, config.outlier_variances)
        if k == 0:  # the others are compared with it
            null = likelihood
        evidence[k] = rounded(evidence[k] * fade + likelihood - null)
        if k >= NO_TREMOR:
            strength = state.bank_variances[side, rate]
            sample_m2 = squared_amplitude(mean[3], mean[4], config.tremor_rates_per_s[rate])
            strength += (1.0 - fade) * (min(sample_m2, config.max_tremor_m**2) - strength)
            state.bank_variances[side, rate] = strength
    _choose(state, config, side)


@compiled
def _choose(state: Struct, config: Struct, side: int) -> None:
    """Set the tremor of one hand to that of the filter with the most evidence, max e_k, while it is
    above -log least_mode_probability, or above end_share of that if the hand trembled already.

    The tremor's variance is then at least σ_k² in all modes.
    """
    evidence = state.bank_evidence[side]
    best = np.argmax(evidence[NO_TREMOR:])
    least = config.outlier_variances * (config.end_share if state.trembles[side] else 1.0)
    no_tremor(state, config, side)
    if evidence[NO_TREMOR + best] - evidence[:NO_TREMOR].max() > least:
        state.trembles[side] = 1
        state.tremor_rate[side] = best
        state.tremors[side, 0] = config.tremor_rates_per_s[best]
        variances = state.tremors[side, 1:]
        variances[:] = np.maximum(variances, state.bank_variances[side, best])


@compiled
def _start(
    config: Struct, means: Vector, covariances: Vector, noise: float, position: Vector
) -> None:
    """Start all filters of the bank from a sample (3,) [m] with noise variance r [m²]: mean
    (position, 0, 0, 0, 0), and covariance diag(r, σ_v², 0, σ², (ω σ)²), as `mode_filter.start`.
    """
    speed_stds_mps = config.tremor_stds_m[REST] * config.tremor_rates_per_s
    means[:] = 0.0
    means[:, 0] = position
    covariances[:] = 0.0
    covariances[:, 0, 0] = noise
    covariances[:, 1, 1] = config.start_speed_std_mps**2
    covariances[NO_TREMOR:, 3, 3] = config.tremor_stds_m[REST] ** 2
    covariances[NO_TREMOR:, 4, 4] = speed_stds_mps * speed_stds_mps
