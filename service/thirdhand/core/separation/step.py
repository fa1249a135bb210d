"""Compiled step of separation: from hands and posture to inequalities in joint velocity."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.frame import Records, Struct, Vector
from thirdhand.core.geometry import between_segments, carry_back, nearest_to_box, place, to_box
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.core.separation.clearance import ITSELF, PEOPLE, THINGS
from thirdhand.core.vectors import norm

# figures of a step: nearest_m, speed_limit, setpoint_share
NEAREST, SPEED_LIMIT, SETPOINT_SHARE = range(3)

Scene: TypeAlias = tuple[Struct, Struct, Struct, Records, Records, Records, Vector]
"""State, kinematics, parameters, capsules, contacts and constraints of a step; and `near` (9,) [m],
in which `geometry` writes the nearest points of two shapes and the unit normal between them.
"""

Approach: TypeAlias = tuple[bool, Vector, float, float, float, float]
"""A hand: is its velocity known; velocity (3,) [m/s]; faster_by [m/s] and nearer_by [m], its
possible motion while unseen; contact_speed and braked [m/s], see `step`."""


@compiled
def allowed_speed(
    distance: float, hand_speed: float, brake: float, reaction: float, clearance: float
) -> float:
    """Largest speed v [m/s] toward an object, from which a stop still ends at the clearance.

    The object is at the distance d and approaches with constant speed u = `hand_speed`. The arm
    moves on for the reaction time T, then brakes with B. It keeps the clearance c if

        d - c = (v + u) T + v² / 2B + u v / B,

        v = max(0, sqrt(u² + (B T)² + 2 B (d - c)) - B T - u)
    """
    square = hand_speed**2 + (brake * reaction) ** 2 + 2.0 * brake * (distance - clearance)
    return max(0.0, math.sqrt(max(square, 0.0)) - brake * reaction - hand_speed)


@compiled
def step(
    states: Records,
    heres: Records,
    parameters: Records,
    capsules: Records,
    pairs: Vector,
    boxes: Vector,
    contacts: Records,
    constraints: Records,
) -> tuple[int, float, float, float]:
    """Write the constraints; return their number, nearest_m, speed_limit and setpoint_share.

    For the nearest points p1, p2 of two capsules (or of a capsule and a box), with the unit normal
    n from p1 to p2 and the distance d of the surfaces, a constraint is

        row · dq <= limit,    row = n^T (dp1/dq - dp2/dq)    [m/s]

    where p2 of a hand or a box does not depend on q. With s = `allowed_speed`, the limits are

        hands           allowed = max(contact, s(d, u)) + braked + slip_speed_mps
                        planned = `_planned`(d, u)
        boxes, itself   `_limit`

    u is the speed of the hand toward the part: the measured one, or unknown_speed for a hand that
    was just seen. contact is contact_speed for the tool's part near a hand that may be touched,
    else 0.

    A moving hand is also evaluated at the times h = moving lookahead_s, with moving = `_swiftness`
    in 0 ... 1. The joints are then at q + h dq, and the hand is, with τ = brake_ramp_s, at

        p + h v + τ (h - f) a,    with the velocity v + f a,    f = τ (1 - exp(-h / τ))

    braked = brake max(h - brake_ramp_s, 0) is the speed [m/s] that the arm can brake until then.

    A hand that has been out of sight for t seconds longer than it may be is assumed to accelerate
    toward the arm by g = unseen_acceleration_mps2 during t: u grows by w = min(g t, unknown_speed),
    d shrinks by w (t - w / 2g). After a correction, d also shrinks by `hand_doubt_m`, and u is
    unknown_speed.

    Only constraints that the joints can violate are kept.
    """
    state = states[0]
    kinematics = heres[0]
    config = parameters[0]
    scene = (state, kinematics, config, capsules, contacts, constraints, np.empty(9))
    placed = np.empty((2, len(capsules), 2, 3))  # ends of the capsules: now, and at a later time
    place(kinematics.joints, config.frames, config.axes, capsules, placed[0])
    figures = np.empty(3)
    figures[NEAREST] = FARTHEST_REPORTED_M
    figures[SPEED_LIMIT] = _fastest(capsules)
    figures[SETPOINT_SHARE] = 1.0

    count = 0
    for side in range(2):
        if state.hand_ticks[side] >= 0:
            count = _keep_from_hand(scene, side, count, placed, figures)
    count = _keep_from_boxes(scene, boxes, count, placed[0], figures)
    count = _keep_from_itself(scene, pairs, count, placed[0])
    return count, figures[NEAREST], figures[SPEED_LIMIT], figures[SETPOINT_SHARE]


@compiled
def _fastest(capsules: Records) -> float:
    """Largest speed [m/s] of any part."""
    speed: float = capsules[0].max_speed
    for capsule in range(len(capsules)):
        speed = max(speed, capsules[capsule].max_speed)
    return speed


@compiled
def _keep_from_hand(scene: Scene, side: int, count: int, placed: Vector, figures: Vector) -> int:
    """Write the constraints of one hand, after the first `count`; return the number of all.

    `placed` (2, C, 2, 3) [m] has the capsules' ends now, and is filled for a later time.
    """
    state, kinematics, config, capsules, contacts, _, _ = scene

    # What is known of the hand: its velocity, and how much faster and nearer it may be.
    is_known = _is_velocity_known(state, config, side)
    is_touched = _receives(contacts, state.hands, side, config.contact_margin_m)
    contact_speed = config.contact_speed if is_touched else 0.0
    faster_by, nearer_by = _while_unseen(state, config, side)
    moving = _swiftness(state.hands[side, 1], config.tremor_speed) if is_known else 0.0

    later = np.empty(len(kinematics.joints))
    forearm = np.empty((2, 3))
    velocity = np.empty(3)
    for k in range(len(config.lookahead_s) if moving > 0.0 else 1):
        ahead_s = moving * config.lookahead_s[k]
        if k > 0:
            for j in range(len(later)):
                later[j] = kinematics.joints[j] + ahead_s * state.joints[1, j]
            place(later, config.frames, config.axes, capsules, placed[1])
        _move_hand(state, config, side, ahead_s, forearm, velocity)
        braked = config.brake[PEOPLE] * max(ahead_s - config.brake_ramp_s, 0.0)
        approach = (is_known, velocity, faster_by, nearer_by, contact_speed, braked)
        parts = placed[1] if k > 0 else placed[0]
        count = _keep_parts(scene, k > 0, forearm, approach, count, parts, placed[0], figures)
    return count


@compiled
def _is_velocity_known(state: Struct, config: Struct, side: int) -> bool:
    """True if a hand's velocity is certain enough, and the hand was not corrected lately."""
    variance = 0.0
    for mode in range(state.mode_probabilities.shape[1]):
        variance += state.mode_probabilities[side, mode] * state.mode_covariances[side, mode, 1, 1]
    limit = config.unknown_velocity_std_mps
    return bool(variance <= limit * limit and state.hand_doubt_m[side] == 0.0)


