"""Position, velocity, acceleration and stillness of each hand, estimated from its tracker's
samples.

The estimator is an interacting-multiple-model filter (`mode_filter`) with the modes rest, steady,
reach and change. The modes share one measurement noise variance r, which is estimated from the
third differences of the samples: smooth motion leaves almost nothing in them, and white noise of
variance r leaves the variance 20 r on each axis.

Stillness, 0 to 1, distinguishes a hand that waits at a via-point from one on its way. It rises
slowly and falls at once. A tremor does not lower it, and a turning point on the way hardly raises
it.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.codes import DOUBTED, LEARNING, TRUSTED
from thirdhand.core.frame import Record, Records, Vector, as_array, parameters
from thirdhand.core.geometry import ROUND_TO
from thirdhand.core.intake import CONFIRMED_SAMPLES, KEPT, MODES, SETTLED_SAMPLES
from thirdhand.core.intake.mode_filter import advance, start, update
from thirdhand.core.intake.motion_model import CHANGE, ENDLESS, REACH, model
from thirdhand.core.intake.tremor import no_tremor, note_tremor
from thirdhand.core.intake.tuning import IntakeTuning
from thirdhand.core.numerics import MAX_STAMP_DIFFERENCE_NS, TICK_ROUNDING
from thirdhand.core.tuning import TUNING
from thirdhand.core.vectors import squared_distance

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
    square = 0.0
    for axis in range(3):
        lowpass[axis] = (
            np.rint((lowpass[axis] + gains[0] * (velocity[axis] - lowpass[axis])) * ROUND_TO)
            / ROUND_TO
        )
        square += lowpass[axis] * lowpass[axis]
    share = square / still_speed**2
    now = exp(-share * share)
    after = stillness + gains[1] * (now - stillness) if now > stillness else now
    return float(np.rint(after * ROUND_TO) / ROUND_TO)


def stillness_of(velocities: Vector, period_s: float) -> Vector:
    """Stillness (T, 2) of both hands with the velocities (T, 6) [m/s]. Both start still."""
    out = np.empty((len(velocities), 2))
    stillness = STILL.copy()
    gains = smoothing(period_s)
    still_mps = TUNING.intake.hand_still_mps
    lowpass = np.zeros((2, 3))
    for row, velocity in zip(out, np.ascontiguousarray(velocities).reshape(-1, 2, 3), strict=True):
        for side in (0, 1):
            stillness[side] = stillness_after(
                velocity[side], gains, still_mps, lowpass[side], stillness[side]
            )
        row[:] = stillness
    return out


class HandEstimator:
    """Estimates of both hands; all that is estimated is kept in the state's arrays."""

    def __init__(self, intake: Records, models: Records, numbers: IntakeTuning) -> None:
        self._intake = intake
        self._models = models
        self._numbers = numbers
        self._period_s = float(intake["period_s"][0])
        self._model = functools.lru_cache(maxsize=64)(self._model_over)

    def _model_over(self, ticks: int) -> Records:
        """The motion model and the gains of `smoothing` over an interval of some ticks, and the
        speed of a still hand, as one record (1,). Over minutes the model's covariance would
        overflow; beyond the intervals of `models` both hands are stale, and no model is used.
        """
        interval_s = ticks * self._period_s
        gains = smoothing(interval_s, self._numbers)
        used_s = min(ticks, len(self._models)) * self._period_s
        return parameters(
            **model(used_s, self._numbers),
            smoothing=gains,
            still_speed=self._numbers.hand_still_mps,
        )

    def begin(self, state: Record) -> None:
        """Set what holds before the first sample: noise variance, stillness and tremor."""
        state["noise_variance"] = self._numbers.noise_std_m**2
        state["hand_stillness"] = STILL
        for side in (0, 1):
            no_tremor(as_array(state), self._intake, side)
        state["bank_ticks"] = -len(self._models)

    def advance(self, state: Record, ticks: int, stale_ticks: int) -> None:
        """Advance the state by some ticks, and both hands with it. A hand without a sample for
        `stale_ticks` is assumed to stand still.
        """
        _advance_both(
            as_array(state), self._intake, self._models, ticks, stale_ticks, self._model(ticks)
        )


