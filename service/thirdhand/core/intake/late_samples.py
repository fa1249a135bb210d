"""Late and overtaken samples of a hand: the tick in which each was made, and their filtering at
that tick.

A tracker's clock is that of another machine, so its stamps only show how much longer the delay of
one sample is than that of another. Samples with the minimum delay of the last one to two seconds
are taken to be made when they arrive; a sample with a longer delay was made earlier by the
difference. A tracker's clock is trusted while the minimum delays of consecutive seconds agree.
While it is not trusted, samples are taken to be made when they arrive. Samples that overtook each
other are always put in the order of their stamps.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import TRUSTED
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.intake import MODES, SETTLED_SAMPLES
from thirdhand.core.intake.hand_estimator import (
    filter_in,
    insert,
    model_over,
    seconds_after,
    slot,
)
from thirdhand.core.intake.mode_filter import advance
from thirdhand.core.intake.motion_model import CHANGE
from thirdhand.core.numerics import TICK_ROUNDING
from thirdhand.core.vectors import squared_distance


@compiled
def order_of(state: Struct, side: int, stamp_ns: int) -> int:
    """Number of retained samples with a newer stamp than this; -1 if one has the same stamp."""
    for order in range(state.kept[side]):
        kept_ns = state.kept_stamps_ns[side, slot(state, side, order)]
        if kept_ns <= stamp_ns:
            return -1 if kept_ns == stamp_ns else order
    return int(state.kept[side])


@compiled
def tick_made(
    state: Struct, side: int, stamp_ns: int, order: int, late: int, period_s: float
) -> int:
    """Tick in which a sample of this `order` was made, between the ticks of its neighbours by
    stamp.

    It is the current tick minus `late`. For a sample that was overtaken (`order` > 0) by a clock
    that is not trusted, it is the newest sample's tick minus the difference of the stamps.
    """
    tick = state.tick - late
    if order > 0:
        behind = slot(state, side, order - 1)
        if state.clock[side] != TRUSTED:
            passed_s = seconds_after(state.kept_stamps_ns[side, slot(state, side, 0)], stamp_ns)
            tick = state.kept_ticks[side, slot(state, side, 0)] - int(
                passed_s / period_s + TICK_ROUNDING
            )
        tick = min(tick, state.kept_ticks[side, behind])
    if order < state.kept[side]:
        tick = max(tick, state.kept_ticks[side, slot(state, side, order)])
    return int(tick)


@compiled
def expected(state: Struct, models: Records, side: int, order: int, tick: int) -> Vector:
    """Predicted position (3,) [m] of a hand at a tick, p = Σ_j μ_j F_j[0, :3] m_j.

    μ_j, m_j are probability and mean of mode j after retained sample number `order`, F_j is the
    transition since then. For a sample older than all retained ones, p is the oldest one's
    position.
    """
    out = np.zeros(3)
    if order == state.kept[side]:
        out[:] = state.kept_positions[side, slot(state, side, order - 1)]
    else:
        index = slot(state, side, order)
        over = model_over(models, tick - state.kept_ticks[side, index])
        for mode in range(MODES):
            mean = state.kept_means[side, index, mode]
            for row in range(3):
                out += (
                    state.kept_probabilities[side, index, mode]
                    * over.transition[mode, 0, row]
                    * mean[row]
                )
    return out


@compiled
def _fits(
    state: Struct,
    config: Struct,
    models: Records,
    side: int,
    order: int,
    tick: int,
    position: Vector,
) -> bool:
    """True if a sample x (3,) [m] made at a tick fits a hand's filter as it was after the retained
    sample of this `order`:

        |x - p|² < jump_noise_stds² (P + r)

    p is the expected position then, P its variance in the mode CHANGE, r the noise variance.
    """
    index = slot(state, side, order)
    over = model_over(models, tick - state.kept_ticks[side, index])
    weights = over.transition[CHANGE, 0]
    before = state.kept_covariances[side, index, CHANGE]
    variance = 0.0
    for row in range(3):
        for column in range(3):
            variance += weights[row] * before[row, column] * weights[column]
    variance += over.noise[CHANGE, 0, 0] + state.kept_noise[side, index, 0]
    most_m2 = config.jump_noise_stds**2 * variance
    expected_m = expected(state, models, side, order, tick)
    return bool(squared_distance(position, expected_m) < most_m2)


@compiled
def wrong_samples(
    state: Struct, config: Struct, models: Records, side: int, tick: int, position: Vector
) -> int:
    """Number of the newest retained samples that a sample (3,) [m], which jumped and was made at
    `tick`, shows to be wrong; 0 if none are.

    It is the least number n, at most SETTLED_SAMPLES, for which the filter as it was before these n
    samples fits the new sample, and none of the n. Samples since a confirmed jump are not wrong.
    """
    for order in range(1, min(SETTLED_SAMPLES + 1, state.kept[side])):
        newest = slot(state, side, order - 1)
        if state.kept_restarts[side, newest] > 0:
            return 0
        wrong = _fits(state, config, models, side, order, tick, position)
        for newer in range(order):
            index = slot(state, side, newer)
            made_tick = state.kept_ticks[side, index]
            sample = state.kept_positions[side, index]
            wrong = wrong and not _fits(state, config, models, side, order, made_tick, sample)
        if wrong:
            return order
    return 0


@compiled
def drop(state: Struct, side: int, count: int) -> None:
    """Drop the newest retained samples of a hand; `take_late` then restores the filter as it was
    before them. No noise variance is computed from them.
    """
    state.kept_newest[side], state.kept[side] = slot(state, side, count), state.kept[side] - count
    state.kept_noise[side, slot(state, side, 0), 2] = 0.0


@compiled
def take_late(
    state: Struct,
    config: Struct,
    models: Records,
    side: int,
    stamp_ns: int,
    tick: int,
    position: Vector,
    restarts: bool,
) -> None:
    """Filter a sample (3,) [m] of one hand at the tick in which it was made.

    The filter is restored to its state after the next older sample. The new sample and all newer
    ones are then filtered in the order of their stamps, and the filter is advanced to the current
    tick. If the sample `restarts` the filter (a confirmed jump), it starts from this sample alone.
    """
    order = order_of(state, side, stamp_ns)

    # the filter as it was after the next older sample; the oldest sample starts it anew
    count = state.kept[side]
    if count > 0:
        _recall(state, side, slot(state, side, min(order, count - 1)))
    insert(state, side, order, stamp_ns, tick, position, restarts)

    for newer in range(order, -1, -1):
        index = slot(state, side, newer)
        ticks = -1
        if newer < count:
            older_tick = state.kept_ticks[side, slot(state, side, newer + 1)]
            ticks = state.kept_ticks[side, index] - older_tick
            _advance_by(state, models, side, ticks)
        filter_in(state, config, side, index, ticks)
    _advance_by(state, models, side, state.tick - state.kept_ticks[side, slot(state, side, 0)])


@compiled
def _advance_by(state: Struct, models: Records, side: int, ticks: int) -> None:
    """Advance all modes of one hand by some ticks; 0 ticks change nothing."""
    if ticks > 0:
        advance(state, side, model_over(models, ticks))


@compiled
def _recall(state: Struct, side: int, at: int) -> None:
    """Restore one hand's filter to the state stored at ring index `at`."""
    noise = state.kept_noise[side, at]
    state.mode_means[side] = state.kept_means[side, at]
    state.mode_covariances[side] = state.kept_covariances[side, at]
    state.mode_probabilities[side] = state.kept_probabilities[side, at]
    state.past_samples[side] = state.kept_past[side, at]
    state.noise_variance[side] = noise[0]
    state.noise_samples[side] = int(noise[1])
    state.even_samples[side] = int(noise[2])
    state.sample_interval_s[side] = noise[3]