@compiled
def _while_unseen(state: Struct, config: Struct, side: int) -> tuple[float, float]:
    """The speed [m/s] that an unseen hand may have gained, and the distance [m] it may be nearer.

    These are w and hand_doubt_m + w (t - w / 2g), with the hand's largest acceleration g, the time
    t unseen and w = g t, at most the unknown speed.
    """
    age_s = (state.tick - state.hand_ticks[side]) * config.period_s
    is_unseen = config.unseen_s[0] < age_s < config.unseen_s[1]
    unseen_s = age_s - config.unseen_s[0] if is_unseen else 0.0
    faster_by = min(config.unseen_acceleration_mps2 * unseen_s, config.unknown_speed)
    way_m = faster_by * (unseen_s - 0.5 * faster_by / config.unseen_acceleration_mps2)
    return faster_by, state.hand_doubt_m[side] + way_m


@compiled
def _move_hand(
    state: Struct,
    config: Struct,
    side: int,
    ahead_s: float,
    forearm: Vector,
    velocity: Vector,
) -> None:
    """Set the ends (2, 3) [m] of a hand's forearm, and its velocity (3,) [m/s], at a time ahead."""
    hand = state.hands[side]
    accelerated_s = config.brake_ramp_s * (1.0 - exp(-ahead_s / config.brake_ramp_s))
    for i in range(3):
        speed = hand[1, i]
        acceleration = hand[2, i]
        velocity[i] = speed + accelerated_s * acceleration
        moved = ahead_s * speed + config.brake_ramp_s * (ahead_s - accelerated_s) * acceleration
        forearm[0, i] = hand[0, i] + moved
        forearm[1, i] = forearm[0, i] + config.forearm[i]


