"""The path through the poses that a policy wishes, each due at a time, and the target that follows
it without a step where the path changes.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.codes import (
    AHEAD,
    BY_SKILL,
    BY_WISHES,
    NOT_A_ROTATION,
    NOT_FINITE,
    OLDER,
    OUT_OF_RANGE,
)
from thirdhand.core.frame import Record, Records, Struct, Vector
from thirdhand.core.geometry import normalise, turn_between, turn_on
from thirdhand.core.vectors import (
    add_product,
    dot,
    norm,
    square,
    squared_distance,
    times,
    transform,
)
from thirdhand.core.wish import MOST_WISHES
from thirdhand.core.wish.tuning import FADING_SHARE, RETAINED


def newest_due(state: Record) -> int:
    """The tick at which the newest wish came, or the last one is due, if that is later; -1 if none
    has come yet. `state` has the fields of `core.wish`.
    """
    if (newest := int(state["wish_tick"])) < 0:
        return newest
    return max(newest, int(state["wish_due"][state["wish_count"] - 1]))


@compiled
def take(
    wishes: Records,
    rules: Records,
    tick: int,
    ahead_s: float,
    position: tuple[float, float, float],
    orientation: tuple[float, float, float, float],
    mapping: Vector,
    covariance: Vector,
) -> int:
    """Take a pose, due `ahead_s` after the tick, and its covariance (6, 6), zeros if unknown, into
    the state. `mapping` (4, 4) has axes, unit and origin of its frame in frame base, and in its
    last row the turn of these axes, a rotation vector.

    Returns the cause for which it is rejected, or -1.
    """
    wish = wishes[0]
    rule = rules[0]
    pose = np.empty(7)
    transform(mapping[:3, :3], mapping[:3, 3], position, pose)
    pose[3:] = orientation
    cause = _fault(rule, pose, ahead_s, covariance)
    if cause >= 0:
        return cause
    normalise(pose[3:])
    turn_on(pose[3:], mapping[3, :3])
    due = tick + ahead_s / rule.period_s
    if not _insert(wish, rule, tick, due, pose):
        return AHEAD
    _carry(covariance[:3, :3], mapping, 1.0, rule.unknown_std_m**2, wish.wish_covariances[:3])
    unit = norm(mapping[0, :3])
    _carry(
        covariance[3:, 3:], mapping, 1.0 / unit, rule.unknown_std_rad**2, wish.wish_covariances[3:]
    )
    wish.wish_tick = tick
    return -1


@compiled
def _fault(rule: Struct, pose: Vector, ahead_s: float, covariance: Vector) -> int:
    """Cause for which a pose (7,) in frame base is rejected, or -1."""
    if not (np.isfinite(pose).all() and np.isfinite(covariance).all()):
        return NOT_FINITE
    for i in range(6):
        if not 0.0 <= covariance[i, i] <= rule.largest_variance:
            return NOT_FINITE
        for j in range(i):
            most = covariance[i, i] * covariance[j, j]
            if covariance[i, j] ** 2 > (1.0 + 1e-9) * most:
                return NOT_FINITE
    length = math.sqrt(square(pose[3:6]) + pose[6] * pose[6])
    if abs(length - 1.0) > rule.norm_tolerance:
        return NOT_A_ROTATION
    if square(pose[:3]) > rule.farthest_m**2:
        return OUT_OF_RANGE
    if ahead_s > rule.farthest_s:
        return AHEAD
    return OLDER if ahead_s < -rule.latest_s else -1


@compiled
def _carry(covariance: Vector, mapping: Vector, scale: float, unknown: float, out: Vector) -> None:
    """Write into out (3, 3) the covariance (3, 3) in frame base, s² M C Mᵀ; `unknown` times the
    identity for one of zeros.
    """
    out[:] = 0.0
    if covariance[0, 0] + covariance[1, 1] + covariance[2, 2] == 0.0:
        for i in range(3):
            out[i, i] = unknown
        return
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for n in range(3):
                    out[i, j] += scale**2 * mapping[i, k] * covariance[k, n] * mapping[j, n]


@compiled
def _insert(wish: Struct, rule: Struct, tick: int, due: float, pose: Vector) -> bool:
    """Put a pose (7,) that is due at the tick `due` into the path. False if there is no room.

    Where an earlier chunk has the path x already, until a time u after the tick, the pose p that is
    due after t becomes (1 - t/u) (x + p) / 2 + t/u p. Poses of earlier chunks between two of one
    chunk are dropped, and so are those nearer than nearest_ticks; those after its end stay. A pose
    that follows the one before it by less than nearest_ticks is left out. One farther than leap_m
    from the path is noted as a leap, from the pose before it on; where the path has ended, leap_mps
    is added for the time since.
    """
    count = _forget_passed(wish, wish.wish_count, tick)
    wish.wish_count = count
    since = due - wish.wish_newest_due
    if count and 0.0 <= since < rule.nearest_ticks - 1e-6:
        return True
    if count == MOST_WISHES:
        return False
    if count:
        _merge(wish, rule, tick, due, pose)

    begin = wish.wish_newest_due if since > 0.0 else due - rule.nearest_ticks
    wish.wish_newest_due = due
    place = 0
    for i in range(count):
        if not begin < wish.wish_due[i] < due + rule.nearest_ticks:
            wish.wish_due[place] = wish.wish_due[i]
            wish.wish_poses[place] = wish.wish_poses[i]
            place += 1
    count = place

    while place and wish.wish_due[place - 1] > due:
        wish.wish_due[place] = wish.wish_due[place - 1]
        wish.wish_poses[place] = wish.wish_poses[place - 1]
        place -= 1
    wish.wish_due[place] = due
    wish.wish_poses[place] = pose
    wish.wish_count = count + 1
    wish.wish_is_new = 1
    return True


@compiled
def _merge(wish: Struct, rule: Struct, tick: int, due: float, pose: Vector) -> None:
    """Replace a pose (7,) by its mean with the path of earlier chunks, or note a leap; see
    `_insert`.
    """
    motion = np.empty((3, 6))
    quaternion = np.empty(4)
    at(wish, rule, due, motion, quaternion)
    last_due = wish.wish_due[wish.wish_count - 1]
    leap_m = rule.leap_m + rule.leap_mps * max(due - last_due, 0.0) * rule.period_s
    if squared_distance(pose[:3], motion[0, :3]) > leap_m * leap_m:
        begin = float(tick)
        for i in range(wish.wish_count):
            if wish.wish_due[i] < due:
                begin = max(begin, wish.wish_due[i])
        if tick < wish.wish_leap[1]:
            begin = min(begin, wish.wish_leap[0])
        wish.wish_leap[0] = begin
        wish.wish_leap[1] = max(wish.wish_leap[1], max(due, float(tick)) + rule.leap_ticks)
        return
    if wish.wish_due[0] <= due <= last_due:
        ahead = max(due - tick, 0.0) / max(last_due - tick, 1.0)
        share = 0.5 * (1.0 + min(ahead, 1.0))
        turn = np.empty(3)
        turn_between(quaternion, pose[3:], turn)
        for axis in range(3):
            pose[axis] = motion[0, axis] + share * (pose[axis] - motion[0, axis])
            turn[axis] *= share
        turn_on(quaternion, turn)
        pose[3:] = quaternion


@compiled
def _forget_passed(wish: Struct, count: int, tick: int) -> int:
    """Drop the poses that no velocity is estimated from any more. Returns how many are left."""
    first = 0
    while count - first > RETAINED and wish.wish_due[first + RETAINED] <= tick:
        first += 1
    if first:
        for i in range(first, count):
            wish.wish_due[i - first] = wish.wish_due[i]
            wish.wish_poses[i - first] = wish.wish_poses[i]
    return count - first


@compiled
def _slope(wish: Struct, i: int, axis: int, steady_ticks: float) -> float:
    """Slope [m/tick] of the path at its pose i along an axis: that of the line between the poses
    around it; at the end, that of the line that fits the poses of the last steady_ticks best.
    """
    due = wish.wish_due
    poses = wish.wish_poses
    count = wish.wish_count
    if count < 2:
        return 0.0
    if i + 1 < count:
        before = max(i - 1, 0)
        rise_m = poses[i + 1, axis] - poses[before, axis]
        return float(rise_m / (due[i + 1] - due[before]))

    first = count - 2
    while first > max(count - RETAINED, 0) and due[i] - due[first - 1] <= steady_ticks:
        first -= 1
    mean_due = 0.0
    mean = 0.0
    for k in range(first, count):
        mean_due += (due[k] - due[i]) / (count - first)
        mean += (poses[k, axis] - poses[i, axis]) / (count - first)
    covered = 0.0
    moved = 0.0
    for k in range(first, count):
        late = due[k] - due[i] - mean_due
        covered += late * late
        moved += late * (poses[k, axis] - poses[i, axis] - mean)
    return float(moved / covered)


@compiled
def at(wish: Struct, rule: Struct, due: float, motion: Vector, quaternion: Vector) -> None:
    """The path at the time `due` [ticks]: position and its derivatives [m, s] in the first three
    columns of `motion` (3, 6), angular velocity [rad/s] in row 1 of the others; orientation in
    `quaternion` (4,).

    Between two poses p_i and p_(i+1), h ticks apart, it is a cubic with the slopes m_i of `_slope`,
    with s = (due - t_i) / h:

        p_i (2s³ - 3s² + 1) + p_(i+1) (3s² - 2s³) + h m_i (s³ - 2s² + s) + h m_(i+1) (s³ - s²)

    and the orientation turns evenly. After the last pose it goes on for steady_ticks, as the next
    pose may be late, and comes to rest evenly within as long.
    """
    last = wish.wish_count - 1
    motion[:] = 0.0
    if due <= wish.wish_due[0] or last == 0:
        motion[0, :3] = wish.wish_poses[0, :3]
        quaternion[:] = wish.wish_poses[0, 3:]
        return
    if due >= wish.wish_due[last]:
        _beyond(wish, rule, due - wish.wish_due[last], motion)
        quaternion[:] = wish.wish_poses[last, 3:]
        return

    i = 0
    while wish.wish_due[i + 1] <= due:
        i += 1
    h = wish.wish_due[i + 1] - wish.wish_due[i]
    s = (due - wish.wish_due[i]) / h
    h_s = h * rule.period_s
    for axis in range(3):
        start = wish.wish_poses[i, axis]
        rise = wish.wish_poses[i + 1, axis] - start
        begin = h * _slope(wish, i, axis, rule.steady_ticks)
        end = h * _slope(wish, i + 1, axis, rule.steady_ticks)
        cubic = begin + end - 2.0 * rise
        bend = 3.0 * rise - 2.0 * begin - end
        motion[0, axis] = start + s * (begin + s * (bend + s * cubic))
        motion[1, axis] = (begin + s * (2.0 * bend + 3.0 * s * cubic)) / h_s
        motion[2, axis] = (2.0 * bend + 6.0 * s * cubic) / (h_s * h_s)
    turn = np.empty(3)
    turn_between(wish.wish_poses[i, 3:], wish.wish_poses[i + 1, 3:], turn)
    for axis in range(3):
        motion[1, 3 + axis] = turn[axis] / h_s
        turn[axis] *= s
    quaternion[:] = wish.wish_poses[i, 3:]
    turn_on(quaternion, turn)


@compiled
def _beyond(wish: Struct, rule: Struct, passed: float, motion: Vector) -> None:
    """The path `passed` ticks after its last pose, written to `motion` as by `at`."""
    last = wish.wish_count - 1
    h = rule.steady_ticks
    slowing = min(max(passed - h, 0.0), h)
    gone = min(passed, h) + slowing - 0.5 * slowing * slowing / h
    share = 1.0 - slowing / h
    for axis in range(3):
        slope = _slope(wish, last, axis, rule.steady_ticks)
        motion[0, axis] = wish.wish_poses[last, axis] + slope * gone
        motion[1, axis] = slope * share / rule.period_s


@compiled
def lead(wishes: Records, rules: Records, frames: Records, tick: int, sources: int) -> None:
    """Write the target of this tick into the frame, from what leads: the path of the wishes, the
    skill's prediction, which the frame has already, or both, by `_weigh`.
    """
    wish = wishes[0]
    frame = frames[0]
    motion = np.zeros((3, 6))
    quaternion = np.empty(4)
    if sources & BY_WISHES:
        at(wish, rules[0], float(tick), motion, quaternion)
        if sources & BY_SKILL:
            _weigh(wish, frame, motion, quaternion)
        else:
            frame.covariance[:] = wish.wish_covariances[:3]
            frame.orientation_covariance[:] = wish.wish_covariances[3:]
    else:
        motion[0, :3] = frame.target
        motion[1, :3] = frame.target_velocity
        motion[2, :3] = frame.target_acceleration
        motion[1, 3:] = frame.turning
        quaternion[:] = frame.orientation

    _join(wish, rules[0], tick, sources, motion, quaternion)
    frame.target[:] = motion[0, :3]
    frame.target_velocity[:] = motion[1, :3]
    frame.target_acceleration[:] = motion[2, :3]
    frame.turning[:] = motion[1, 3:]
    frame.orientation[:] = quaternion


@compiled
def _weigh(wish: Struct, frame: Struct, motion: Vector, quaternion: Vector) -> None:
    """Replace the wishes' `motion` and `quaternion` by their product with the skill's prediction in
    the frame, as that of two Gaussians with the covariances A of the skill and B of the wishes:

        W = A (A + B)⁻¹,   x = x_A + W (x_B - x_A),   C = A - W A

    W is constant where it is differentiated. Orientations are weighed by tr A / (tr A + tr B); a
    skill that has learned none leaves it to the wishes.
    """
    skill = frame.covariance
    weight = _gain(skill, wish.wish_covariances[:3])
    less = np.zeros((3, 3))
    add_product(weight, skill, less)
    difference = motion[:, :3].copy()
    difference[0] -= frame.target
    difference[1] -= frame.target_velocity
    difference[2] -= frame.target_acceleration
    motion[0, :3] = frame.target + times(weight, difference[0])
    motion[1, :3] = frame.target_velocity + times(weight, difference[1])
    motion[2, :3] = frame.target_acceleration + times(weight, difference[2])
    frame.covariance -= less
    _weigh_turn(wish, frame, motion, quaternion)


@compiled
def _gain(skill: Vector, wish: Vector) -> Vector:
    """W = A (A + B)⁻¹ (3, 3) of two covariances A and B (3, 3), by the adjugate."""
    total = skill + wish
    for i in range(3):
        total[i, i] += 1e-12  # [m²] a micrometre: sure of the same plane, they have an inverse
    inverse = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            c = (i + 1) % 3
            d = (i + 2) % 3
            inverse[i, j] = total[a, c] * total[b, d] - total[a, d] * total[b, c]
    inverse /= dot(total[0], inverse[:, 0])
    gain = np.zeros((3, 3))
    add_product(skill, inverse, gain)
    return gain


@compiled
def _weigh_turn(wish: Struct, frame: Struct, motion: Vector, quaternion: Vector) -> None:
    """The part of `_weigh` that concerns the orientation."""
    variance = 0.0
    total_variance = 0.0
    for i in range(3):
        variance += frame.orientation_covariance[i, i]
        total_variance += frame.orientation_covariance[i, i] + wish.wish_covariances[3 + i, i]
    if variance == 0.0:
        frame.orientation_covariance[:] = wish.wish_covariances[3:]
        return

    share = variance / total_variance
    turn = np.empty(3)
    turn_between(frame.orientation, quaternion, turn)
    turn *= share
    quaternion[:] = frame.orientation
    turn_on(quaternion, turn)
    for i in range(3):
        motion[1, 3 + i] = frame.turning[i] + share * (motion[1, 3 + i] - frame.turning[i])
    frame.orientation_covariance *= 1.0 - share


@compiled
def _join(
    wish: Struct, rule: Struct, tick: int, sources: int, motion: Vector, quaternion: Vector
) -> None:
    """Make the target of this tick from what leads now, `motion` (3, 6) and `quaternion` (4,) as
    written by `at`: an offset d is added, which fades out.

    Where the path has begun or changed, where something else leads (`sources` differs) or where
    ticks were missed, d is set so that the target goes on from the one before, position, velocity
    and acceleration. From then on it obeys

        d''' = -w³ d - 3 w² d' - 3 w d'',   w = min(fade_rate_per_s, fade_mps / (2 / e² |d|))

    whose largest speed from rest is fade_mps; rotations count with rad_as_m. Its solution is

        d(t) = (d + c1 t + c2 t²/2) e^(-w t),   c1 = d' + w d,   c2 = d'' + 2 w d' + w² d

    After a gap longer than goes_on_s the path is followed as it is.
    """
    offset = wish.wish_offset
    passed_s = (tick - wish.wish_told_tick) * rule.period_s
    changed = wish.wish_is_new or sources != wish.wish_sources
    if wish.wish_count and sources != BY_SKILL:
        changed = changed or wish.wish_told_tick < wish.wish_due[0] <= tick  # the path begins
    if changed or tick != wish.wish_told_tick + 1:
        _begin_offset(wish, rule, passed_s, motion, quaternion)
    _fade(offset, wish.wish_rate, min(passed_s, rule.goes_on_s))

    motion += offset
    turn_on(quaternion, offset[0, 3:])
    wish.wish_told[:3] = motion[:, :3]
    wish.wish_told[3] = motion[1, 3:]
    wish.wish_turn[:] = quaternion
    wish.wish_told_tick = tick
    wish.wish_sources = sources
    wish.wish_is_new = 0


@compiled
def _begin_offset(
    wish: Struct, rule: Struct, passed_s: float, motion: Vector, quaternion: Vector
) -> None:
    """Set the offset of `passed_s` ago and its rate, so that the target goes on from then."""
    offset = wish.wish_offset
    if passed_s > rule.goes_on_s:
        offset[:] = 0.0
        wish.wish_rate = rule.fade_rate_per_s
        return
    told = wish.wish_told
    for axis in range(3):
        # what leads now, as it was then
        speed = motion[1, axis] - passed_s * motion[2, axis]
        position = motion[0, axis] - passed_s * (speed + 0.5 * passed_s * motion[2, axis])
        offset[0, axis] = told[0, axis] - position
        offset[1, axis] = told[1, axis] - speed
        offset[2, axis] = told[2, axis] - motion[2, axis]
        offset[1, 3 + axis] = told[3, axis] - motion[1, 3 + axis]
    before = quaternion.copy()
    step = -passed_s * motion[1, 3:]
    turn_on(before, step)
    turn_between(before, wish.wish_turn, offset[0, 3:])
    turn = offset[0, 3:]
    away_m = math.sqrt(square(offset[0, :3]) + rule.rad_as_m**2 * square(turn))
    wish.wish_rate = rule.fade_rate_per_s
    if away_m * FADING_SHARE * rule.fade_rate_per_s > rule.fade_mps:
        wish.wish_rate = rule.fade_mps / (FADING_SHARE * away_m)


@compiled
def _fade(offset: Vector, w: float, t: float) -> None:
    """Advance an offset (3, 6), value and two derivatives, by a time t [s], see `_join`."""
    fading = exp(-w * t)
    for axis in range(6):
        c0 = offset[0, axis]
        c1 = offset[1, axis] + w * c0
        c2 = offset[2, axis] + w * (2.0 * offset[1, axis] + w * c0)
        value = c0 + t * (c1 + 0.5 * t * c2)
        slope = c1 + t * c2
        offset[0, axis] = fading * value
        offset[1, axis] = fading * (slope - w * value)
        offset[2, axis] = fading * (c2 - w * (2.0 * slope - w * value))
