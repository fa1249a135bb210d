"""Late and overtaken samples of a hand: the tick in which each was made, and their filtering at
that tick.

A tracker's clock is that of another machine, so its stamps only show how much longer the delay of
one sample is than that of another. Samples with the minimum delay of the last one to two seconds
are taken to be made when they arrive; a sample with a longer delay was made earlier by the
difference. A tracker's clock is trusted while the minimum delays of consecutive seconds agree.
While it is not trusted, samples are taken to be made when they arrive. Samples that overtook each
other are always put in the order of their stamps.

The newest KEPT samples of each hand are retained in rings, each with the state of the filter after
it. `order` counts them backward from the newest, which is 0.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import TRUSTED
from thirdhand.core.frame import Record, Records, Vector
from thirdhand.core.intake import KEPT, SETTLED_SAMPLES
from thirdhand.core.intake.hand_estimator import (
    advance_hand,
    estimate,
    filter_in,
    order_of,
    seconds_after,
    settle,
    slot,
)
from thirdhand.core.intake.motion_model import CHANGE
from thirdhand.core.numerics import TICK_ROUNDING
from thirdhand.core.vectors import squared_distance


@compiled
def tick_made(
    states: Records, side: int, stamp_ns: int, order: int, late: int, period_s: float
) -> int:
    """Tick in which a sample of this `order` was made, between the ticks of its neighbours by
    stamp.

    It is the current tick minus `late`. For a sample that was overtaken (`order` > 0) by a clock
    that is not trusted, it is the newest sample's tick minus the difference of the stamps.
    """
    state = states[0]
    tick = state.tick - late
    if order > 0:
        behind = slot(states, side, order - 1)
        if state.clock[side] != TRUSTED:
            passed_s = seconds_after(state.kept_stamps_ns[side, slot(states, side, 0)], stamp_ns)
            tick = state.kept_ticks[side, slot(states, side, 0)] - int(
                passed_s / period_s + TICK_ROUNDING
            )
        tick = min(tick, state.kept_ticks[side, behind])
    if order < state.kept[side]:
        tick = max(tick, state.kept_ticks[side, slot(states, side, order)])
    return int(tick)


@compiled
def expected(
    states: Records, models: Records, side: int, order: int, tick: int, out: Vector
) -> None:
    """Predicted position of a hand at a tick, p = Σ_j μ_j F_j[0, :3] m_j, written to `out` (3,)
    [m].

    μ_j, m_j are probability and mean of mode j after retained sample number `order`, F_j is the
    transition since then. For a sample older than all retained ones, p is the oldest one's
    position.
    """
    state = states[0]
    if order == 0 and tick == state.tick:
        out[:] = state.hands[side, 0]
    elif order == state.kept[side]:
        out[:] = state.kept_positions[side, slot(states, side, order - 1)]
    else:
        index = slot(states, side, order)
        means = state.kept_means[side, index]
        modes = state.kept_probabilities[side, index]
        over = models[min(tick - state.kept_ticks[side, index], len(models) - 1)].transition
        for axis in range(3):
            total = 0.0
            for mode in range(len(modes)):
                for row in range(3):
                    total += modes[mode] * over[mode, 0, row] * means[mode, row, axis]
            out[axis] = total


@compiled
def _fits(
    states: Records,
    parameters: Records,
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
    state = states[0]
    index = slot(states, side, order)
    expected_m = np.empty(3)
    variance = 0.0
    before = state.kept_covariances[side, index, CHANGE]
    over = models[min(tick - state.kept_ticks[side, index], len(models) - 1)]
    expected(states, models, side, order, tick, expected_m)
    for row in range(3):
        for column in range(3):
            variance += (
                over.transition[CHANGE, 0, row]
                * before[row, column]
                * over.transition[CHANGE, 0, column]
            )
    variance += over.noise[CHANGE, 0, 0] + state.kept_noise[side, index, 0]
    most_m2 = parameters[0].jump_noise_stds ** 2 * variance
    return bool(squared_distance(position, expected_m) < most_m2)


@compiled
def wrong_samples(
    states: Records, parameters: Records, models: Records, side: int, tick: int, position: Vector
) -> int:
    """Number of the newest retained samples that a sample (3,) [m], which jumped and was made at
    `tick`, shows to be wrong; 0 if none are.

    It is the least number n, at most SETTLED_SAMPLES, for which the filter as it was before these n
    samples fits the new sample, and none of the n. Samples since a confirmed jump are not wrong.
    """
    state = states[0]
    for order in range(1, min(SETTLED_SAMPLES + 1, state.kept[side])):
        newest = slot(states, side, order - 1)
        if state.kept_restarts[side, newest] > 0:
            return 0
        wrong = _fits(states, parameters, models, side, order, tick, position)
        for newer in range(order):
            index = slot(states, side, newer)
            made_tick = state.kept_ticks[side, index]
            sample = state.kept_positions[side, index]
            wrong = wrong and not _fits(states, parameters, models, side, order, made_tick, sample)
        if wrong:
            return order
    return 0


@compiled
def drop(states: Records, side: int, count: int) -> None:
    """Drop the newest retained samples of a hand; `take_late` then restores the filter as it was
    before them. No noise variance is computed from them.
    """
    state = states[0]
    state.kept_newest[side], state.kept[side] = slot(states, side, count), state.kept[side] - count
    state.kept_noise[side, slot(states, side, 0), 2] = 0.0


@compiled
def insert(
    states: Records,
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
    state = states[0]
    state.kept_newest[side] = (state.kept_newest[side] + 1) % KEPT
    state.kept[side] = min(state.kept[side] + 1, KEPT)
    for newer in range(order):
        new = slot(states, side, newer)
        old = slot(states, side, newer + 1)
        state.kept_stamps_ns[side, new] = state.kept_stamps_ns[side, old]
        state.kept_ticks[side, new] = state.kept_ticks[side, old]
        state.kept_late[side, new] = state.kept_late[side, old]
        state.kept_restarts[side, new] = state.kept_restarts[side, old]
        state.kept_positions[side, new] = state.kept_positions[side, old]
    index = slot(states, side, order)
    state.kept_stamps_ns[side, index] = stamp_ns
    state.kept_ticks[side, index] = tick
    state.kept_late[side, index] = state.tick - tick
    state.kept_restarts[side, index] = restarts
    state.kept_positions[side, index] = position


@compiled
def take_late(
    states: Records,
    parameters: Records,
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
    state = states[0]
    config = parameters[0]
    order = order_of(states, side, stamp_ns)
    count = state.kept[side]

    # the filter as it was after the next older sample; the oldest sample starts it anew
    if count > 0:
        _recall(states, side, slot(states, side, min(order, count - 1)))
    is_oldest = order == count
    insert(states, side, order, stamp_ns, tick, position, restarts)

    for newer in range(order, -1, -1):
        index = slot(states, side, newer)
        is_oldest = is_oldest and newer == order
        ticks = (
            0
            if is_oldest
            else state.kept_ticks[side, index]
            - state.kept_ticks[side, slot(states, side, newer + 1)]
        )
        anew = is_oldest or state.kept_restarts[side, index] > 0
        if not anew:
            _advance_by(states, models, side, ticks)
        filter_in(
            states,
            parameters,
            side,
            index,
            config.tracker_memory_s if is_oldest else ticks * config.period_s,
            anew,
        )

    ticks = state.tick - state.kept_ticks[side, slot(states, side, 0)]
    _advance_by(states, models, side, ticks)
    settle(states, parameters, models, side)
    estimate(states, parameters, models, side)


@compiled
def _advance_by(states: Records, models: Records, side: int, ticks: int) -> None:
    """Advance all modes of one hand by some ticks; 0 ticks change nothing."""
    if ticks > 0:
        index = min(ticks, len(models) - 1)
        advance_hand(states, side, models[index : index + 1])


@compiled
def _recall(states: Records, side: int, at: int) -> None:
    """Restore one hand's filter to the state stored at ring index `at`."""
    state = states[0]
    noise = states[0].kept_noise[side, at]
    state.mode_means[side] = state.kept_means[side, at]
    state.mode_covariances[side] = state.kept_covariances[side, at]
    state.mode_probabilities[side] = state.kept_probabilities[side, at]
    state.past_samples[side] = state.kept_past[side, at]
    state.noise_variance[side] = noise[0]
    state.noise_samples[side] = int(noise[1])
    state.even_samples[side] = int(noise[2])
    state.sample_interval_s[side] = noise[3]


def lateness_ms(state: Record, side: int, period_s: float) -> tuple[float, float] | None:
    """Delay of a hand's retained samples above the minimum delay, mean and 95th percentile [ms];
    None while the tracker's clock is not trusted.
    """
    if state["clock"][side] != TRUSTED or not state["kept"][side]:
        return None
    newest = (int(state["kept_newest"][side]) - np.arange(int(state["kept"][side]))) % KEPT
    late_ms = 1e3 * period_s * state["kept_late"][side][newest]
    return float(np.mean(late_ms)), float(np.percentile(late_ms, 95))
