"""Compiled step of the decision: determine mode and reason from arm, hands and skill."""

from __future__ import annotations

import math

from kmp.compiled import compiled
from thirdhand.core.codes import (
    AMBIGUOUS,
    ARM_ERROR,
    ARM_GUIDED,
    ARM_HEARD,
    ARM_INSIDE,
    ARM_SILENT,
    ARM_STILL,
    BLOCKED,
    CLUTCH,
    CLUTCH_RELEASED,
    CONTESTED,
    EITHER_UNSEEN,
    FAR,
    FAULT,
    FOLLOW,
    GUIDED,
    HANDS_KNOWN,
    HELD,
    HELD_SEEN,
    HELD_UNSEEN,
    HOLD,
    JUMPED_WISH,
    NO_HANDS,
    NO_WISH,
    NONE,
    NOT_READY,
    NOTICED,
    ONE_HAND,
    OPERATOR,
    READY,
    RETURNING,
    SEGMENT_AMBIGUOUS,
    STALE_HAND,
    STALE_WISH,
    STARTS_ASSUMED,
    STARTS_MEASURED,
    TOOL_SPEED,
    TWO_SOURCES,
    UNREACHABLE_WISH,
    UNSEEN_HAND_NEEDED,
    WISH_JUMPED,
    WISH_LEADS,
    WISH_OUTSIDE,
    WISH_SILENT,
    WISH_UNKNOWN,
)
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.vectors import distance, norm, times


@compiled
def step(
    states: Records,
    frames: Records,
    heres: Records,
    parameters: Records,
    conditions: int,
    gate_m: float,
    threshold: float,
) -> tuple[int, float, float]:
    """Mode and reason of this tick, written to state and frame; compiled part of `Decision.step`.

    A fault remains until a reset. Otherwise the arm may cause a fault (`_arm`), or a reason
    (`_why_hold`, or BLOCKED: the tool is stuck, and the arm waits or moves along a way out, see
    `_stuck`) causes a hold; without one, the arm follows.

    Returns STARTS_ASSUMED or STARTS_MEASURED if the arm starts, else 0, and the result of
    `measured_error`, or -1 twice if nothing was measured.
    """
    state = states[0]
    frame = frames[0]
    starts = 0
    error = -1.0
    speed = -1.0
    if state.mode != FAULT:
        starts, fault, error, speed = _arm(state, heres[0], parameters[0], conditions)
        if fault != NONE:
            state.mode = FAULT
            state.reason = fault
        else:
            _note_hold(state, conditions)
            reason = _why_hold(state, parameters[0], conditions, gate_m, threshold)
            if reason == NONE:
                state.stuck = _stuck(state, frame, heres[0], parameters[0])
                reason = BLOCKED if state.stuck == HELD else NONE
            state.mode = FOLLOW if reason == NONE else HOLD
            state.reason = reason
            if reason == NONE:
                state.followed_tick = state.tick
    frame.mode = state.mode
    frame.reason = state.reason
    return starts, error, speed


@compiled
def _why_hold(
    state: Struct, config: Struct, conditions: int, gate_m: float, threshold: float
) -> int:
    """The first reason for a hold in this order, or NONE:

    * TWO_SOURCES: a hand or the arm is contested.
    * GUIDED: the arm is led by hand. This is an operator's hold, which lasts afterwards.
    * NOT_READY: the arm is not ready. While the clutch is released, an arm that would move back by
      itself holds for a later reason.
    * OPERATOR: the operator holds it.
    * CLUTCH: the clutch is released.
    * NO_WISH, STALE_WISH, JUMPED_WISH, UNREACHABLE_WISH where wishes lead; none of the rules below
      applies then.
    * FAR: the arm does not follow, and a hand has jumped within the last jumpy_s.
    * NO_HANDS, STALE_HAND: the skill predicts nothing (`gate_m` is NaN), because a hand has never
      been seen or is not seen now.
    * STALE_HAND: a hand was seen a moment ago, and the target depends on it or the arm does not
      follow yet.
    * FAR: gate_m > threshold; after a tick that held for this reason, gate_m > end_share threshold.
    * AMBIGUOUS: the segment of the task is not known.
    """
    if conditions & CONTESTED:
        return TWO_SOURCES
    if conditions & ARM_GUIDED and not config.is_assumed:
        return GUIDED
    returns_later = state.arm_ready == RETURNING and conditions & CLUTCH_RELEASED
    if state.arm_ready != READY and not returns_later:
        return NOT_READY
    if state.operator_hold:
        return OPERATOR
    if conditions & CLUTCH_RELEASED:
        return CLUTCH
    if conditions & (WISH_LEADS | WISH_SILENT | WISH_UNKNOWN):
        return _wish_reason(conditions)
    jump_tick = max(state.jump_newest_tick[0], state.jump_newest_tick[1])
    jumped_s = (state.tick - jump_tick) * config.period_s
    if state.mode != FOLLOW and jump_tick > 0 and jumped_s < config.jumpy_s:
        return FAR
    reason = _unseen_reason(state, conditions, gate_m)
    ease = config.end_share if state.reason == FAR else 1.0
    if reason == NONE and gate_m > ease * threshold:
        return FAR
    if reason == NONE and conditions & SEGMENT_AMBIGUOUS:
        return AMBIGUOUS
    return reason


