"""When a hand's sample was made, by its stamp: in which tick, and between which of those before it.

A tracker's clock is another machine's, so its stamps tell how much later one sample comes than
another. The quickest of the last one to two seconds were made when they came; one that comes later
than these was made as much earlier. A clock is gone by while the quickest of each second are of one
mind; that of no other is known, and its samples are made when they come. Of samples that overtook
each other the stamps' order counts, whatever the clock.

The newest `KEPT` samples of each hand are kept in rings; `order` counts back from the newest, 0.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Record, Records, Vector
from service.core.intake import KEPT
from service.core.intake.hand_estimator import BELIEVED, filter_in, look_ahead, order_of, seconds_after, slot
from service.core.intake.mode_filter import advance
from service.core.intake.tuning import LONE_SAMPLE_S, TICK_ROUNDING


@compiled
def tick_made(states: Records, side: int, stamp_ns: int, order: int, late: int, period_s: float) -> int:
    """The tick as of which a sample of this order is to be taken: not before the one before it, nor
    after the one behind it.
    """
    state = states[0]
    tick = state.tick - late
    if order > 0:
        behind = slot(states, side, order - 1)
        if state.clock[side] != BELIEVED:
            passed_s = seconds_after(state.kept_stamps_ns[side, slot(states, side, 0)], stamp_ns)
            tick = state.kept_ticks[side, slot(states, side, 0)] - int(passed_s / period_s + TICK_ROUNDING)
        tick = min(tick, state.kept_ticks[side, behind])
    if order < state.kept[side]:
        tick = max(tick, state.kept_ticks[side, slot(states, side, order)])
    return int(tick)


@compiled
def expected(states: Records, models: Records, side: int, order: int, tick: int, out: Vector) -> None:
    """Where a hand was in a tick (3,) [m], by the samples up to one of this order; before the first
    of all, where that was.
    """
    state = states[0]
    if order == 0 and tick == state.tick:
        out[:] = state.hands[side, 0]
    elif order == state.kept[side]:
        out[:] = state.kept_positions[side, slot(states, side, order - 1)]
    else:
        at = slot(states, side, order)
        means, modes = state.kept_means[side, at], state.kept_probabilities[side, at]
        over = models[min(tick - state.kept_ticks[side, at], len(models) - 1)].transition
        for axis in range(3):
            total = 0.0
            for mode in range(len(modes)):
                for row in range(3):
                    total += modes[mode] * over[mode, 0, row] * means[mode, row, axis]
            out[axis] = total


@compiled
def insert(states: Records, side: int, order: int, stamp_ns: int, tick: int, position: Vector, restarts: bool) -> None:
    """Keeps a sample (3,) [m] among the others; with one that `restarts` the filter begins anew."""
    state = states[0]
    state.kept_newest[side] = (state.kept_newest[side] + 1) % KEPT
    state.kept[side] = min(state.kept[side] + 1, KEPT)
    for newer in range(order):
        to, of = slot(states, side, newer), slot(states, side, newer + 1)
        state.kept_stamps_ns[side, to] = state.kept_stamps_ns[side, of]
        state.kept_ticks[side, to] = state.kept_ticks[side, of]
        state.kept_late[side, to] = state.kept_late[side, of]
        state.kept_restarts[side, to] = state.kept_restarts[side, of]
        state.kept_positions[side, to] = state.kept_positions[side, of]
    at = slot(states, side, order)
    state.kept_stamps_ns[side, at], state.kept_ticks[side, at] = stamp_ns, tick
    state.kept_late[side, at], state.kept_restarts[side, at] = state.tick - tick, restarts
    state.kept_positions[side, at] = position


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
    """Filters in a sample (3,) [m] of one hand as of the tick in which it was made, and again all
    that are newer. Those before one that `restarts` count no more.
    """
    state, given = states[0], parameters[0]
    order, kept = order_of(states, side, stamp_ns), state.kept[side]
    means, covariances = state.mode_means[side], state.mode_covariances[side]
    if kept > 0:
        _recall(states, side, slot(states, side, min(order, kept - 1)))
    first = order == kept
    insert(states, side, order, stamp_ns, tick, position, restarts)
    for newer in range(order, -1, -1):
        at = slot(states, side, newer)
        first = first and newer == order
        ticks = 0 if first else state.kept_ticks[side, at] - state.kept_ticks[side, slot(states, side, newer + 1)]
        anew = first or state.kept_restarts[side, at] > 0
        if not anew:
            _move_on(means, covariances, models, ticks)
        filter_in(states, side, at, LONE_SAMPLE_S if first else ticks * given.period_s, anew)
    ticks = state.tick - state.kept_ticks[side, slot(states, side, 0)]
    _move_on(means, covariances, models, ticks)
    look_ahead(states, models, side)


@compiled
def _move_on(means: Vector, covariances: Vector, models: Records, ticks: int) -> None:
    if ticks > 0:
        over = models[min(ticks, len(models) - 1)]
        advance(means, covariances, over.transition, over.noise)


@compiled
def _recall(states: Records, side: int, at: int) -> None:
    """The filter as it was kept."""
    state, noise = states[0], states[0].kept_noise[side, at]
    state.mode_means[side] = state.kept_means[side, at]
    state.mode_covariances[side] = state.kept_covariances[side, at]
    state.mode_probabilities[side] = state.kept_probabilities[side, at]
    state.past_samples[side] = state.kept_past[side, at]
    state.noise_variance[side], state.noise_samples[side] = noise[0], int(noise[1])
    state.even_samples[side], state.sample_interval_s[side] = int(noise[2]), noise[3]


def lateness_ms(state: Record, side: int, period_s: float) -> tuple[float, float] | None:
    """How much later than the quickest a hand's newest samples came, mean and 95 % [ms]; None:
    nobody knows.
    """
    if state["clock"][side] != BELIEVED or not state["kept"][side]:
        return None
    newest = (int(state["kept_newest"][side]) - np.arange(int(state["kept"][side]))) % KEPT
    late_ms = 1e3 * period_s * state["kept_late"][side][newest]
    return float(np.mean(late_ms)), float(np.percentile(late_ms, 95))