@compiled
def _keep_parts(
    scene: Scene,
    is_later: bool,
    forearm: Vector,
    approach: Approach,
    count: int,
    parts: Vector,
    parts_now: Vector,
    figures: Vector,
) -> int:
    """Write the constraints of the parts near a hand; return the number of all constraints.

    `parts` and `parts_now` (C, 2, 3) [m] have the capsules' ends at the time of the forearm (2, 3),
    and now.
    """
    state, kinematics, config, capsules, _, constraints, near = scene
    is_known, velocity, faster_by, nearer_by, contact_speed, braked = approach
    for capsule in range(config.first, len(capsules)):
        part = capsules[capsule]
        is_tool = part.link == len(kinematics.joints)
        distance = between_segments(parts[capsule], forearm, near) - part.radius
        distance -= config.hand_radius
        if not is_later:
            figures[NEAREST] = min(figures[NEAREST], distance)
        distance -= nearer_by

        # The speed of the hand toward the part, and the speed that the rule allows the part.
        coming = config.unknown_speed
        if is_known:
            coming = max(-_along(near, velocity), 0.0) + faster_by
        least = contact_speed if is_tool else 0.0
        planned = _planned(config, PEOPLE, distance, coming, least, braked)
        if is_later and planned >= part.max_speed:
            continue
        allowed = max(least, _allowed(config, PEOPLE, distance, coming))
        if not is_later:
            figures[SPEED_LIMIT] = min(figures[SPEED_LIMIT], allowed)
        if planned >= part.max_speed:
            continue

        constraint = constraints[count]
        constraint.planned = planned
        constraint.allowed = allowed + braked + config.slip_speed_mps
        if is_later:
            carry_back(near, parts[capsule], parts_now[capsule])
        _bring_together(constraints, count, near, 0, kinematics, part.link, 1.0)
        if is_tool:
            share = _share(near, planned, state.setpoint[1])
            figures[SETPOINT_SHARE] = min(figures[SETPOINT_SHARE], share)
        count += _may_pass(constraints, count, planned, config.max_velocity)
    return count


@compiled
def _keep_from_boxes(
    scene: Scene, boxes: Vector, count: int, placed: Vector, figures: Vector
) -> int:
    """Write the constraints of the boxes (B, ...), after the first `count`; return the number of
    all. `placed` (C, 2, 3) [m] has the capsules' ends.
    """
    state, kinematics, config, capsules, _, constraints, near = scene
    for capsule in range(config.first, len(capsules)):
        part = capsules[capsule]
        for box in range(len(boxes)):
            inner = nearest_to_box(placed[capsule], boxes[box])
            # 0: the nearest point; 1, 2: the ends, because a capsule along a face may tip
            for point in range(3):
                share = inner if point == 0 else point - 1.0
                distance = to_box(placed[capsule], share, boxes[box], near) - part.radius
                planned = _planned(config, THINGS, distance, 0.0, 0.0, 0.0)
                is_repeated = point > 0 and share == inner
                if is_repeated or planned >= part.max_speed:
                    continue
                _bring_together(constraints, count, near, 0, kinematics, part.link, 1.0)
                planned = _limit(constraints, count, config, THINGS, distance, planned)
                if part.link == len(kinematics.joints):
                    figures[SETPOINT_SHARE] = min(
                        figures[SETPOINT_SHARE], _share(near, planned, state.setpoint[1])
                    )
                count += _may_pass(constraints, count, planned, config.max_velocity)
    return count


