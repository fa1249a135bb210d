"""What a source tells, against what it told before: stamps, jumps, and a second source that
contradicts it. One rule for both hands and the arm:

* A stamp must be newer than the newest one, and no farther ahead of it than the time since then
  plus the time after which the source is silent. Silence is judged by arrival; after it any stamp
  is taken, but the same again.
* Where a sample cannot come from what was known it has jumped. A hand's jump is believed once
  `CONFIRMED` samples in a row, over `CONFIRMED_S` at least, agree with each other; the arm's never,
  before it was silent: it has a body.
* A hand that comes to where the other one was, which is not seen there any more, has not moved: its
  tracker takes one for the other. That is believed after `SWAPPED_S`, as it may have put itself
  right.
* A source is contested from when a quarter of what it told within about a second had jumped, until
  that is less than a tenth; and while a hand's samples scatter more than any tracker's, as those of
  two that are some centimetres apart do.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.contract.records import Cause
from service.core.record import Record, Records, Vector

REPEATED, OLDER, AHEAD = int(Cause.REPEATED), int(Cause.OLDER), int(Cause.AHEAD)
CONFIRMED = 3  # samples in a row that agree
CONFIRMED_S = 0.02  # over so long at least
SWAPPED_M = 0.05  # so near to where the other hand was ...
SWAPPED_MPS = 0.2  # [m/s] ... which may have moved on
SWAPPED_S = 2.0  # after so long a swap is believed
AGREE_M = 0.03  # samples of a hand that jumped agree within this ...
AGREE_MPS = 2.0  # [m/s] ... and what a fast hand moves
CONTESTED = 0.25  # share of the samples that jumped at which a source is contested
SETTLED = 0.1  # share below which it is no more
SCATTERED_M = 0.012  # standard deviation of a hand's samples, each axis, at which it is contested
GATHERED_M = 0.010  # below which it is no more
MEMORY_S = 1.0  # over which the share is averaged
MOST_S = 1 / 30  # that one sample counts, whatever the pause before it
ROUND_TO = 1e9  # of the share: machines that differ in the last bits agree


def is_contested(state: Record, *, already: bool) -> bool:
    """Whether some source is contradicted by another; `already`: it was found so before."""
    share, scatter_m = (SETTLED, GATHERED_M) if already else (CONTESTED, SCATTERED_M)
    return bool(max(state["contested"].tolist()) > share or max(state["noise_variance"].tolist()) > scatter_m**2)


@compiled
def refusal(stamp_ns: int, newest_ns: int, fresh: bool, passed_s: float, silent_s: float) -> int:
    """The cause for which a stamp is refused, or -1; the newest one came `passed_s` ago."""
    if stamp_ns == newest_ns:
        return REPEATED
    if not fresh:
        return -1
    ahead_s = (float(stamp_ns) - float(newest_ns)) * 1e-9  # the difference of integers may overflow
    if ahead_s > passed_s + silent_s:
        return AHEAD
    return OLDER if stamp_ns < newest_ns else -1


@compiled
def note(states: Records, source: int, jumped: bool, period_s: float) -> None:
    """Remembers how much a source is contradicted."""
    state = states[0]
    ticks, share = state.sample_ticks[source], state.contested[source]
    if ticks[1] < state.tick:  # two in one tick count alike
        ticks[0], ticks[1] = ticks[1], state.tick
    passed_s = min((state.tick - ticks[0]) * period_s, MOST_S)
    share += (1.0 - math.exp(-passed_s / MEMORY_S)) * ((1.0 if jumped else 0.0) - share)
    state.contested[source] = np.rint(share * ROUND_TO) / ROUND_TO if share > 1e-6 else 0.0


@compiled
def is_swapped(states: Records, side: int, position: Vector, stale_ticks: int, period_s: float) -> bool:
    """Whether a hand's sample (3,) [m], the first after a silence, is the other hand's, or goes on
    from samples that were.
    """
    state = states[0]
    is_swap, seen = state.jump_is_swap[side], state.hand_ticks[side]
    if is_swap and (state.tick - state.jump_first_tick[side]) * period_s >= SWAPPED_S:
        return False
    if is_swap and _goes_on(states, side, position, stale_ticks, period_s):
        return True
    silent = seen >= 0 and stale_ticks <= state.tick - seen and (state.tick - seen) * period_s < SWAPPED_S
    return bool(silent and _is_at_other(states, side, position, period_s))


@compiled
def is_confirmed(states: Records, side: int, position: Vector, stale_ticks: int, period_s: float) -> bool:
    """Whether a hand's sample (3,) [m] that jumped is to be believed, by those just before it."""
    state = states[0]
    if state.jump_count[side] == 0 or not _goes_on(states, side, position, stale_ticks, period_s):
        state.jump_first_tick[side], state.jump_count[side], state.jump_is_swap[side] = state.tick, 0, 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    first, count = state.jump_first_tick[side], state.jump_count[side]
    unseen = state.hand_ticks[1 - side] < first
    if count > 1 and unseen and _is_at_other(states, side, position, period_s):
        state.jump_is_swap[side] = 1
    enough_s = SWAPPED_S if state.jump_is_swap[side] else CONFIRMED_S
    return bool(count >= CONFIRMED and (state.tick - first + 0.5) * period_s >= enough_s)


@compiled
def _is_at_other(states: Records, side: int, position: Vector, period_s: float) -> bool:
    """Whether a hand's sample is where the other hand was, and not where this one was."""
    state = states[0]
    seen = state.hand_ticks[1 - side]
    here, there = state.hands[side, 0], state.hands[1 - side, 0]
    near = SWAPPED_M + SWAPPED_MPS * min((state.tick - seen) * period_s, SWAPPED_S)
    return bool(seen >= 0 and _distance(position, there) < min(near, 0.5 * _distance(here, there)))


@compiled
def _goes_on(states: Records, side: int, position: Vector, stale_ticks: int, period_s: float) -> bool:
    """Whether a sample is where a hand can be that was at the newest one that jumped."""
    state = states[0]
    passed = state.tick - state.jump_newest_tick[side]
    near = _distance(position, state.jumped_to[side]) <= AGREE_M + AGREE_MPS * passed * period_s
    return bool(passed < stale_ticks and near)


@compiled
def _distance(a: Vector, b: Vector) -> float:
    square = 0.0
    for axis in range(3):
        square += (a[axis] - b[axis]) ** 2
    return math.sqrt(square)