@compiled
def _update_noise(
    states: Records, parameters: Records, side: int, position: Vector, interval_s: float
) -> None:
    """Update the noise variance r [m²] of one hand by a sample x_0 (3,) [m] that follows x_1, x_2,
    x_3:

        d = x_0 - 3 x_1 + 3 x_2 - x_3,   n = min(n + 1, noise_samples)
        r = r + (min(|d|² / 60, outlier_variances r) - r) / (n + 1)

    60 = 3 axes * (1 + 9 + 9 + 1). r is at least least_noise_m². Only evenly spaced samples are
    used: when an interval differs by more than half from the one before, this sample and the next
    do not change r.
    """
    state = states[0]
    config = parameters[0]
    history = states[0].past_samples[side]
    count = state.even_samples[side]
    variance = state.noise_variance[side]
    before_s = state.sample_interval_s[side]
    if count >= 2 and abs(interval_s - before_s) > 0.5 * before_s:
        count = 1
    state.sample_interval_s[side] = interval_s
    if count >= 3:
        square = 0.0
        for axis in range(3):
            third = (
                position[axis] - 3.0 * history[0, axis] + 3.0 * history[1, axis] - history[2, axis]
            )
            square += third * third
        sample_variance = min(square / 60.0, config.outlier_variances * variance)
        samples = min(state.noise_samples[side] + 1, config.noise_samples)
        state.noise_samples[side] = samples
        variance += (sample_variance - variance) / (samples + 1.0)
        state.noise_variance[side] = max(variance, config.least_noise_m**2)
    for axis in range(3):
        history[2, axis] = history[1, axis]
        history[1, axis] = history[0, axis]
        history[0, axis] = position[axis]
    state.even_samples[side] = min(count + 1, 3)


@compiled
def _advance_both(
    states: Records,
    parameters: Records,
    models: Records,
    ticks: int,
    stale_ticks: int,
    overs: Records,
) -> None:
    """Advance the state by some ticks: modes, estimate and stillness of both hands. `overs` (1,)
    is the record of `HandEstimator._model_over`. A stale hand stands still: its velocity,
    acceleration and tremor are set to zero.
    """
    state = states[0]
    over = overs[0]
    state.tick += ticks
    for side in range(2):
        hand = state.hands[side]
        if is_fresh(states, side, stale_ticks):
            advance_hand(states, side, overs)
            estimate(states, parameters, models, side)
        else:
            state.mode_means[side, :, 1:] = 0.0
            hand[1:] = 0.0
        lowpass = state.hand_velocity_lowpass[side]
        stillness = state.hand_stillness[side]
        state.hand_stillness[side] = stillness_after(
            hand[1], over.smoothing, over.still_speed, lowpass, stillness
        )


@compiled
def estimate(states: Records, parameters: Records, models: Records, side: int) -> None:
    """Position, velocity and acceleration of one hand, Σ_j μ_j m_j, written to `hands` (3, 3) of
    the state. μ_j and m_j are probability and mean of mode j at the current tick.

    After its newest sample, a hand that reaches or changes its motion goes on without an end
    (ENDLESS) for max_late_s - CONFIRMED_SAMPLES sample intervals: a late sample, or one that is not
    seen, does not end a reach. With a slow tracker a reach ends in between.
    """
    state = states[0]
    config = parameters[0]
    modes = state.mode_probabilities[side]
    newest = slot(states, side, 0)
    passed = state.tick - state.kept_ticks[side, newest]
    going_s = config.max_late_s - CONFIRMED_SAMPLES * state.sample_interval_s[side]
    going_on = min(passed, int(going_s / config.period_s + TICK_ROUNDING))
    state.hands[side] = 0.0
    for mode in range(MODES):
        means = state.mode_means[side, mode, :3]
        if mode >= REACH and going_on > 0:
            means = _moved(models, going_on, ENDLESS, state.kept_means[side, newest, mode, :3])
            means = _moved(models, passed - going_on, mode, means)
        for row in range(3):
            for axis in range(3):
                state.hands[side, row, axis] += modes[mode] * means[row, axis]


