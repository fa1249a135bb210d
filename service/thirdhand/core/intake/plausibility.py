"""Plausibility of samples, compared with earlier ones: stamps, jumps, swapped hands, and a second
source that contradicts the first. The rules are the same for both hands and for the arm:

* A stamp differs from the newest one. It is at most MAX_LATE_S older than the newest one (the arm's
  stamps must increase), and is ahead of it by at most the time since the newest sample arrived plus
  the time after which the source is silent. Silence is judged by arrival; after a silence, any
  stamp but the newest one is accepted.
* A sample has jumped if the hand or arm cannot have moved there since its newest sample. A hand's
  jump is accepted once CONFIRMED_SAMPLES successive samples, over at least confirmed_s, agree with
  each other. A jump of the arm is accepted only after a silence, because an arm cannot jump.
* A hand that appears where the other hand was, while that one is no longer seen there, is taken for
  the other one: the tracker has swapped them. The new position is accepted after `swapped_s`,
  within which the tracker may correct itself.
* A source is contested when more than CONTESTED_ON_SHARE of its samples within about
  TRACKER_MEMORY_S contradict the others, until the share is below CONTESTED_OFF_SHARE. For the
  arm, these are samples that jumped. For a hand, they alternate between two positions, or they
  jumped by the same offset as the last one that jumped, with accepted samples between them; the
  jumps of a single tracker do not repeat an offset. A hand is also contested while its samples
  scatter more than those of any tracker, as do samples of two trackers whose positions differ by
  some centimetres.
"""

from __future__ import annotations

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import ALTERNATIONS, SECOND_NEWEST, THIRD_NEWEST
from thirdhand.core.frame import Records, Vector
from thirdhand.core.intake import CONFIRMED_SAMPLES
from thirdhand.core.intake.hand_estimator import slot
from thirdhand.core.vectors import distance, squared_distance


@compiled
def is_of_another(states: Records, parameters: Records, side: int, position: Vector, expected: Vector) -> bool:
    """True if a hand's sample (3,) [m] that jumped comes from a second source; records the jump.

    Its offset from the `expected` position (3,) must equal that of the last sample that jumped,
    within `jump`, and that sample must be less than `stale_ticks` old. Between the two, a sample
    was accepted; in a row of successive jumps, the decision about the first one holds for all.
    """
    state, config, offset = states[0], parameters[0], position - expected
    passed = state.tick - state.other_tick[side]
    far = distance(offset, state.other_offset[side]) > config.jump_m
    in_row = state.other_after_ns[side] == state.hand_stamps_ns[side]
    returns = passed < config.stale_ticks and not far and (not in_row or state.other_returns[side] > 0)
    state.other_tick[side], state.other_after_ns[side] = state.tick, state.hand_stamps_ns[side]
    state.other_offset[side, :], state.other_returns[side] = offset, returns
    return bool(returns)