@compiled
def _keep_from_itself(scene: Scene, pairs: Vector, count: int, placed: Vector) -> int:
    """Write the constraints of pairs (P, 2) of parts, after the first `count`; return the number of
    all. `placed` (C, 2, 3) [m] has the capsules' ends.
    """
    _, kinematics, config, capsules, _, constraints, near = scene
    for pair in range(len(pairs)):
        first = capsules[pairs[pair, 0]]
        second = capsules[pairs[pair, 1]]
        distance = between_segments(placed[pairs[pair, 0]], placed[pairs[pair, 1]], near)
        distance = distance - first.radius - second.radius
        planned = _planned(config, ITSELF, distance, 0.0, 0.0, 0.0)
        if planned < first.max_speed + second.max_speed:
            _bring_together(constraints, count, near, 0, kinematics, first.link, 1.0)
            _bring_together(constraints, count, near, 3, kinematics, second.link, -1.0)
            planned = _limit(constraints, count, config, ITSELF, distance, planned)
            count += _may_pass(constraints, count, planned, config.max_velocity)
    return count


@compiled
def _along(near: Vector, velocity: Vector) -> float:
    """Speed [m/s] of a velocity (3,) along the normal."""
    speed: float = near[6] * velocity[0] + near[7] * velocity[1] + near[8] * velocity[2]
    return speed


@compiled
def _allowed(config: Struct, rule: int, distance: float, coming: float) -> float:
    """Speed [m/s] that the rule (PEOPLE, THINGS or ITSELF) allows at this distance [m]."""
    return allowed_speed(
        distance, coming, config.brake[rule], config.reaction_s[rule], config.clearance[rule]
    )


@compiled
def _planned(
    config: Struct, rule: int, distance: float, coming: float, least: float, braked: float
) -> float:
    """Speed [m/s] that motion is planned with: lower than what the rule allows.

        max(planned_brake_share least, allowed_speed) + planned_brake_share braked

    with the planned brake and reaction time, and with the planned margin added to the clearance.
    """
    brake = config.planned_brake[rule]
    reaction_s = config.planned_reaction_s[rule]
    planned = allowed_speed(
        distance, coming, brake, reaction_s, config.clearance[rule] + config.planned_margin
    )
    share: float = config.planned_brake_share
    return max(share * least, planned) + share * braked


@compiled
def _limit(
    constraints: Records, k: int, config: Struct, rule: int, distance: float, planned: float
) -> float:
    """Set the limits of constraint k to a thing or another part; return the planned speed [m/s].

        left    = distance - clearance
        allowed = allowed_speed(distance) + slip_speed_mps min(max(1 + left / slip_depth_m, 0.1), 1)
        planned = min(planned, max(clearance_gain_per_s left, -retreat_speed_mps))

    Inside of the clearance `planned` is negative: the parts return. It is 0 if the joints cannot
    move them at retreat_authority_mps.
    """
    constraint = constraints[k]
    left = distance - config.clearance[rule]
    slip = min(max(1.0 + left / config.slip_depth_m, 0.1), 1.0) * config.slip_speed_mps
    constraint.allowed = _allowed(config, rule, distance, 0.0) + slip
    planned = min(planned, max(config.clearance_gain_per_s * left, -config.retreat_speed_mps))
    if planned < 0.0 and not _may_pass(
        constraints, k, config.retreat_authority_mps, config.max_velocity
    ):
        planned = 0.0
    constraint.planned = planned
    return planned