@compiled
def _wish_reason(conditions: int) -> int:
    """The reason for a hold where wishes lead, or NONE."""
    if conditions & WISH_UNKNOWN:
        return NO_WISH
    if conditions & WISH_SILENT:
        return STALE_WISH
    if conditions & WISH_JUMPED:
        return JUMPED_WISH
    return UNREACHABLE_WISH if conditions & WISH_OUTSIDE else NONE


@compiled
def _unseen_reason(state: Struct, conditions: int, gate_m: float) -> int:
    """NO_HANDS or STALE_HAND of `_why_hold`, or NONE."""
    if math.isnan(gate_m):
        is_never_seen = min(state.hand_ticks[0], state.hand_ticks[1]) < 0
        return NO_HANDS if is_never_seen and not conditions & ONE_HAND else STALE_HAND
    is_needed = conditions & UNSEEN_HAND_NEEDED or state.mode != FOLLOW
    return STALE_HAND if conditions & EITHER_UNSEEN and is_needed else NONE


@compiled
def _arm(
    state: Struct, kinematics: Struct, config: Struct, conditions: int
) -> tuple[int, int, float, float]:
    """Update the state of the arm: it starts, is no longer ready, or causes a fault. Returns
    STARTS_ASSUMED, STARTS_MEASURED or 0; the reason of a fault, or NONE; and `measured_error`, or
    -1 twice.

    * An assumed arm starts at its configured posture and is ready.
    * An arm that is led by hand is not ready. Its commanded joints come to rest. From then on they
      are set to the measured ones in each tick.
    * Any other arm starts at its measured posture, once this is constant and the commanded joints
      are at rest. If it is outside its limits it is RETURNING, else READY. An arm inside of an
      obstacle starts only after the operator's confirmation (`leaves`), and is RETURNING.
    * A RETURNING arm becomes READY once it is within its limits, and either inside of no obstacle
      or without motion for stuck_s.
    * A silent arm is a fault (ARM_SILENT) if it follows or moves; at rest, it is no longer ready.
    * A joint farther than `max_error_rad` from its command is a fault (ARM_ERROR).
    * A tool faster than `fault_speed` for more than too_fast_s is a fault (TOOL_SPEED).
    """
    if config.is_assumed:
        starts = 0 if state.arm_ready else STARTS_ASSUMED
        state.arm_ready = READY
        return starts, NONE, -1.0, -1.0
    is_moving = _is_commanded_to_move(state.joints)
    if conditions & ARM_GUIDED:
        state.operator_hold = 1
        state.arm_ready = 0
        state.leaves = 0
        state.guided_tick = state.tick
        state.stuck = state.way_count = 0
        return 0 if is_moving else STARTS_MEASURED, NONE, -1.0, -1.0
    if not state.arm_ready:
        return _start(state, config, conditions, is_moving), NONE, -1.0, -1.0
    if not conditions & ARM_HEARD:
        if state.mode == FOLLOW or is_moving:
            return 0, ARM_SILENT, -1.0, -1.0
        state.arm_ready = 0
        return 0, NONE, -1.0, -1.0
    if state.arm_ready == RETURNING:
        _return(state, config, conditions, is_moving)

    error, speed = measured_error(state, kinematics, config)
    if error > config.max_error_rad:
        return 0, ARM_ERROR, error, speed
    if speed <= config.fault_speed:
        state.slow_tick = state.tick
    fast_s = (state.tick - state.slow_tick) * config.period_s
    return 0, TOOL_SPEED if fast_s > config.too_fast_s else NONE, error, speed


@compiled
def _is_commanded_to_move(joints: Vector) -> bool:
    """True if a commanded joint (3, J) has a velocity or an acceleration."""
    for joint in range(joints.shape[1]):
        if joints[1, joint] != 0.0 or joints[2, joint] != 0.0:
            return True
    return False


@compiled
def _start(state: Struct, config: Struct, conditions: int, is_moving: bool) -> int:
    """STARTS_MEASURED if an arm that is not ready starts, else 0; see `_arm`."""
    is_inside = conditions & ARM_INSIDE
    is_still = conditions & ARM_STILL
    state.stuck = state.way_count = 0
    if not is_still:
        state.leaves = 0
    # Commanded joints that move come to rest first; the reported posture must be constant.
    if not is_still or is_moving or (is_inside and not state.leaves):
        return 0
    is_returning = is_inside or _is_outside(state.measured, config)
    state.arm_ready = RETURNING if is_returning else READY
    state.slow_tick = state.stuck_tick = state.tick
    return STARTS_MEASURED