@compiled
def is_swapped(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a hand's sample (3,) [m] is rejected as the other hand's. It is the first one after a
    silence, or follows samples that were rejected as swapped.

    After a silence shorter than `swapped_s`, the sample is the other hand's if it is where that one
    was (`_is_at_other`). Later samples that continue it are rejected until `swapped_s` has passed.
    """
    state, config = states[0], parameters[0]
    is_swap, seen = state.jump_is_swap[side], state.hand_ticks[side]
    if is_swap and (state.tick - state.jump_first_tick[side]) * config.period_s >= config.swapped_s:
        return False
    if is_swap and _goes_on(states, parameters, side, position):
        return True
    silent = state.tick - seen
    lately = config.stale_ticks <= silent and silent * config.period_s < config.swapped_s
    return bool(seen >= 0 and lately and _is_at_other(states, parameters, side, position))


@compiled
def is_confirmed(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if the jump of a hand to a position (3,) [m] is accepted; counts successive samples that
    agree.

    Accepted are at least CONFIRMED_SAMPLES samples that agree over confirmed_s; over `swapped_s` if
    the hand jumped to where the other one was, and that one has not been seen since.
    """
    state, config = states[0], parameters[0]
    if state.jump_count[side] == 0 or not _goes_on(states, parameters, side, position):
        state.jump_first_tick[side], state.jump_count[side], state.jump_is_swap[side] = state.tick, 0, 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    first, count = state.jump_first_tick[side], state.jump_count[side]
    unseen = state.hand_ticks[1 - side] < first
    if count > 1 and unseen and _is_at_other(states, parameters, side, position):
        state.jump_is_swap[side] = 1
    enough_s = config.swapped_s if state.jump_is_swap[side] else config.confirmed_s
    return bool(count >= CONFIRMED_SAMPLES and (state.tick - first + 0.5) * config.period_s >= enough_s)


@compiled
def _is_at_other(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a hand's sample (3,) [m] is near the other hand's estimate, and nearer to it than
    half the distance between the hands.

    Near is where the other hand may have moved since it was seen: within jump + jump_speed *
    elapsed time, at most `swapped_s`.
    """
    state, config = states[0], parameters[0]
    seen = state.hand_ticks[1 - side]
    here, there = state.hands[side, 0], state.hands[1 - side, 0]
    near = config.jump_m + config.jump_speed_mps * min((state.tick - seen) * config.period_s, config.swapped_s)
    return bool(seen >= 0 and distance(position, there) < min(near, 0.5 * distance(here, there)))


@compiled
def _goes_on(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a sample (3,) [m] agrees with the newest sample that jumped: it is less than
    `stale_ticks` later and within jump + jump_speed * elapsed time.
    """
    state, config = states[0], parameters[0]
    passed = state.tick - state.jump_newest_tick[side]
    near = distance(position, state.jumped_to[side]) <= config.jump_m + config.jump_speed_mps * passed * config.period_s
    return bool(passed < config.stale_ticks and near)


@compiled
def _returns(states: Records, parameters: Records, side: int, order: int, offset: Vector) -> bool:
    """True if an earlier sample deviated by about the same `offset` (3,) [m] from its neighbours.

    The retained samples from number `order` + 2 on are checked; the one before is a neighbour of
    the new deviation. The deviation of a sample is x_k - (x_(k-1) + x_(k+1)) / 2; it may differ
    from the offset by source_spread_share |offset|. A second source repeats its offset, the
    outliers of one tracker do not.
    """
    state, around = states[0], np.empty((3, 3))
    for before in range(order + 2, state.kept[side] - 1):
        for k in range(3):
            around[k] = state.kept_positions[side, slot(states, side, before - 1 + k)]
        off = around[1] - 0.5 * (around[0] + around[2])
        if distance(off, offset) <= parameters[0].source_spread_share * distance(offset, np.zeros(3)):
            return True
    return False


@compiled
def is_to_and_fro(states: Records, parameters: Records, side: int, order: int, position: Vector) -> bool:
    """True if four samples alternate between two positions: a new one (3,) [m], and the three
    before it, whose newest has number `order`. Their intervals may be uneven.

    For one of the ALTERNATIONS, which assign the samples to two sources, samples of different
    sources are at least sources_apart_m apart, and those of one source differ by at most
    source_spread_share of the smallest distance between the sources. A pattern with one sample of
    the second source also requires that this source was seen before (`_returns`).
    """
    config, samples = parameters[0], np.empty((4, 3))
    samples[0], samples[1:] = position, states[0].kept_past[side, slot(states, side, order)]
    for sources in ALTERNATIONS:
        within, apart = 0.0, np.inf
        for i in range(4):
            for j in range(i):
                between = squared_distance(samples[i], samples[j])
                if (sources >> i) & 1 == (sources >> j) & 1:
                    within = max(within, between)
                else:
                    apart = min(apart, between)
        if apart >= config.sources_apart_m**2 and within <= config.source_spread_share**2 * apart:
            # index of the second source's only sample; 0 if it has two
            odd = 1 if sources == SECOND_NEWEST else 2 if sources == THIRD_NEWEST else 0
            return odd == 0 or _returns(states, parameters, side, order + odd - 1, samples[odd] - samples[0])
    return False
