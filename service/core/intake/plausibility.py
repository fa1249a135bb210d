"""What a source tells, against what it told before: stamps, jumps, and a second source that
contradicts it. One rule for both hands and the arm:

* A stamp must be another than those before, no older than the newest by more than `LATE_S` (the
  arm's, newer than that), and no farther ahead of it than the time since then plus the time after
  which the source is silent. Silence is judged by arrival; after it any stamp is taken, but the
  same again.
* Where a sample cannot come from what was known it has jumped. A hand's jump is believed once
  `CONFIRMED` samples in a row, over `CONFIRMED_S` at least, agree with each other; the arm's never,
  before it was silent: it has a body.
* A hand that comes to where the other one was, which is not seen there any more, has not moved: its
  tracker takes one for the other. That is believed after `hands.swapped_s`, as it may have put
  itself right.
* A source is contested from when a quarter of what it told within about a second contradicts the
  rest, until that is less than a tenth. The arm's contradict that jumped; a hand's, that go to and
  fro between two places, or jumped as far and the same way as the last that did, with others
  between: one tracker's jumps do not go on from each other. It is also contested while a hand's
  samples scatter more than any tracker's, as those of two that are some centimetres apart do.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Records, Vector
from service.core.intake.hand_estimator import slot
from service.core.intake.tuning import (
    AGREE_M,
    AGREE_MPS,
    CONFIRMED_S,
    CONFIRMED_SAMPLES,
    OFFSET_CHANGE_MPS,
    OFFSET_TOLERANCE_M,
    RETURN_SAMPLES,
    SOURCE_SPREAD_SHARE,
    SOURCES_APART_M,
    SWAPPED_M,
    SWAPPED_MPS,
    TO_AND_FRO_PATTERNS,
)


@compiled
def is_of_another(states: Records, parameters: Records, side: int, position: Vector, expected: Vector) -> bool:
    """Whether a hand's sample (3,) [m] that jumped is one more of another source: where it was
    `expected`, samples came since the last one that jumped, which was as far from them. Those that
    jump in a row are of one kind.
    """
    state, given, offset = states[0], parameters[0], position - expected
    passed = state.tick - state.other_tick[side]
    far = _distance(offset, state.other_offset[side]) > OFFSET_TOLERANCE_M + OFFSET_CHANGE_MPS * passed * given.period_s
    in_row = state.other_after_ns[side] == state.hand_stamps_ns[side]
    returns = passed < given.stale_ticks and not far and (not in_row or state.other_returns[side] > 0)
    state.other_tick[side], state.other_after_ns[side] = state.tick, state.hand_stamps_ns[side]
    state.other_offset[side, :], state.other_returns[side] = offset, returns
    return bool(returns)


@compiled
def is_swapped(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample (3,) [m], the first after a silence, is the other hand's, or goes on
    from samples that were.
    """
    state, given = states[0], parameters[0]
    is_swap, seen = state.jump_is_swap[side], state.hand_ticks[side]
    if is_swap and (state.tick - state.jump_first_tick[side]) * given.period_s >= given.swapped_s:
        return False
    if is_swap and _goes_on(states, parameters, side, position):
        return True
    silent = state.tick - seen
    lately = given.stale_ticks <= silent and silent * given.period_s < given.swapped_s
    return bool(seen >= 0 and lately and _is_at_other(states, parameters, side, position))


@compiled
def is_confirmed(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample (3,) [m] that jumped is to be believed, by those just before it."""
    state, given = states[0], parameters[0]
    if state.jump_count[side] == 0 or not _goes_on(states, parameters, side, position):
        state.jump_first_tick[side], state.jump_count[side], state.jump_is_swap[side] = state.tick, 0, 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    first, count = state.jump_first_tick[side], state.jump_count[side]
    unseen = state.hand_ticks[1 - side] < first
    if count > 1 and unseen and _is_at_other(states, parameters, side, position):
        state.jump_is_swap[side] = 1
    enough_s = given.swapped_s if state.jump_is_swap[side] else CONFIRMED_S
    return bool(count >= CONFIRMED_SAMPLES and (state.tick - first + 0.5) * given.period_s >= enough_s)


@compiled
def _is_at_other(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a hand's sample is where the other hand was, and not where this one was."""
    state, given = states[0], parameters[0]
    seen = state.hand_ticks[1 - side]
    here, there = state.hands[side, 0], state.hands[1 - side, 0]
    near = SWAPPED_M + SWAPPED_MPS * min((state.tick - seen) * given.period_s, given.swapped_s)
    return bool(seen >= 0 and _distance(position, there) < min(near, 0.5 * _distance(here, there)))


@compiled
def _goes_on(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """Whether a sample is where a hand can be that was at the newest one that jumped."""
    state, given = states[0], parameters[0]
    passed = state.tick - state.jump_newest_tick[side]
    near = _distance(position, state.jumped_to[side]) <= AGREE_M + AGREE_MPS * passed * given.period_s
    return bool(passed < given.stale_ticks and near)


@compiled
def _distance(a: Vector, b: Vector) -> float:
    square = 0.0
    for axis in range(3):
        square += (a[axis] - b[axis]) ** 2
    return math.sqrt(square)


@compiled
def _returns(states: Records, side: int, order: int, offset: Vector) -> bool:
    """Whether lately, before one of this order, another sample was so far (3,) [m] from those
    around it: a second source is there again, where one tracker's mistake is another each time.
    """
    state, around = states[0], np.empty((3, 3))
    for before in range(order + 2, min(order + RETURN_SAMPLES, state.kept[side] - 1)):
        for k in range(3):
            around[k] = state.kept_positions[side, slot(states, side, before - 1 + k)]
        off = around[1] - 0.5 * (around[0] + around[2])
        if _distance(off, offset) <= SOURCE_SPREAD_SHARE * _distance(offset, np.zeros(3)):
            return True
    return False


@compiled
def is_to_and_fro(states: Records, side: int, order: int, position: Vector) -> bool:
    """Whether a sample (3,) [m], and the three before it, whose newest is of this order, go to and
    fro between two places, however uneven their intervals.
    """
    samples = np.empty((4, 3))
    samples[0], samples[1:] = position, states[0].kept_past[side, slot(states, side, order)]
    for places in TO_AND_FRO_PATTERNS:
        within, apart = 0.0, np.inf
        for i in range(4):
            for j in range(i):
                square = 0.0
                for axis in range(3):
                    square += (samples[i, axis] - samples[j, axis]) ** 2
                if (places >> i) & 1 == (places >> j) & 1:
                    within = max(within, square)
                else:
                    apart = min(apart, square)
        if apart >= SOURCES_APART_M**2 and within <= SOURCE_SPREAD_SHARE**2 * apart:
            odd = 1 if places == 0b0010 else 2 if places == 0b0100 else 0  # that alone is elsewhere
            return odd == 0 or _returns(states, side, order + odd - 1, samples[odd] - samples[0])
    return False