@compiled
def _return(state: Struct, config: Struct, conditions: int, is_moving: bool) -> None:
    """Let a RETURNING arm become READY, see `_arm`."""
    if _is_outside(state.joints[0], config):
        return
    if is_moving:
        state.stuck_tick = state.tick
    still_s = (state.tick - state.stuck_tick) * config.period_s
    if not conditions & ARM_INSIDE or still_s > config.stuck_s:
        state.arm_ready = READY
        state.leaves = 0


@compiled
def _note_hold(state: Struct, conditions: int) -> None:
    """Store hands and segment at the start of an operator's hold; its end clears them.

    The segment is the most probable one, if its probability is above 1/2.
    """
    if state.operator_hold and not state.held:
        is_seen = conditions & HANDS_KNOWN and not conditions & EITHER_UNSEEN
        state.held = HELD_SEEN if is_seen else HELD_UNSEEN
        state.held_tick = state.tick
        state.held_segment = -1
        state.held_hands[:] = state.hands[:, 0]
        most = state.segment_belief.argmax()
        if state.segment_belief[most] > 0.5:
            state.held_segment = most
    elif not state.operator_hold:
        state.held = 0


@compiled
def _stuck(state: Struct, frame: Struct, kinematics: Struct, config: Struct) -> int:
    """Progress of the tool toward its target: HELD while the arm waits or moves along a way out,
    NOTICED when the tool has come no nearer for stuck_s, else 0.

    With g = |target - tool| now and g_0 at `stuck_tick`, the tool makes progress if

        g_0 - g > min(progress_share g_0, freed_share max_speed stuck_s)

    and, once NOTICED, if g_0 - g > freed_share g_0. Then `stuck_tick`, g_0 and the target are set
    to the present ones. This also happens if the arm does not follow, if g < stuck_gap_m, or if the
    target has moved by more than stuck_gap_m. While the setpoint engages, engaging_speed takes the
    place of max_speed.

    HELD, which starts with a way out (`leave.WayOut.take`), lasts until that way ends or
    `way_timeout_s` has passed. If none was found, or one has been tried since the tool was at a
    target, it lasts until the target or a hand has moved by another_target_m.
    """
    tool = kinematics.position
    gap = distance(frame.target, tool)
    moved = distance(frame.target, state.stuck_target)
    passed_s = (state.tick - state.stuck_tick) * config.period_s
    if state.way_next < state.way_count and passed_s < config.way_timeout_s:
        return HELD
    hand_moved = max(
        distance(state.hands[0, 0], state.stuck_hands[0]),
        distance(state.hands[1, 0], state.stuck_hands[1]),
    )
    if (
        state.stuck == HELD
        and not state.way_count
        and max(moved, hand_moved) < config.another_target_m
    ):
        return HELD
    state.way_next = state.way_count = 0
    if state.stuck == NOTICED:
        least = config.freed_share * state.stuck_gap
    else:
        max_speed = config.engaging_speed if state.engaging else config.max_speed
        least = min(
            config.progress_share * state.stuck_gap, config.freed_share * max_speed * config.stuck_s
        )
    if (
        state.mode != FOLLOW
        or gap < config.stuck_gap_m
        or state.stuck_gap - gap > least
        or moved > config.stuck_gap_m
    ):
        state.stuck_tick = state.tick
        state.stuck_gap = gap
        state.stuck_target[:] = frame.target
        state.stuck_hands[:] = state.hands[:, 0]
        if gap < config.stuck_gap_m or moved > config.stuck_gap_m:
            state.way_tried = 0
        return 0
    return NOTICED if passed_s >= config.stuck_s else 0


@compiled
def _is_outside(joints: Vector, config: Struct) -> bool:
    """True if a joint (J,) [rad] is outside its limits."""
    for j in range(len(joints)):
        if joints[j] < config.lower[j] or joints[j] > config.upper[j]:
            return True
    return False


@compiled
def measured_error(state: Struct, kinematics: Struct, config: Struct) -> tuple[float, float]:
    """Largest joint error [rad] and speed of the tool [m/s], as measured:

        error = max_j |q_j - measured_j| / per_rad_j,   speed = |J_p measured_velocities|

    q and J_p, the first three rows of `tasks`, are the commanded joints (J,) and the tool's
    Jacobian there.
    """
    error = 0.0
    for joint in range(len(kinematics.joints)):
        error = max(
            error,
            abs(kinematics.joints[joint] - state.measured[joint]) / config.per_rad[joint],
        )
    return error, norm(times(kinematics.tasks[:3], state.measured_velocities))
