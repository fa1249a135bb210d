"""What a source tells, against what it told before: stamps, jumps, and a second source that
contradicts it. One rule for both hands and the arm:

* A stamp must be newer than the newest one, and no farther ahead of it than the time since then
  plus the time after which the source is silent. Silence is judged by arrival; after it any stamp
  is taken, but the same again.
* Where a sample cannot come from what was known it has jumped. A hand's jump is believed once
  `CONFIRMED` samples in a row, over `CONFIRMED_S` at least, agree with each other; the arm's never,
  before it was silent: it has a body.
* A source is contested from when a quarter of what it told within about a second had jumped, until
  that is less than a tenth.
"""

from __future__ import annotations

import math

from kmp.compiled import compiled
from service.contract.records import Cause
from service.core.frame import Record, Records, Vector

REPEATED, OLDER, AHEAD = int(Cause.REPEATED), int(Cause.OLDER), int(Cause.AHEAD)
CONFIRMED, CONFIRMED_S = 3, 0.02
AGREE_M, AGREE_MPS = 0.03, 2.0  # samples of a hand that jumped agree as far as a fast hand moves
CONTESTED, SETTLED = 0.25, 0.1
MEMORY_S, MOST_S = 1.0, 1 / 30  # over which samples are averaged; as long counts one, whatever the pause before it


def is_contested(state: Record, *, already: bool) -> bool:
    """Whether some source is contradicted by another; `already`: it was found so before."""
    return bool(max(state["contested"].tolist()) > (SETTLED if already else CONTESTED))


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
    ticks, share = state.told_ticks[source], state.contested[source]
    if ticks[1] < state.tick:  # two in one tick count alike
        ticks[0], ticks[1] = ticks[1], state.tick
    passed_s = min((state.tick - ticks[0]) * period_s, MOST_S)
    share += (1.0 - math.exp(-passed_s / MEMORY_S)) * ((1.0 if jumped else 0.0) - share)
    state.contested[source] = share if share > 1e-6 else 0.0


@compiled
def is_confirmed(states: Records, side: int, position: Vector, stale_ticks: int, period_s: float) -> bool:
    """Whether a hand's sample (3,) [m] that jumped is to be believed, by those just before it."""
    state = states[0]
    doubts, doubted = state.doubts[side], state.doubted[side]
    passed, off = state.tick - doubts[1], 0.0
    for axis in range(3):
        off += (position[axis] - doubted[axis]) ** 2
        doubted[axis] = position[axis]
    if doubts[2] == 0 or passed >= stale_ticks or math.sqrt(off) > AGREE_M + AGREE_MPS * passed * period_s:
        doubts[0], doubts[2] = state.tick, 0
    doubts[1] = state.tick
    doubts[2] += 1
    return bool(doubts[2] >= CONFIRMED and (state.tick - doubts[0] + 0.5) * period_s >= CONFIRMED_S)