@compiled
def _may_pass(constraints: Records, k: int, limit: float, max_velocity: Vector) -> int:
    """1 if the joints can exceed a limit along row k, sum of |row_j| max_velocity_j > limit."""
    most = 0.0
    for j in range(len(max_velocity)):
        most += abs(constraints[k].row[j]) * max_velocity[j]
    return 1 if most > limit else 0


@compiled
def _swiftness(velocity: Vector, tremor_speed: float) -> float:
    """Share of motion: 0 for a hand that rests or trembles, 1 from twice the tremor speed on.

    |velocity| / tremor_speed - 1, limited to 0 ... 1
    """
    return min(max(norm(velocity) / tremor_speed - 1.0, 0.0), 1.0)


@compiled
def _share(near: Vector, limit: float, velocity: Vector) -> float:
    """Largest share, at most 1, of a velocity (3,) that keeps a limit along the normal."""
    speed = _along(near, velocity)
    limit = max(limit, 0.0)
    return limit / speed if speed > limit else 1.0


@compiled
def _receives(contacts: Records, hands: Vector, side: int, margin_m: float) -> bool:
    """True if the hands are at a via-point where the tool goes with the hand of this side.

    Each coordinate of both hands is within the via-point's radius and `margin_m`.
    """
    for contact in contacts:
        if contact.side == side:
            far = 0.0
            for hand in range(2):
                for i in range(3):
                    far = max(far, abs(hands[hand, 0, i] - contact.hands[hand, i]))
            if far <= contact.radius + margin_m:
                return True
    return False


@compiled
def _bring_together(
    constraints: Records, k: int, near: Vector, at: int, kinematics: Struct, link: int, sign: float
) -> None:
    """Add to row k the speed along the normal of the point p = near[at:at + 3] of a link.

        row_j += sign n · (v_j + w_j × (p - tool)),    j = 0 ... link - 1

    v_j and w_j are the linear and angular columns of the tool's Jacobian, n = near[6:9]. A positive
    sign first sets the row to 0.
    """
    row = constraints[k].row
    tool = kinematics.position
    jacobian = kinematics.jacobian
    if sign > 0.0:
        row[:] = 0.0
    x = near[at] - tool[0]
    y = near[at + 1] - tool[1]
    z = near[at + 2] - tool[2]
    n0 = near[6]
    n1 = near[7]
    n2 = near[8]
    for j in range(link):
        wx = jacobian[3, j]
        wy = jacobian[4, j]
        wz = jacobian[5, j]
        speed = n0 * (jacobian[0, j] + wy * z - wz * y)
        speed += n1 * (jacobian[1, j] + wz * x - wx * z)
        speed += n2 * (jacobian[2, j] + wx * y - wy * x)
        row[j] += sign * speed


@compiled
def share_of(constraints: Records, count: int, velocity: Vector, parameters: Records) -> float:
    """Largest share, at most 1, of joint velocities (J,) that keeps all planned limits.

    min over k of max(planned_k, slip_speed_mps / 2) / (row_k · velocity)
    """
    share = 1.0
    for k in range(count):
        speed = 0.0
        for j in range(len(velocity)):
            speed += constraints[k].row[j] * velocity[j]
        limit = max(constraints[k].planned, 0.5 * parameters[0].slip_speed_mps)
        if speed > limit:
            share = min(share, limit / speed)
    return share


@compiled
def excess_of(
    constraints: Records, count: int, dq: Vector, ddq: Vector, jerk: Vector
) -> tuple[float, int]:
    """`Separation.excess`, and the number of the constraint with the largest excess."""
    most = -math.inf
    number = 0
    for k in range(count):
        constraint = constraints[k]
        now = crest = 0.0
        for j in range(len(dq)):
            now += constraint.row[j] * dq[j]
            crest += constraint.row[j] * (dq[j] + ddq[j] * abs(ddq[j]) / (2.0 * jerk[j]))
        if max(now, crest) - constraint.allowed > most:
            most = max(now, crest) - constraint.allowed
            number = k
    return most, number
