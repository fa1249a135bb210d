"""Compiled step of the intake: check samples, compare them with earlier ones, and filter them. The
rules by which samples are accepted are the same for both hands and for the arm:

* A stamp differs from the newest one. It is at most `longest_late_s` older (the arm's stamps must
  increase), and ahead by at most the time since the newest sample arrived plus the time after which
  the source is silent. Silence is judged by arrival; after a silence, any stamp but the newest one
  is accepted.
* A sample has jumped if the hand or arm cannot have moved there since its newest sample. A hand's
  jump is accepted once CONFIRMED_SAMPLES successive samples, over at least confirmed_s, agree with
  each other. A jump of the arm is accepted only after a silence, because an arm cannot jump.
* The arm is contested when more than contested_on_share of its states within about
  tracker_memory_s jumped, until the share is below contested_off_share: two drivers report it. Of
  two trackers of one hand, the daemon takes the samples of one only.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.codes import (
    AHEAD,
    ARM_GUIDED,
    ARM_HEARD,
    ARM_STILL,
    CLUTCH_RELEASED,
    CONTESTED,
    FAULT,
    HANDS_KNOWN,
    JUMPED,
    NOT_A_ROTATION,
    NOT_FINITE,
    OLDER,
    OUT_OF_RANGE,
    REPEATED,
    TWO_SOURCES,
    UNSEEN,
)
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.intake import CONFIRMED_SAMPLES, KEPT
from thirdhand.core.intake.arm_samples import compared, unwrap
from thirdhand.core.intake.hand_estimator import is_fresh, settle, slot, take, ticks_late
from thirdhand.core.intake.late_samples import (
    drop,
    expected,
    order_of,
    take_late,
    tick_made,
    wrong_samples,
)
from thirdhand.core.intake.motion_model import CHANGE
from thirdhand.core.vectors import (
    add_product,
    distance,
    norm,
    rounded,
    square,
    squared_distance,
    transform,
)


@compiled
def refusal(
    stamp_ns: int, newest_ns: int, fresh: bool, passed_s: float, silent_s: float, late_s: float
) -> int:
    """Cause for which a stamp is rejected: REPEATED, AHEAD, OLDER; -1 if it is accepted.

    The newest sample arrived `passed_s` ago with the stamp `newest_ns`. A stamp may be ahead of
    that by `passed_s` + `silent_s`, and older than that by `late_s`. After a silence (not `fresh`),
    every stamp but the newest one is accepted.
    """
    if stamp_ns == newest_ns:
        return REPEATED
    if not fresh:
        return -1
    # as floats, because the difference of two integers may overflow
    ahead_s = (float(stamp_ns) - float(newest_ns)) * 1e-9
    if ahead_s > passed_s + silent_s:
        return AHEAD
    return OLDER if stamp_ns < newest_ns and ahead_s < -late_s else -1


@compiled
def note_arm(state: Struct, config: Struct, jumped: bool) -> None:
    """Update the share c of the arm's recent states that contradict the others:

        c = c + (1 - exp(-Δ / tracker_memory_s)) (jumped - c)

    For the first state in a tick, Δ is half the time since the last but one earlier tick with a
    state; for a further state in this tick, it is the time since the last earlier one. Δ is at most
    the time after which the arm is silent. So the states of two drivers that take turns have the
    same weight, however soon one follows the other.
    """
    ticks = state.arm_sample_ticks
    passed = float(state.tick - ticks[0])
    if ticks[1] < state.tick:
        passed *= 0.5  # half the time since the state before the last one
        ticks[0] = ticks[1]
        ticks[1] = state.tick
    passed_s = min(passed * config.period_s, config.silent_ticks * config.period_s)
    share = state.arm_contested
    share += (1.0 - exp(-passed_s / config.tracker_memory_s)) * ((1.0 if jumped else 0.0) - share)
    state.arm_contested = rounded(share) if share > 1e-6 else 0.0


@compiled
def take_arm(
    states: Records, parameters: Records, stamp_ns: int, position: Vector, velocity: Vector
) -> int:
    """Store a sample of the arm's joints (J,) [rad, rad/s] in the state; compiled part of
    `Intake.take_arm`. Returns the cause for which it was rejected, or -1.
    """
    state = states[0]
    config = parameters[0]
    passed = state.tick - state.arm_tick
    fresh = state.arm_tick >= 0 and passed < config.silent_ticks
    cause = NOT_FINITE
    if np.isfinite(position).all() and np.isfinite(velocity).all():
        # Before it is ready, and after a silence, an arm is in the turn that it reports, because it
        # may have restarted. While it is commanded, its turns are counted on.
        if fresh or (state.arm_ready and state.mode != FAULT):
            unwrap(state, config, position)
        cause = _judge_arm(state, config, stamp_ns, position, velocity, fresh)
    if cause >= 0:
        return cause
    state.measured[:] = position
    state.measured_velocities[:] = velocity
    state.arm_stamp_ns = stamp_ns
    state.arm_tick = state.tick
    return -1


@compiled
def _judge_arm(
    state: Struct,
    config: Struct,
    stamp_ns: int,
    position: Vector,
    velocity: Vector,
    fresh: bool,
) -> int:
    """Cause for which a finite sample of the arm is rejected, or -1. Notes whether it contradicts
    the others, and whether the arm is still.
    """
    plausible, deviation, moved = compared(state, config, position, velocity)
    if not plausible:
        return OUT_OF_RANGE

    passed_s = (state.tick - state.arm_tick) * config.period_s
    silent_s = config.silent_ticks * config.period_s
    cause = refusal(stamp_ns, state.arm_stamp_ns, fresh, passed_s, silent_s, 0.0)
    if cause != REPEATED:
        jumped = fresh and deviation > config.joint_jump_rad + config.joint_jump_speed * passed_s
        note_arm(state, config, jumped)
        if jumped and cause < 0:
            cause = JUMPED

    if moved > config.arm_still_rad or not fresh:
        state.arm_still_posture[:] = position
        state.arm_still_tick = state.tick
    return cause


@compiled
def _malformed(
    config: Struct,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    in_base: Vector,
) -> int:
    """Cause for which the pose itself is rejected: NOT_FINITE, NOT_A_ROTATION, OUT_OF_RANGE; -1 if
    it is accepted. `in_base` (3,) [m] is the position in frame base.
    """
    x, y, z, w = turn
    if not np.isfinite(np.array(position + turn)).all():
        return NOT_FINITE
    if not abs(math.sqrt(x * x + y * y + z * z + w * w) - 1.0) <= 0.01:
        return NOT_A_ROTATION
    most_m = config.max_hand_distance_m
    return -1 if square(in_base) <= most_m * most_m else OUT_OF_RANGE


@compiled
def _goes_on(state: Struct, config: Struct, side: int, position: Vector) -> bool:
    """True if a hand that is seen again at x (3,) [m] continues its filter: its newest sample is
    less than `unseen_ticks` old, and |x - p|² < outlier_variances (P + r).

    p is the estimated position, P the position's variance in the mode CHANGE, r the noise variance.
    """
    square_m2 = squared_distance(position, state.hands[side, 0])
    variance = state.mode_covariances[side, CHANGE, 0, 0] + state.noise_variance[side]
    return bool(
        is_fresh(state, side, config.unseen_ticks)
        and square_m2 < config.outlier_variances * variance
    )


@compiled
def _in_time(
    state: Struct, config: Struct, side: int, stamp_ns: int, in_base: Vector, fresh: bool
) -> tuple[int, int, int]:
    """Cause for which a sample of a hand is rejected by its stamp, or -1; its `order` among the
    retained samples; and the tick in which it was made.

    The retained samples are forgotten if a hand that is not `fresh` does not continue its filter at
    `in_base` (3,) [m], or its clock was set back.
    """
    order = 0
    newest_ns = state.hand_stamps_ns[side]
    period_s = config.period_s
    passed_s = (state.tick - state.hand_ticks[side]) * period_s
    stale_s = state.stale_ticks[side] * period_s
    cause = refusal(stamp_ns, newest_ns, fresh, passed_s, stale_s, config.longest_late_s)
    if cause >= 0:
        return cause, 0, state.tick

    if not fresh and (stamp_ns < newest_ns or not _goes_on(state, config, side, in_base)):
        state.kept[side] = 0
    elif fresh and stamp_ns < newest_ns:
        order = order_of(state, side, stamp_ns)

    late = ticks_late(state, side, stamp_ns, period_s, config.longest_late_s)
    if order >= KEPT - 1:
        return OLDER, 0, state.tick
    if order < 0:
        return REPEATED, order, state.tick
    if order == 0 and late == 0:
        return -1, 0, state.tick
    return -1, order, tick_made(state, side, stamp_ns, order, late, period_s)


@compiled
def _jump(
    state: Struct,
    config: Struct,
    models: Records,
    side: int,
    order: int,
    made: int,
    position: Vector,
    fresh: bool,
) -> tuple[bool, int]:
    """True if a hand's sample has jumped, and the number of wrong samples before it.

    A sample x (3,) [m] of a `fresh` hand, made in tick `made` and number `order` of the retained
    ones, is a jump if it is farther from the expected position p (3,) than a hand can move and a
    tracker's noise explains, in the interval since the sample from which p was predicted:

        |x - p| > max(jump + jump_speed * interval, jump_noise_stds * noise standard deviation)

    If it continues the retained samples without the newest few, those were wrong (`wrong_samples`),
    and it has not jumped.
    """
    if not fresh:
        return False, 0
    # predicted from the sample before it, by stamp
    prediction = state.hands[side, 0]
    neighbour = state.kept_newest[side]
    if order > 0 or made != state.tick:
        prediction = expected(state, models, side, order, made)
        neighbour = slot(state, side, min(order, state.kept[side] - 1))
    interval_s = abs(made - state.kept_ticks[side, neighbour]) * config.period_s
    gate_m = max(
        config.jump_m + config.jump_speed_mps * interval_s,
        config.jump_noise_stds * math.sqrt(state.noise_variance[side]),
    )
    if squared_distance(position, prediction) <= gate_m * gate_m:
        return False, 0
    wrong = wrong_samples(state, config, models, side, made, position) if order == 0 else 0
    return wrong == 0, wrong


@compiled
def _is_confirmed(state: Struct, config: Struct, side: int, position: Vector) -> bool:
    """True if the jump of a hand to a position (3,) [m] is accepted; counts successive samples that
    agree. Accepted are at least CONFIRMED_SAMPLES samples that agree over confirmed_s.

    A sample agrees with the newest one that jumped if it is less than `stale_ticks` later and
    within jump + jump_speed * elapsed time.
    """
    passed = state.tick - state.jump_newest_tick[side]
    near_m = config.jump_m + config.jump_speed_mps * passed * config.period_s
    is_near = distance(position, state.jumped_to[side]) <= near_m
    if state.jump_count[side] == 0 or passed >= config.stale_ticks or not is_near:
        state.jump_first_tick[side] = state.tick
        state.jump_count[side] = 0
    state.jumped_to[side] = position
    state.jump_newest_tick[side] = state.tick
    state.jump_count[side] += 1
    agree_s = (state.tick - state.jump_first_tick[side] + 0.5) * config.period_s
    return bool(state.jump_count[side] >= CONFIRMED_SAMPLES and agree_s >= config.confirmed_s)


@compiled
def _judge_hand(
    state: Struct,
    config: Struct,
    models: Records,
    side: int,
    stamp_ns: int,
    position: Vector,
    fresh: bool,
) -> tuple[int, int, int, bool, int]:
    """Cause for which a hand's well-formed sample (3,) [m] is rejected, or -1; its order and tick,
    as of `_in_time`; and the result of `_jump`.
    """
    cause, order, made_tick = _in_time(state, config, side, stamp_ns, position, fresh)
    if cause >= 0:
        return cause, order, made_tick, False, 0
    jumped, wrong = _jump(state, config, models, side, order, made_tick, position, fresh)
    if jumped and (order > 0 or not _is_confirmed(state, config, side, position)):
        cause = JUMPED
    return cause, order, made_tick, jumped, wrong


@compiled
def take_hand(
    states: Records,
    parameters: Records,
    models: Records,
    side: int,
    stamp_ns: int,
    position: tuple[float, float, float],
    turn: tuple[float, float, float, float],
    mapping: Vector,
) -> int:
    """Filter a sample of one hand; compiled part of `Intake.take_hand`. Returns the cause for which
    it was rejected, or -1.

    `position` [unit of the tracker] and the quaternion `turn` x y z w are in the tracker's axes.
    `mapping` (3, 4) maps them to frame base: axes times unit [m], and origin.
    """
    state = states[0]
    config = parameters[0]
    in_base = np.empty(3)
    transform(mapping[:, :3], mapping[:, 3], position, in_base)
    fresh = is_fresh(state, side, state.stale_ticks[side])

    # Is the sample accepted?
    order = 0
    made_tick = state.tick
    jumped = False
    wrong = 0
    cause = _malformed(config, position, turn, in_base)
    if cause < 0:
        cause, order, made_tick, jumped, wrong = _judge_hand(
            state, config, models, side, stamp_ns, in_base, fresh
        )
    if cause >= 0:
        return cause

    # It is filtered after the samples made before it, without the wrong ones.
    before = state.hands[side, 0].copy()
    if wrong > 0:
        drop(state, side, wrong)
    if order == 0 and made_tick == state.tick and wrong == 0:
        take(state, config, side, stamp_ns, in_base, jumped)
    else:
        take_late(state, config, models, side, stamp_ns, made_tick, in_base, jumped)
    settle(state, config, models, side, stamp_ns, fresh)

    # The newest sample is what later ones are compared with.
    if order == 0:
        _note_correction(state, config, side, wrong, before)
        state.jump_count[side] = 0
        _turn_to(state, side, turn, mapping)
        state.hand_stamps_ns[side] = stamp_ns
        state.hand_ticks[side] = state.tick
    return -1


@compiled
def _turn_to(
    state: Struct, side: int, turn: tuple[float, float, float, float], mapping: Vector
) -> None:
    """Store the orientation of one hand as a rotation matrix in frame base, row by row.

    `turn` is the quaternion x y z w in the tracker's axes. `mapping` (3, 4) maps the tracker's
    coordinates to base: rotation times unit [m], and origin.
    """
    x, y, z, w = turn
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rotation = np.array(
        (
            (1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
            (s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)),
            (s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)),
        )
    )
    unit = norm(mapping[:, 0])
    turned = state.hand_turns[side].reshape((3, 3))
    turned[:] = 0.0
    add_product(mapping[:, :3] / unit, rotation, turned)


@compiled
def _note_correction(state: Struct, config: Struct, side: int, wrong: int, before: Vector) -> None:
    """Note how far a hand was moved when `wrong` samples were dropped, from the estimate `before`
    (3,) [m].

    Until the corrected estimate is confirmed like a jump, by CONFIRMED_SAMPLES further samples over
    confirmed_s, the hand may still be this far away: `hand_doubt_m`.
    """
    if wrong > 0:
        moved = distance(before, state.hands[side, 0])
        state.hand_doubt_m[side] = max(state.hand_doubt_m[side], rounded(moved))
        state.corrected_tick[side] = state.tick
        state.doubted_samples[side] = CONFIRMED_SAMPLES
    elif state.doubted_samples[side] > 0:
        state.doubted_samples[side] -= 1
    passed_s = (state.tick - state.corrected_tick[side]) * config.period_s
    if state.doubted_samples[side] == 0 and passed_s >= config.confirmed_s:
        state.hand_doubt_m[side] = 0.0


@compiled
def report(states: Records, frames: Records, parameters: Records) -> int:
    """Copy the hands' estimates and ages into the frame. Returns the flags of `codes.Condition`
    that the intake determines: HANDS_KNOWN, LEFT_UNSEEN or RIGHT_UNSEEN, ARM_HEARD, ARM_STILL,
    ARM_GUIDED, CONTESTED, CLUTCH_RELEASED.
    """
    frame = frames[0]
    state = states[0]
    left = state.hand_ticks[0]
    right = state.hand_ticks[1]
    if left == right:
        frame.hand_stamp_ns = max(state.hand_stamps_ns[0], state.hand_stamps_ns[1])
    else:
        frame.hand_stamp_ns = state.hand_stamps_ns[0 if left > right else 1]
    for side in range(2):
        sample_tick = state.hand_ticks[side]
        frame.hand_ages[side] = -1 if sample_tick < 0 else state.tick - sample_tick
    frame.stale_ticks[:] = state.stale_ticks
    frame.hands[:] = state.hands[:, 0]
    frame.hand_velocities[:] = state.hands[:, 1]
    frame.tick = state.tick
    frame.rejected[:] = state.rejected
    return _hand_conditions(frame, parameters[0]) | _arm_conditions(state, parameters[0])


@compiled
def _hand_conditions(frame: Struct, config: Struct) -> int:
    """HANDS_KNOWN, LEFT_UNSEEN and RIGHT_UNSEEN, as they hold for the ages in the frame."""
    ages = frame.hand_ages
    stale = frame.stale_ticks
    is_any_seen = ages[0] < stale[0] or ages[1] < stale[1]
    if ages.min() < 0 or ages.max() >= config.unseen_ticks or not is_any_seen:
        return 0
    conditions = HANDS_KNOWN
    for side in range(2):
        if ages[side] >= stale[side]:
            conditions |= UNSEEN[side]
    return conditions


@compiled
def _arm_conditions(state: Struct, config: Struct) -> int:
    """ARM_HEARD, ARM_STILL, ARM_GUIDED, CONTESTED and CLUTCH_RELEASED, as they hold now.

    The arm is CONTESTED if its share of contradicting states is above contested_on_share, or above
    contested_off_share if it was contested at the last tick.
    """
    conditions = 0
    if state.arm_tick >= 0 and state.tick - state.arm_tick < config.silent_ticks:
        conditions |= ARM_HEARD
        if state.tick - state.arm_still_tick >= config.still_ticks:
            conditions |= ARM_STILL
        if state.tick < state.guided_until_tick:
            conditions |= ARM_GUIDED
    if config.has_clutch and state.tick >= state.clutch_until_tick:
        conditions |= CLUTCH_RELEASED
    was_contested = state.reason == TWO_SOURCES
    limit = config.contested_off_share if was_contested else config.contested_on_share
    return conditions | CONTESTED if state.arm_contested > limit else conditions
