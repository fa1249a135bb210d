"""A hand's position, velocity and acceleration from its tracker's samples, whatever the tracker's
noise.

An interacting-multiple-model filter (`mode_filter`) of three modes: rest, reach, change. They share
one noise variance, estimated from the third differences of the samples: smooth motion leaves
nothing in them, white noise of variance r leaves 20 r an axis.

Stillness, 0 to 1, tells a hand that waits at a via-point from one on its way: it comes slowly and
goes at once, and neither a tremor nor a turn on the way is still.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from kmp.compiled import compiled
from service.config import HandSettings
from service.core.frame import Record, Records, Vector, as_array, parameters
from service.core.geometry import ROUND_TO
from service.core.intake import KEPT, MODES
from service.core.intake.mode_filter import advance, start, update
from service.core.intake.motion_model import CHANGE, model
from service.core.intake.tuning import (
    DELAY_TOLERANCE_S,
    DELAY_WINDOW_S,
    LEAST_NOISE_M,
    LONE_SAMPLE_S,
    MAX_LATE_S,
    MAX_NOISE_M,
    MAX_STAMP_DIFFERENCE_NS,
    MODE_INTENSITIES,
    NOISE_OUTLIER_SHARE,
    NOISE_SAMPLES,
    REAPPEARED_VARIANCE_SHARE,
    STILLNESS_FALL_S,
    STILLNESS_LOWPASS_S,
    TICK_ROUNDING,
)

STILL = np.ones(2)  # both hands
USUAL = HandSettings()  # of recordings, whose cell nobody knows


def smoothing(period_s: float, still_s: float) -> Vector:
    """By how much (3,) the lowpass velocity, rising and falling stillness change in a period."""
    return 1.0 - np.exp(-period_s / np.array([STILLNESS_LOWPASS_S, still_s, STILLNESS_FALL_S]))


@compiled
def stillness_after(velocity: Vector, changes: Vector, still_speed: float, lowpass: Vector, stillness: float) -> float:
    """The stillness of a hand a period later, when it moves so (3,) [m/s]; `changes` are those of
    `smoothing`, `lowpass` (3,) is its velocity without tremor, moved on too.
    """
    square = 0.0
    for axis in range(3):
        lowpass[axis] = np.rint((lowpass[axis] + changes[0] * (velocity[axis] - lowpass[axis])) * ROUND_TO) / ROUND_TO
        square += lowpass[axis] * lowpass[axis]
    share = square / still_speed**2
    now = math.exp(-share * share)
    after = stillness + (changes[1] if now > stillness else changes[2]) * (now - stillness)
    return float(np.rint(after * ROUND_TO) / ROUND_TO)


def stillness_of(velocities: Vector, period_s: float, hands: HandSettings = USUAL) -> Vector:
    """The stillness (T, 2) of both hands that moved so (T, 6) [m/s], from stillness."""
    out, stillness = np.empty((len(velocities), 2)), STILL.copy()
    changes, lowpass, speed = smoothing(period_s, hands.still_s), np.zeros((2, 3)), float(hands.still_speed)
    for row, velocity in zip(out, np.ascontiguousarray(velocities).reshape(-1, 2, 3), strict=True):
        for side in (0, 1):
            stillness[side] = stillness_after(velocity[side], changes, speed, lowpass[side], stillness[side])
        row[:] = stillness
    return out


LEARNING, DOUBTED, BELIEVED = 0, 1, 2  # clocks: in their first second, not steady, steady


class HandEstimator:
    """The estimates of both hands, in the state's arrays."""

    def __init__(self, hands: HandSettings, period_s: float, models: Records) -> None:
        self._hands, self._period_s, self._models = hands, period_s, models
        self._model = functools.lru_cache(maxsize=64)(self._model_over)

    def _model_over(self, ticks: int) -> Records:
        transition, noise = model(ticks * self._period_s)
        changed = smoothing(ticks * self._period_s, self._hands.still_s)
        return parameters(
            transition=transition, noise=noise, smoothing=changed, still_speed=float(self._hands.still_speed)
        )

    def begin(self, state: Record) -> None:
        """Sets what no sample has reported yet."""
        state["noise_variance"] = self._hands.noise_std_m**2
        state["hand_stillness"] = STILL

    def advance(self, state: Record, ticks: int, stale_ticks: int) -> None:
        """Moves both hands on by some ticks; one that is not seen stands still."""
        _advance_both(as_array(state), stale_ticks, self._model(ticks), self._models, self._period_s)


