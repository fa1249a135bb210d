"""Position, velocity, acceleration and stillness of each hand, estimated from its tracker's
samples.

The estimator is an interacting-multiple-model filter (`mode_filter`) with the modes rest, steady,
reach and change. The modes share one measurement noise variance r, which is estimated from the
third differences of the samples: smooth motion leaves almost nothing in them, and white noise of
variance r leaves the variance 20 r on each axis.

Stillness, 0 to 1, distinguishes a hand that waits at a via-point from one on its way. It rises
slowly and falls at once. A tremor does not lower it, and a turning point on the way hardly raises
it.

The newest KEPT samples of each hand are retained in rings, each with the state of the filter after
it. `order` counts them backward from the newest, which is 0.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.codes import DOUBTED, LEARNING, TRUSTED
from thirdhand.core.frame import Record, Records, Struct, Vector, as_array, parameters
from thirdhand.core.intake import CONFIRMED_SAMPLES, KEPT, MODES, SETTLED_SAMPLES
from thirdhand.core.intake.mode_filter import advance, start, update
from thirdhand.core.intake.motion_model import ENDLESS, REACH, model
from thirdhand.core.intake.tremor import no_tremor, note_tremor
from thirdhand.core.intake.tuning import IntakeTuning
from thirdhand.core.numerics import MAX_STAMP_DIFFERENCE_NS, TICK_ROUNDING
from thirdhand.core.tuning import TUNING
from thirdhand.core.vectors import add_product, rounded, square

STILL = np.ones(2)  # stillness of two hands that rest


def smoothing(period_s: float, numbers: IntakeTuning = TUNING.intake) -> Vector:
    """Filter gains (2,) of one period for the lowpass velocity and rising stillness: 1 -
    exp(-period / time constant).
    """
    times_s = numbers.stillness_lowpass_s, numbers.hand_still_s
    return 1.0 - np.array([exp(-period_s / time_s) for time_s in times_s])


@compiled
def stillness_after(
    velocity: Vector, gains: Vector, still_speed: float, lowpass: Vector, stillness: float
) -> float:
    """Stillness s of a hand one period later, at the velocity v (3,) [m/s].

    With the `gains` g of `smoothing`, and the velocity without tremor u (`lowpass`, (3,),
    updated in place):

        u = u + g_0 (v - u),   n = exp(-(|u| / still_speed)⁴)
        s = s + g_1 (n - s) if n > s else n
    """
    for axis in range(3):
        lowpass[axis] = rounded(lowpass[axis] + gains[0] * (velocity[axis] - lowpass[axis]))
    share = square(lowpass) / still_speed**2
    now = exp(-share * share)
    return rounded(stillness + gains[1] * (now - stillness) if now > stillness else now)


class HandEstimator:
    """Estimates of both hands between samples; all that is estimated is kept in the state."""

    def __init__(self, intake: Records, models: Records, numbers: IntakeTuning) -> None:
        self._intake = intake
        self._models = models
        self._numbers = numbers
        self._model = functools.lru_cache(maxsize=64)(self._model_over)

    def _model_over(self, ticks: int) -> Records:
        """The motion model and the gains of `smoothing` over an interval of some ticks, as one
        record (1,). Over minutes the model's covariance would overflow; beyond the intervals of
        `models` both hands are stale, and no model is used.
        """
        period_s = float(self._intake["period_s"][0])
        return parameters(
            **model(min(ticks, len(self._models)) * period_s, self._numbers),
            smoothing=smoothing(ticks * period_s, self._numbers),
        )

    def begin(self, state: Record) -> None:
        """Set what holds before the first sample: noise variance, stillness and tremor."""
        noise_std_m = self._numbers.outlier_stds * self._numbers.least_noise_m
        state["noise_variance"] = noise_std_m**2
        state["hand_stillness"] = STILL
        state["bank_ticks"] = -len(self._models)
        for side in (0, 1):
            no_tremor(state, self._intake[0], side)

    def advance(self, state: Record, ticks: int) -> None:
        """Advance the state by some ticks, and both hands with it."""
        over = self._model(ticks)
        _advance_both(as_array(state), self._intake, self._models, ticks, over)


@compiled
def _advance_both(
    states: Records, parameters: Records, models: Records, ticks: int, overs: Records
) -> None:
    """Advance the state by some ticks: modes, estimate and stillness of both hands. `overs` (1,)
    is the record of `HandEstimator._model_over`. A hand without a sample for `unseen_ticks` is
    assumed to stand still: its velocity, acceleration and tremor are set to zero.
    """
    state = states[0]
    config = parameters[0]
    over = overs[0]
    state.tick += ticks
    for side in range(2):
        hand = state.hands[side]
        if is_fresh(state, side, config.unseen_ticks):
            advance(state, side, over)
            estimate(state, config, models, side)
        else:
            state.mode_means[side, :, 1:] = 0.0
            hand[1:] = 0.0
        state.hand_stillness[side] = stillness_after(
            hand[1],
            over.smoothing,
            config.hand_still_mps,
            state.hand_velocity_lowpass[side],
            state.hand_stillness[side],
        )


@compiled
def estimate(state: Struct, config: Struct, models: Records, side: int) -> None:
    """Position, velocity and acceleration of one hand, Σ_j μ_j m_j, written to `hands` (3, 3) of
    the state. μ_j and m_j are probability and mean of mode j at the current tick.

    After its newest sample, a hand that reaches or changes its motion goes on without an end
    (ENDLESS) for max_late_s - CONFIRMED_SAMPLES sample intervals: a late sample, or one that is not
    seen, does not end a reach. With a slow tracker a reach ends in between.
    """
    newest = slot(state, side, 0)
    passed = state.tick - state.kept_ticks[side, newest]
    going_s = config.max_late_s - CONFIRMED_SAMPLES * state.sample_interval_s[side]
    going_on = min(passed, int(going_s / config.period_s + TICK_ROUNDING))
    hand = state.hands[side]
    hand[:] = 0.0
    for mode in range(MODES):
        means = state.mode_means[side, mode, :3]
        if mode >= REACH and going_on > 0:
            means = np.zeros((3, 3))
            reaching = np.zeros((3, 3))
            transition = model_over(models, going_on).transition[ENDLESS]
            add_product(transition, state.kept_means[side, newest, mode, :3], reaching)
            transition = model_over(models, passed - going_on).transition[mode]
            add_product(transition, reaching, means)
        hand += state.mode_probabilities[side, mode] * means


@compiled
def model_over(models: Records, ticks: int) -> Struct:
    """The record of `motion_model.models` for an interval of some ticks, at most the longest."""
    return models[min(ticks, len(models) - 1)]


@compiled
def is_fresh(state: Struct, side: int, stale_ticks: int) -> bool:
    """True if a sample of this hand arrived less than `stale_ticks` ago."""
    sample_tick = state.hand_ticks[side]
    return bool(sample_tick >= 0 and state.tick - sample_tick < stale_ticks)


@compiled
def seconds_after(stamp_ns: int, other_ns: int) -> float:
    """Difference `stamp_ns` - `other_ns` in seconds, without overflow for any two stamps."""
    apart_ns = float(stamp_ns) - float(other_ns)
    return 1e-9 * (
        float(stamp_ns - other_ns) if abs(apart_ns) < MAX_STAMP_DIFFERENCE_NS else apart_ns
    )


@compiled
def _later_s(state: Struct, side: int, quickest: int, stamp_ns: int, period_s: float) -> float:
    """Delay [s] of a sample that arrives now, minus the minimum delay of the current window
    (`quickest` = 0) or the one before (1).

    A delay is arrival time minus stamp; the unknown offset of the tracker's clock cancels.
    """
    passed_s = (state.tick - state.quickest_ticks[side, quickest]) * period_s
    return float(passed_s - seconds_after(stamp_ns, state.quickest_stamps_ns[side, quickest]))


@compiled
def ticks_late(state: Struct, side: int, stamp_ns: int, period_s: float, max_late_s: float) -> int:
    """Whole ticks by which a sample's delay exceeds the smaller minimum delay of the last two
    windows, at most `max_late_s`; 0 while the tracker's clock is not trusted.
    """
    if state.clock[side] != TRUSTED:
        return 0
    late_s = max(
        _later_s(state, side, 0, stamp_ns, period_s), _later_s(state, side, 1, stamp_ns, period_s)
    )
    return int(min(max(late_s, 0.0), max_late_s) / period_s + TICK_ROUNDING)


@compiled
def note_clock(state: Struct, config: Struct, side: int, stamp_ns: int, fresh: bool) -> None:
    """Update the minimum delays of one tracker by a sample that arrives now, and the trust in its
    clock.

    Every tracker_memory_s, the clock is trusted if the minimum delays of two consecutive windows
    agree within delay_tolerance_s. Learning restarts with the first sample, and with one that
    arrives after a silence (not `fresh`) more than `longest_late_s` above the minimum delay: the
    clock was set back.

    The longest delay d above the minimum in these two windows determines from which age on the hand
    is stale, between the settings `stale_ms` and `stale_max_ms`: d / end_share.
    """
    period_s = config.period_s
    longest_late_s = config.longest_late_s
    stamps = state.quickest_stamps_ns[side]
    ticks = state.quickest_ticks[side]
    longest = state.longest_delay_ticks[side]
    later_s = _later_s(state, side, 0, stamp_ns, period_s)
    restarts = state.clock_tick[side] < 0 or (not fresh and later_s > longest_late_s)
    passed_s = (state.tick - state.clock_tick[side]) * period_s
    is_over = not restarts and passed_s >= config.tracker_memory_s
    if restarts:
        stamps[1] = stamp_ns
        ticks[1] = state.tick
        longest[1] = 0
        state.clock[side] = LEARNING
    elif is_over:
        # is the window's minimum delay that of the window before?
        change_s = _later_s(state, side, 1, stamps[0], period_s) - _later_s(
            state, side, 0, stamps[0], period_s
        )
        steady = abs(change_s) <= config.delay_tolerance_s and state.clock[side] != LEARNING
        state.clock[side] = TRUSTED if steady else DOUBTED
        stamps[1] = stamps[0]
        ticks[1] = ticks[0]
        longest[1] = longest[0]
    is_new_window = restarts or is_over
    if is_new_window:
        state.clock_tick[side] = state.tick
        longest[0] = 0
    if is_new_window or later_s < 0.0:  # or a new minimum
        stamps[0] = stamp_ns
        ticks[0] = state.tick

    late = ticks_late(state, side, stamp_ns, period_s, longest_late_s)
    longest[0] = max(longest[0], late)
    stale = math.ceil(longest.max() / config.end_share)
    state.stale_ticks[side] = min(max(stale, config.stale_ticks), config.stale_max_ticks)


@compiled
def slot(state: Struct, side: int, order: int) -> int:
    """Index in a hand's ring of its sample number `order`; 0 is the newest."""
    return int((state.kept_newest[side] - order) % KEPT)


