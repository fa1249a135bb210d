"""Plausibility of samples, compared with earlier ones: stamps, jumps, and a second arm. The
rules are the same for both hands and for the arm:

* A stamp differs from the newest one. It is at most `longest_late_s` older (the arm's stamps must
  increase), and ahead by at most the time since the newest sample arrived plus the time after which
  the source is silent. Silence is judged by arrival; after a silence, any
  stamp but the newest one is accepted.
* A sample has jumped if the hand or arm cannot have moved there since its newest sample. A hand's
  jump is accepted once CONFIRMED_SAMPLES successive samples, over at least confirmed_s, agree with
  each other. A jump of the arm is accepted only after a silence, because an arm cannot jump.
* The arm is contested when more than contested_on_share of its states within about
  tracker_memory_s jumped, until the share is below contested_off_share: two drivers report it. Of
  two trackers of one hand, the daemon takes the samples of one only.
"""

from __future__ import annotations

from kmp.compiled import compiled
from thirdhand.core.frame import Struct, Vector
from thirdhand.core.intake import CONFIRMED_SAMPLES
from thirdhand.core.vectors import distance


@compiled
def is_confirmed(state: Struct, config: Struct, side: int, position: Vector) -> bool:
    """True if the jump of a hand to a position (3,) [m] is accepted; counts successive samples that
    agree.

    Accepted are at least CONFIRMED_SAMPLES samples that agree over confirmed_s.
    """
    if state.jump_count[side] == 0 or not _goes_on(state, config, side, position):
        state.jump_first_tick[side] = state.tick
        state.jump_count[side] = 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    agree_s = (state.tick - state.jump_first_tick[side] + 0.5) * config.period_s
    return bool(state.jump_count[side] >= CONFIRMED_SAMPLES and agree_s >= config.confirmed_s)


@compiled
def _goes_on(state: Struct, config: Struct, side: int, position: Vector) -> bool:
    """True if a sample (3,) [m] agrees with the newest sample that jumped: it is less than
    `stale_ticks` later and within jump + jump_speed * elapsed time.
    """
    passed = state.tick - state.jump_newest_tick[side]
    near = (
        distance(position, state.jumped_to[side])
        <= config.jump_m + config.jump_speed_mps * passed * config.period_s
    )
    return bool(passed < config.stale_ticks and near)