@compiled
def _update_noise(states: Records, side: int, position: Vector, interval_s: float) -> None:
    """The noise variance after one more sample; samples after a gap are compared with no earlier
    ones.
    """
    state, past = states[0], states[0].past_samples[side]
    count, variance = state.even_samples[side], state.noise_variance[side]
    before_s = state.sample_interval_s[side]
    if count >= 2 and abs(interval_s - before_s) > 0.5 * before_s:
        count = 1
    state.sample_interval_s[side] = interval_s
    if count >= 3:
        square = 0.0
        for axis in range(3):
            third = position[axis] - 3.0 * past[0, axis] + 3.0 * past[1, axis] - past[2, axis]
            square += third * third
        seen = min(square / 60.0, NOISE_OUTLIER_SHARE * variance)
        samples = min(state.noise_samples[side] + 1, NOISE_SAMPLES)
        state.noise_samples[side] = samples
        variance += (seen - variance) / (samples + 1.0)
        state.noise_variance[side] = min(max(variance, LEAST_NOISE_M**2), MAX_NOISE_M**2)
    for axis in range(3):
        past[2, axis] = past[1, axis]
        past[1, axis] = past[0, axis]
        past[0, axis] = position[axis]
    state.even_samples[side] = min(count + 1, 3)


@compiled
def _advance_both(states: Records, stale_ticks: int, one: Records, models: Records, period_s: float) -> None:
    state, over = states[0], one[0]
    state.response_s = _response_s(states, period_s)
    for side in range(2):
        hand = state.hands[side]
        if is_fresh(states, side, stale_ticks):
            advance(state.mode_means[side], state.mode_covariances[side], over.transition, over.noise)
            look_ahead(states, models, side)
        else:
            state.mode_means[side, :, 1:] = 0.0
            hand[1:] = 0.0
        lowpass, stillness = state.hand_velocity_lowpass[side], state.hand_stillness[side]
        state.hand_stillness[side] = stillness_after(hand[1], over.smoothing, over.still_speed, lowpass, stillness)


@compiled
def look_ahead(states: Records, models: Records, side: int) -> None:
    """Into the state's estimate (3, 3) where a hand is by now, by its newest sample."""
    state, estimate = states[0], states[0].hands[side]
    at = slot(states, side, 0)
    means, modes = state.kept_means[side, at], state.kept_probabilities[side, at]
    onward = models[min(state.tick - state.kept_ticks[side, at], len(models) - 1)].onward
    for row in range(3):
        for axis in range(3):
            total = 0.0
            for mode in range(MODES):
                for k in range(3):
                    total += modes[mode] * onward[mode, row, k] * means[mode, k, axis]
            estimate[row, axis] = total


@compiled
def is_fresh(states: Records, side: int, stale_ticks: int) -> bool:
    """Whether a hand has been seen, and lately enough."""
    seen = states[0].hand_ticks[side]
    return bool(seen >= 0 and states[0].tick - seen < stale_ticks)


@compiled
def goes_on(states: Records, side: int, position: Vector, unseen_ticks: int) -> bool:
    """Whether a hand that is seen again may have come there (3,) [m], as the filter has it."""
    state, square = states[0], 0.0
    for axis in range(3):
        square += (position[axis] - state.hands[side, 0, axis]) ** 2
    variance = state.mode_covariances[side, CHANGE, 0, 0] + state.noise_variance[side]
    return bool(is_fresh(states, side, unseen_ticks) and square < REAPPEARED_VARIANCE_SHARE * variance)


@compiled
def _response_s(states: Records, period_s: float) -> float:
    """In which time the filter follows a change of motion, of the hand that its tracker shows worse
    [s]: for a Wiener process of jerk, (noise variance x interval / intensity)^(1/6).
    """
    state, slowest = states[0], 0.0
    for side in range(2):
        more = max(state.kept[side] - 1, 0)  # of them, so that an interval in which one is late counts little
        if more > 0:
            passed = state.kept_ticks[side, slot(states, side, 0)] - state.kept_ticks[side, slot(states, side, more)]
            each_s = min(passed * period_s / more, MAX_LATE_S)
            slowest = max(slowest, state.noise_variance[side] * each_s / MODE_INTENSITIES[CHANGE])
    return float(np.rint(slowest ** (1.0 / 6.0) * ROUND_TO) / ROUND_TO)


@compiled
def turn_to(states: Records, side: int, turn: tuple[float, float, float, float], frame: Vector) -> None:
    """Takes in a quaternion x y z w of a hand, by the tracker's axes in its unit (3, 4)."""
    (x, y, z, w), out = turn, states[0].hand_turns[side]
    s, matrix = 2.0 / (x * x + y * y + z * z + w * w), np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)
    unit = math.sqrt(frame[0, 0] ** 2 + frame[1, 0] ** 2 + frame[2, 0] ** 2)
    out[:] = 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[3 * i + j] += frame[i, k] / unit * matrix[k, j]


@compiled
def seconds_after(stamp_ns: int, other_ns: int) -> float:
    """How much later a stamp is than another one [s], whatever both are."""
    apart_ns = float(stamp_ns) - float(other_ns)
    return 1e-9 * (float(stamp_ns - other_ns) if abs(apart_ns) < MAX_STAMP_DIFFERENCE_NS else apart_ns)


