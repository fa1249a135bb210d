"""Plausibility of samples, compared with earlier ones: stamps, jumps, swapped hands, and a second
arm. The rules are the same for both hands and for the arm:

* A stamp differs from the newest one. It is at most `longest_late_s` older (the arm's stamps must
  increase), and ahead by at most the time since the newest sample arrived plus the time after which
  the source is silent. Silence is judged by arrival; after a silence, any
  stamp but the newest one is accepted.
* A sample has jumped if the hand or arm cannot have moved there since its newest sample. A hand's
  jump is accepted once CONFIRMED_SAMPLES successive samples, over at least confirmed_s, agree with
  each other. A jump of the arm is accepted only after a silence, because an arm cannot jump.
* A hand that appears where the other hand was, while that one is no longer seen there, is taken for
  the other one: the tracker has swapped them. The new position is accepted after `swapped_s`,
  within which the tracker may correct itself.
* The arm is contested when more than contested_on_share of its states within about
  tracker_memory_s jumped, until the share is below contested_off_share: two drivers report it. Of
  two trackers of one hand, the daemon takes the samples of one only.
"""

from __future__ import annotations

from kmp.compiled import compiled
from thirdhand.core.frame import Records, Vector
from thirdhand.core.intake import CONFIRMED_SAMPLES
from thirdhand.core.vectors import distance


@compiled
def is_swapped(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a hand's sample (3,) [m] is rejected as the other hand's. It is the first one after a
    silence, or follows samples that were rejected as swapped.

    After a silence shorter than `swapped_s`, the sample is the other hand's if it is where that one
    was (`_is_at_other`). Later samples that continue it are rejected until `swapped_s` has passed.
    """
    state = states[0]
    config = parameters[0]
    is_swap = state.jump_is_swap[side]
    sample_tick = state.hand_ticks[side]
    if is_swap and (state.tick - state.jump_first_tick[side]) * config.period_s >= config.swapped_s:
        return False
    if is_swap and _goes_on(states, parameters, side, position):
        return True
    silent = state.tick - sample_tick
    lately = config.stale_ticks <= silent and silent * config.period_s < config.swapped_s
    return bool(sample_tick >= 0 and lately and _is_at_other(states, parameters, side, position))


@compiled
def is_confirmed(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if the jump of a hand to a position (3,) [m] is accepted; counts successive samples that
    agree.

    Accepted are at least CONFIRMED_SAMPLES samples that agree over confirmed_s; over `swapped_s` if
    the hand jumped to where the other one was, and that one has not been seen since.
    """
    state = states[0]
    config = parameters[0]
    if state.jump_count[side] == 0 or not _goes_on(states, parameters, side, position):
        state.jump_first_tick[side] = state.tick
        state.jump_count[side] = 0
        state.jump_is_swap[side] = 0
    state.jumped_to[side, :] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    first = state.jump_first_tick[side]
    count = state.jump_count[side]
    unseen = state.hand_ticks[1 - side] < first
    if count > 1 and unseen and _is_at_other(states, parameters, side, position):
        state.jump_is_swap[side] = 1
    enough_s = config.swapped_s if state.jump_is_swap[side] else config.confirmed_s
    return bool(
        count >= CONFIRMED_SAMPLES and (state.tick - first + 0.5) * config.period_s >= enough_s
    )


@compiled
def _is_at_other(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a hand's sample (3,) [m] is near the other hand's estimate, and nearer to it than
    half the distance between the hands.

    Near is where the other hand may have moved since it was seen: within jump + jump_speed *
    elapsed time, at most `swapped_s`.
    """
    state = states[0]
    config = parameters[0]
    other_tick = state.hand_ticks[1 - side]
    hand_m = state.hands[side, 0]
    other_m = state.hands[1 - side, 0]
    near = config.jump_m + config.jump_speed_mps * min(
        (state.tick - other_tick) * config.period_s, config.swapped_s
    )
    return bool(
        other_tick >= 0 and distance(position, other_m) < min(near, 0.5 * distance(hand_m, other_m))
    )


@compiled
def _goes_on(states: Records, parameters: Records, side: int, position: Vector) -> bool:
    """True if a sample (3,) [m] agrees with the newest sample that jumped: it is less than
    `stale_ticks` later and within jump + jump_speed * elapsed time.
    """
    state = states[0]
    config = parameters[0]
    passed = state.tick - state.jump_newest_tick[side]
    near = (
        distance(position, state.jumped_to[side])
        <= config.jump_m + config.jump_speed_mps * passed * config.period_s
    )
    return bool(passed < config.stale_ticks and near)
