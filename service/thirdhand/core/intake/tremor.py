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
from thirdhand.core.frame import Records, Vector
from thirdhand.core.geometry import ROUND_TO
from thirdhand.core.intake import BANK, MODES, NO_TREMOR, USUAL_RATE
from thirdhand.core.intake.mode_filter import measure, move_on
from thirdhand.core.intake.motion_model import CHANGE, ENDLESS, REST


@compiled
def no_tremor(states: Records, parameters: Records, side: int) -> None:
    """Set the tremor of one hand to that of a hand of which nothing is known: the usual rate, and
    tremor_stds_m.
    """
    state = states[0]
    config = parameters[0]
    state.trembles[side] = 0
    state.tremor_rate[side] = USUAL_RATE
    state.tremors[side, 0] = config.tremor_rates_per_s[USUAL_RATE]
    for mode in range(MODES):
        state.tremors[side, 1 + mode] = config.tremor_stds_m[mode] ** 2


@compiled
def note_tremor(states: Records, parameters: Records, models: Records, side: int, at: int) -> None:
    """Update the bank of one hand by the retained sample at ring index `at`, and the tremor of the
    hand's filter.

    The evidence of filter k relative to filter 0, with the likelihood L_k of the sample, and the
    square σ_k² of the amplitude of its tremor (y, w), after the interval Δ:

        e_k = e_k exp(-Δ / tracker_memory_s) + log L_k - log L_0
        σ_k² = σ_k² + (1 - exp(-Δ / tracker_memory_s)) (min(|y|² + |w|² / ω_k², y_max²) - σ_k²)

    with y_max = max_tremor_m. |z|² / S in log L is at most outlier_variances: one outlier is no
    evidence.
    """
    state = states[0]
    config = parameters[0]
    position = states[0].kept_positions[side, at]
    means = state.bank_means[side]
    covariances = state.bank_covariances[side]
    evidence = state.bank_evidence[side]
    ticks = state.kept_ticks[side, at] - state.bank_ticks[side]
    noise = state.noise_variance[side]
    if state.kept_stamps_ns[side, at] <= state.bank_stamps_ns[side] and 0 <= ticks < len(models):
        return
    state.bank_stamps_ns[side], state.bank_ticks[side] = (
        state.kept_stamps_ns[side, at],
        state.kept_ticks[side, at],
    )
    if not 0 <= ticks < len(models) or state.kept_restarts[side, at] > 0:
        _start(parameters, means, covariances, noise, position)
        return

    fade = exp(-ticks * config.period_s / config.tracker_memory_s)
    overs = models[ticks : ticks + 1]
    null = 0.0
    for k in range(BANK):
        mean = means[k]
        covariance = covariances[k]
        rate = max(k - NO_TREMOR, 0)
        if ticks > 0:
            driven = config.tremor_stds_m[REST] ** 2 if k >= NO_TREMOR else 0.0
            move_on(mean, covariance, overs, CHANGE if k == 1 else ENDLESS, rate, driven)
        variance, error = measure(mean, covariance, noise, position)
        likelihood = -1.5 * log(variance) - 0.5 * min(error, config.outlier_variances)
        if k == 0:  # the others are compared with it
            null = likelihood
        evidence[k] = np.rint((evidence[k] * fade + likelihood - null) * ROUND_TO) / ROUND_TO
        if k >= NO_TREMOR:
            amplitude = 0.0
            for axis in range(3):
                amplitude += (
                    mean[3, axis] ** 2 + (mean[4, axis] / config.tremor_rates_per_s[rate]) ** 2
                )
            strength = state.bank_variances[side, rate]
            strength += (1.0 - fade) * (min(amplitude, config.max_tremor_m**2) - strength)
            state.bank_variances[side, rate] = strength
    _choose(states, parameters, side)


@compiled
def _choose(states: Records, parameters: Records, side: int) -> None:
    """Set the tremor of one hand to that of the filter with the most evidence, max e_k, while it is
    above -log least_mode_probability, or above end_share of that if the hand trembled already.

    The tremor's variance is then at least σ_k² in all modes.
    """
    state = states[0]
    config = parameters[0]
    best = NO_TREMOR
    for k in range(NO_TREMOR, BANK):
        if state.bank_evidence[side, k] > state.bank_evidence[side, best]:
            best = k
    least = config.outlier_variances * (config.end_share if state.trembles[side] else 1.0)
    no_tremor(states, parameters, side)
    if (
        state.bank_evidence[side, best]
        - max(state.bank_evidence[side, 0], state.bank_evidence[side, 1])
        > least
    ):
        state.trembles[side] = 1
        state.tremor_rate[side] = best - NO_TREMOR
        state.tremors[side, 0] = config.tremor_rates_per_s[best - NO_TREMOR]
        for mode in range(MODES):
            variance = max(
                state.tremors[side, 1 + mode], state.bank_variances[side, best - NO_TREMOR]
            )
            state.tremors[side, 1 + mode] = variance


@compiled
def _start(
    parameters: Records, means: Vector, covariances: Vector, noise: float, position: Vector
) -> None:
    """Start all filters of the bank from a sample (3,) [m] with noise variance r [m²]: mean
    (position, 0, 0, 0, 0), and covariance diag(r, σ_v², 0, σ², (ω σ)²), as `mode_filter.start`.
    """
    config = parameters[0]
    means[:] = 0.0
    covariances[:] = 0.0
    for k in range(BANK):
        for axis in range(3):
            means[k, 0, axis] = position[axis]
        covariances[k, 0, 0] = noise
        covariances[k, 1, 1] = config.start_speed_std_mps**2
        if k >= NO_TREMOR:
            covariances[k, 3, 3] = config.tremor_stds_m[REST] ** 2
            covariances[k, 4, 4] = (
                config.tremor_stds_m[REST] * config.tremor_rates_per_s[k - NO_TREMOR]
            ) ** 2