@compiled
def take(
    state: Struct,
    config: Struct,
    side: int,
    stamp_ns: int,
    position: Vector,
    restarts: bool,
) -> None:
    """Filter a sample (3,) [m] of one hand that has the newest stamp and was made now.

    The filter starts anew if the sample `restarts` it (a confirmed jump), or if no sample is
    retained.
    """
    ticks = -1
    if state.kept[side] > 0:
        ticks = state.tick - state.kept_ticks[side, slot(state, side, 0)]
    insert(state, side, 0, stamp_ns, state.tick, position, restarts)
    filter_in(state, config, side, slot(state, side, 0), ticks)


@compiled
def insert(
    state: Struct,
    side: int,
    order: int,
    stamp_ns: int,
    tick: int,
    position: Vector,
    restarts: bool,
) -> None:
    """Insert a sample (3,) [m] into a hand's ring as number `order`; `restarts` marks that the
    filter starts anew with it. The filter's states in the ring are not moved: `filter_in` writes
    them again.
    """
    state.kept_newest[side] = (state.kept_newest[side] + 1) % KEPT
    state.kept[side] = min(state.kept[side] + 1, KEPT)
    for newer in range(order):
        new = slot(state, side, newer)
        old = slot(state, side, newer + 1)
        state.kept_stamps_ns[side, new] = state.kept_stamps_ns[side, old]
        state.kept_ticks[side, new] = state.kept_ticks[side, old]
        state.kept_late[side, new] = state.kept_late[side, old]
        state.kept_restarts[side, new] = state.kept_restarts[side, old]
        state.kept_positions[side, new] = state.kept_positions[side, old]
    index = slot(state, side, order)
    state.kept_stamps_ns[side, index] = stamp_ns
    state.kept_ticks[side, index] = tick
    state.kept_late[side, index] = state.tick - tick
    state.kept_restarts[side, index] = restarts
    state.kept_positions[side, index] = position