@compiled
def _moved(models: Records, ticks: int, motion: int, means: Vector) -> Vector:
    """F m (3, 3), by axis: the mean m (3, 3) of a mode some ticks later, if it moves by a `motion`
    with the transition F.
    """
    transition = models[min(ticks, len(models) - 1)].transition[motion]
    out = np.zeros((3, 3))
    for row in range(3):
        for k in range(3):
            for axis in range(3):
                out[row, axis] += transition[row, k] * means[k, axis]
    return out


@compiled
def is_fresh(states: Records, side: int, stale_ticks: int) -> bool:
    """True if a sample of this hand arrived less than `stale_ticks` ago."""
    sample_tick = states[0].hand_ticks[side]
    return bool(sample_tick >= 0 and states[0].tick - sample_tick < stale_ticks)


@compiled
def goes_on(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a hand that is seen again at x (3,) [m] continues its filter: its newest sample is
    less than `unseen_ticks` old, and |x - p|² < outlier_variances (P + r).

    p is the estimated position, P the position's variance in the mode CHANGE, r the noise variance.
    """
    state = states[0]
    config = parameters[0]
    square_m2 = squared_distance(position, state.hands[side, 0])
    variance = state.mode_covariances[side, CHANGE, 0, 0] + state.noise_variance[side]
    return bool(
        is_fresh(states, side, config.unseen_ticks)
        and square_m2 < config.outlier_variances * variance
    )


@compiled
def turn_to(
    states: Records, side: int, turn: tuple[float, float, float, float], mapping: Vector
) -> None:
    """Store the orientation of one hand as a rotation matrix in frame base, row by row.

    `turn` is the quaternion x y z w in the tracker's axes. `mapping` (3, 4) maps the tracker's
    coordinates to base: rotation times unit [m], and origin.
    """
    x, y, z, w = turn
    out = states[0].hand_turns[side]
    s = 2.0 / (x * x + y * y + z * z + w * w)
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1.0 - s * (y * y + z * z)
    matrix[0, 1] = s * (x * y - z * w)
    matrix[0, 2] = s * (x * z + y * w)
    matrix[1, 0] = s * (x * y + z * w)
    matrix[1, 1] = 1.0 - s * (x * x + z * z)
    matrix[1, 2] = s * (y * z - x * w)
    matrix[2, 0] = s * (x * z - y * w)
    matrix[2, 1] = s * (y * z + x * w)
    matrix[2, 2] = 1.0 - s * (x * x + y * y)
    unit = math.sqrt(mapping[0, 0] ** 2 + mapping[1, 0] ** 2 + mapping[2, 0] ** 2)
    out[:] = 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[3 * i + j] += mapping[i, k] / unit * matrix[k, j]


@compiled
def seconds_after(stamp_ns: int, other_ns: int) -> float:
    """Difference `stamp_ns` - `other_ns` in seconds, without overflow for any two stamps."""
    apart_ns = float(stamp_ns) - float(other_ns)
    return 1e-9 * (
        float(stamp_ns - other_ns) if abs(apart_ns) < MAX_STAMP_DIFFERENCE_NS else apart_ns
    )


@compiled
def _later_s(states: Records, side: int, quickest: int, stamp_ns: int, period_s: float) -> float:
    """Delay [s] of a sample that arrives now, minus the minimum delay of the current window
    (`quickest` = 0) or the one before (1).

    A delay is arrival time minus stamp; the unknown offset of the tracker's clock cancels.
    """
    state = states[0]
    passed_s = (state.tick - state.quickest_ticks[side, quickest]) * period_s
    return float(passed_s - seconds_after(stamp_ns, state.quickest_stamps_ns[side, quickest]))


@compiled
def ticks_late(
    states: Records, side: int, stamp_ns: int, period_s: float, max_late_s: float
) -> int:
    """Whole ticks by which a sample's delay exceeds the smaller minimum delay of the last two
    windows, at most `max_late_s`; 0 while the tracker's clock is not trusted.
    """
    if states[0].clock[side] != TRUSTED:
        return 0
    late_s = max(
        _later_s(states, side, 0, stamp_ns, period_s), _later_s(states, side, 1, stamp_ns, period_s)
    )
    return int(min(max(late_s, 0.0), max_late_s) / period_s + TICK_ROUNDING)


@compiled
def note_clock(states: Records, parameters: Records, side: int, stamp_ns: int, fresh: bool) -> None:
    """Update the minimum delays of one tracker by a sample that arrives now, and the trust in its
    clock.

    Every tracker_memory_s, the clock is trusted if the minimum delays of two consecutive windows
    agree within delay_tolerance_s. Learning restarts with the first sample, and with one that
    arrives after a silence (not `fresh`) more than `longest_late_s` above the minimum delay: the
    clock was set back.

    The longest delay d above the minimum in these two windows determines from which age on the hand
    is stale, between the settings `stale_ms` and `stale_max_ms`: d / end_share.
    """
    state = states[0]
    config = parameters[0]
    period_s = parameters[0].period_s
    longest_late_s = config.longest_late_s
    stamps = state.quickest_stamps_ns[side]
    ticks = state.quickest_ticks[side]
    has_clock = state.clock_tick[side] >= 0
    if not has_clock or (
        not fresh and _later_s(states, side, 0, stamp_ns, period_s) > longest_late_s
    ):
        # learning (re)starts
        stamps[:] = stamp_ns
        ticks[:] = state.tick
        state.clock_tick[side] = state.tick
        state.clock[side] = LEARNING
        state.longest_delay_ticks[side] = 0
    elif (state.tick - state.clock_tick[side]) * period_s >= config.tracker_memory_s:
        # the window is over: is its minimum delay that of the window before?
        change_s = _later_s(states, side, 1, stamps[0], period_s) - _later_s(
            states, side, 0, stamps[0], period_s
        )
        steady = abs(change_s) <= config.delay_tolerance_s and state.clock[side] != LEARNING
        state.clock[side] = TRUSTED if steady else DOUBTED
        stamps[1] = stamps[0]
        ticks[1] = ticks[0]
        stamps[0] = stamp_ns
        ticks[0] = state.tick
        state.clock_tick[side] = state.tick
        state.longest_delay_ticks[side, 1] = state.longest_delay_ticks[side, 0]
        state.longest_delay_ticks[side, 0] = 0
    elif _later_s(states, side, 0, stamp_ns, period_s) < 0.0:
        # a new minimum
        stamps[0] = stamp_ns
        ticks[0] = state.tick

    late = ticks_late(states, side, stamp_ns, period_s, longest_late_s)
    state.longest_delay_ticks[side, 0] = max(state.longest_delay_ticks[side, 0], late)
    stale = math.ceil(state.longest_delay_ticks[side].max() / config.end_share)
    state.stale_ticks[side] = min(max(stale, config.stale_ticks), config.stale_max_ticks)


@compiled
def slot(states: Records, side: int, order: int) -> int:
    """Index in a hand's ring of its sample number `order`; 0 is the newest."""
    return int((states[0].kept_newest[side] - order) % KEPT)


@compiled
def order_of(states: Records, side: int, stamp_ns: int) -> int:
    """Number of retained samples with a newer stamp than this; -1 if one has the same stamp."""
    state = states[0]
    for order in range(state.kept[side]):
        kept_ns = state.kept_stamps_ns[side, slot(states, side, order)]
        if kept_ns <= stamp_ns:
            return -1 if kept_ns == stamp_ns else order
    return int(state.kept[side])


@compiled
def take(
    states: Records,
    parameters: Records,
    models: Records,
    side: int,
    stamp_ns: int,
    position: Vector,
    restarts: bool,
    fresh: bool,
) -> None:
    """Filter a sample (3,) [m] of one hand that has the newest stamp and arrived without extra
    delay.

    The filter starts anew if the sample `restarts` it (a confirmed jump), or if no sample is
    retained. `fresh` is false after a silence; see `note_clock`.
    """
    state = states[0]
    note_clock(states, parameters, side, stamp_ns, fresh)
    ticks = (
        state.tick - state.kept_ticks[side, slot(states, side, 0)] if state.kept[side] > 0 else -1
    )
    state.kept_newest[side] = (state.kept_newest[side] + 1) % KEPT
    state.kept[side] = min(state.kept[side] + 1, KEPT)
    newest = state.kept_newest[side]
    state.kept_ticks[side, newest] = state.tick
    state.kept_stamps_ns[side, newest] = stamp_ns
    state.kept_late[side, newest] = 0
    state.kept_restarts[side, newest] = restarts
    state.kept_positions[side, newest] = position
    interval_s = parameters[0].tracker_memory_s if ticks < 0 else ticks * parameters[0].period_s
    filter_in(states, parameters, side, newest, interval_s, restarts or ticks < 0)
    settle(states, parameters, models, side)
    estimate(states, parameters, models, side)


@compiled
def settle(states: Records, parameters: Records, models: Records, side: int) -> None:
    """Update the tremor of one hand by its newest settled sample."""
    if states[0].kept[side] > SETTLED_SAMPLES:
        note_tremor(states, parameters, models, side, slot(states, side, SETTLED_SAMPLES))


@compiled
def advance_hand(states: Records, side: int, overs: Records) -> None:
    """Advance all modes of one hand over the interval of the record `overs` (1,)."""
    state = states[0]
    rate = state.tremor_rate[side]
    tremor = state.tremors[side]
    advance(state.mode_means[side], state.mode_covariances[side], overs, rate, tremor)


@compiled
def filter_in(
    states: Records, parameters: Records, side: int, at: int, interval_s: float, anew: bool
) -> None:
    """Filter the retained sample at ring index `at`, and store the filter's state beside it.

    The filter must have been advanced to the sample's tick. `anew` starts it from this sample
    alone.
    """
    state = states[0]
    position = states[0].kept_positions[side, at]
    means = state.mode_means[side]
    covariances = state.mode_covariances[side]
    if anew:
        state.even_samples[side] = 0
    _update_noise(states, parameters, side, position, interval_s)
    variance = state.noise_variance[side]
    modes = state.mode_probabilities[side]
    if anew:
        start(parameters, means, covariances, modes, variance, position, state.tremors[side])
    else:
        update(
            parameters,
            means,
            covariances,
            modes,
            variance,
            position,
            interval_s,
            state.tremors[side],
        )
    _remember(states, side, at)


@compiled
def _remember(states: Records, side: int, at: int) -> None:
    """Store the complete state of one hand's filter at ring index `at`, for `late_samples`."""
    state = states[0]
    state.kept_means[side, at] = state.mode_means[side]
    state.kept_covariances[side, at] = state.mode_covariances[side]
    state.kept_probabilities[side, at] = state.mode_probabilities[side]
    state.kept_past[side, at] = state.past_samples[side]
    noise = state.kept_noise[side, at]
    noise[0] = state.noise_variance[side]
    noise[1] = state.noise_samples[side]
    noise[2] = state.even_samples[side]
    noise[3] = state.sample_interval_s[side]