@compiled
def _later_s(states: Records, side: int, quickest: int, stamp_ns: int, period_s: float) -> float:
    """How much later a sample comes than the quickest of this second (0) or the last (1) [s]."""
    state = states[0]
    passed_s = (state.tick - state.quickest_ticks[side, quickest]) * period_s
    return float(passed_s - seconds_after(stamp_ns, state.quickest_stamps_ns[side, quickest]))


@compiled
def ticks_late(states: Records, side: int, stamp_ns: int, period_s: float) -> int:
    """How many whole ticks later a sample comes than the quickest ones; 0 by a clock that is not
    believed.
    """
    if states[0].clock[side] != BELIEVED:
        return 0
    late_s = max(_later_s(states, side, 0, stamp_ns, period_s), _later_s(states, side, 1, stamp_ns, period_s))
    return int(min(max(late_s, 0.0), MAX_LATE_S) / period_s + TICK_ROUNDING)


@compiled
def note_clock(states: Records, side: int, stamp_ns: int, period_s: float, fresh: bool) -> None:
    """Remembers how late a sample came; a clock set back over a silence is another one."""
    state = states[0]
    stamps, ticks = state.quickest_stamps_ns[side], state.quickest_ticks[side]
    known = state.clock_tick[side] >= 0
    if not known or (not fresh and _later_s(states, side, 0, stamp_ns, period_s) > MAX_LATE_S):
        stamps[:], ticks[:] = stamp_ns, state.tick
        state.clock[side], state.clock_tick[side] = LEARNING, state.tick
    elif (state.tick - state.clock_tick[side]) * period_s >= DELAY_WINDOW_S:
        apart_s = _later_s(states, side, 1, stamps[0], period_s) - _later_s(states, side, 0, stamps[0], period_s)
        steady = abs(apart_s) <= DELAY_TOLERANCE_S and state.clock[side] != LEARNING
        state.clock[side] = BELIEVED if steady else DOUBTED
        stamps[1], ticks[1] = stamps[0], ticks[0]
        stamps[0], ticks[0] = stamp_ns, state.tick
        state.clock_tick[side] = state.tick
    elif _later_s(states, side, 0, stamp_ns, period_s) < 0.0:
        stamps[0], ticks[0] = stamp_ns, state.tick


@compiled
def slot(states: Records, side: int, order: int) -> int:
    """Where in its ring a hand's sample is."""
    return int((states[0].kept_newest[side] - order) % KEPT)


@compiled
def order_of(states: Records, side: int, stamp_ns: int) -> int:
    """How many kept samples have a newer stamp than this; -1: one has the same."""
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
    """Filters in a sample (3,) [m] of one hand that is the newest and was made now; with one that
    `restarts`, or of a hand that was not `fresh`, the filter begins anew.
    """
    state, period_s = states[0], parameters[0].period_s
    note_clock(states, side, stamp_ns, period_s, fresh)
    ticks = state.tick - state.kept_ticks[side, slot(states, side, 0)] if state.kept[side] > 0 else -1
    state.kept_newest[side] = (state.kept_newest[side] + 1) % KEPT
    state.kept[side] = min(state.kept[side] + 1, KEPT)
    at = state.kept_newest[side]
    state.kept_stamps_ns[side, at], state.kept_ticks[side, at] = stamp_ns, state.tick
    state.kept_late[side, at], state.kept_restarts[side, at] = 0, restarts
    state.kept_positions[side, at] = position
    filter_in(states, side, at, LONE_SAMPLE_S if ticks < 0 else ticks * period_s, restarts or ticks < 0)
    look_ahead(states, models, side)


@compiled
def filter_in(states: Records, side: int, at: int, interval_s: float, anew: bool) -> None:
    """Filters in a kept sample, with the filter as of when that was made, and keeps it so."""
    state, position = states[0], states[0].kept_positions[side, at]
    means, covariances = state.mode_means[side], state.mode_covariances[side]
    if anew:
        state.even_samples[side] = 0
    _update_noise(states, side, position, interval_s)
    variance, modes = state.noise_variance[side], state.mode_probabilities[side]
    if anew:
        start(means, covariances, modes, variance, position)
    else:
        update(means, covariances, modes, variance, position, interval_s)
    _remember(states, side, at)


@compiled
def _remember(states: Records, side: int, at: int) -> None:
    """Keeps the filter as it is, in all its parts."""
    state = states[0]
    state.kept_means[side, at] = state.mode_means[side]
    state.kept_covariances[side, at] = state.mode_covariances[side]
    state.kept_probabilities[side, at] = state.mode_probabilities[side]
    state.kept_past[side, at] = state.past_samples[side]
    noise = state.kept_noise[side, at]
    noise[0], noise[1] = state.noise_variance[side], state.noise_samples[side]
    noise[2], noise[3] = state.even_samples[side], state.sample_interval_s[side]