@compiled
def filter_in(state: Struct, config: Struct, side: int, at: int, ticks: int) -> None:
    """Filter the retained sample at ring index `at`, and store the filter's state beside it.

    The filter must have been advanced to the sample's tick, by `ticks` since the sample before; -1
    if there is none. Then, and after a confirmed jump, the filter starts from this sample alone.
    """
    position = state.kept_positions[side, at]
    interval_s = config.tracker_memory_s if ticks < 0 else ticks * config.period_s
    if ticks < 0 or state.kept_restarts[side, at] > 0:
        state.even_samples[side] = 0
        _update_noise(state, config, side, position, interval_s)
        start(state, config, side, position)
    else:
        _update_noise(state, config, side, position, interval_s)
        update(state, config, side, position, interval_s)
    _remember(state, side, at)


@compiled
def _update_noise(
    state: Struct, config: Struct, side: int, position: Vector, interval_s: float
) -> None:
    """Update the noise variance r [m²] of one hand by a sample x_0 (3,) [m] that follows x_1, x_2,
    x_3:

        d = x_0 - 3 x_1 + 3 x_2 - x_3,   n = min(n + 1, noise_samples)
        r = r + (min(|d|² / 60, outlier_variances r) - r) / (n + 1)

    60 = 3 axes * (1 + 9 + 9 + 1). r is at least least_noise_m². Only evenly spaced samples are
    used: when an interval differs by more than half from the one before, this sample and the next
    do not change r.
    """
    history = state.past_samples[side]
    count = state.even_samples[side]
    before_s = state.sample_interval_s[side]
    if count >= 2 and abs(interval_s - before_s) > 0.5 * before_s:
        count = 1
    state.sample_interval_s[side] = interval_s
    if count >= 3:
        variance = state.noise_variance[side]
        third = position - 3.0 * history[0] + 3.0 * history[1] - history[2]
        sample_variance = min(square(third) / 60.0, config.outlier_variances * variance)
        samples = min(state.noise_samples[side] + 1, config.noise_samples)
        state.noise_samples[side] = samples
        variance += (sample_variance - variance) / (samples + 1.0)
        state.noise_variance[side] = max(variance, config.least_noise_m**2)
    history[2] = history[1]
    history[1] = history[0]
    history[0] = position
    state.even_samples[side] = min(count + 1, 3)


@compiled
def _remember(state: Struct, side: int, at: int) -> None:
    """Store the complete state of one hand's filter at ring index `at`."""
    state.kept_means[side, at] = state.mode_means[side]
    state.kept_covariances[side, at] = state.mode_covariances[side]
    state.kept_probabilities[side, at] = state.mode_probabilities[side]
    state.kept_past[side, at] = state.past_samples[side]
    noise = state.kept_noise[side, at]
    noise[0] = state.noise_variance[side]
    noise[1] = state.noise_samples[side]
    noise[2] = state.even_samples[side]
    noise[3] = state.sample_interval_s[side]


@compiled
def settle(
    state: Struct, config: Struct, models: Records, side: int, stamp_ns: int, fresh: bool
) -> None:
    """Update the tracker's clock, the tremor and the estimate of one hand after a sample was
    filtered.
    """
    note_clock(state, config, side, stamp_ns, fresh)
    if state.kept[side] > SETTLED_SAMPLES:
        note_tremor(state, config, models, side, slot(state, side, SETTLED_SAMPLES))
    estimate(state, config, models, side)
