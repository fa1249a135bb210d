"""The bounds of docs/bounds.md, each computed from the frames of a session.

A bound is a function that returns its excess for each frame (T,), in the bound's own unit; at most
0 where the bound is kept. A value of two frames counts for the later one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np

from support.arm_geometry import STEP_S, ArmGeometry, at_least, between_segments, segments_to_box
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

ROUNDING = 1e-9  # absolute in SI units, and relative
POSITION_ROUNDING_M = 1e-6
AS_MEASURED_RAD = 1e-4  # a jump ends within this distance of the measured joints
SPEED_ROUNDING_MPS = 1e-6
# the tool's speed in a stop, beyond its speed limit
STOP_RISE = 1.01
STOP_RISE_MPS = 0.01
SLOW_RISE_MPS = 0.1  # the tool's speed in a stop, beyond its speed at the start
BEHIND_M = 0.25  # the tool may be this far from its setpoint, or farther:
# this plus the stopping distance, as the setpoint stops and waits for a tool beyond this distance
WAITING_M = 0.12
OUTSIDE_M = 0.03  # the tool may leave the workspace by this distance
SLIP_MPS = 0.01  # speed of approach of joints that start one after the other
RESTING_S = 0.6  # after this time without motion, a hand's estimate rests too
# error of a resting hand's estimate, plus 3 standard deviations of the tracker's noise
ESTIMATE_M = 0.006
# excess speed toward a hand at rest, and toward the estimate of a hand
RESTING_MPS = 0.03
ESTIMATED_MPS = 0.02
# within this time an excess has fallen to this share, or is slow
BRAKED_S = 0.12
BRAKED_SHARE = 0.9
SLOW_MPS = 0.05
NEAR_M = 0.55  # a more distant hand allows any speed
MOVING_MPS = 0.005  # slower capsules are not checked
# depth in a clearance; increase of the depth at the start
PASSED_M = 0.005
WORSE_M = 0.002
OWN_CLEARANCE_M = 0.01
EVERY = 4  # [frames] between checks of clearances, which change slowly
SETTLED_S = 6.0  # an arm comes to rest within this time after the hands
# windows at the end of a session, for accelerations and for the report of a stuck tool
LOOK_S = 0.5
STUCK_S = 2.5
# root mean square acceleration of all joints
AT_REST_RADPS2 = 0.05
AT_REST_NOISY_RADPS2 = 0.3
KEPT_BACK_RADPS2 = 0.5
THERE_M = 0.01
NET_MOTION_M = 0.004
# farther from its target, a tool is reported as stuck; nearer, as kept away
STUCK_M = 0.02


@dataclass(frozen=True)
class Session:
    """Data of a session by which bounds are judged, frame by frame (T,).

    `measured` (T, J): joints that the arm reported last [rad]; `boxes` (T, 2, 3): the skill's
    workspace [m]; `receiving` (T, 2): a via-point lets the tool touch this hand. `hands` (T, 2, 3):
    true hand positions [m], and `still_s` (T, 2): time for which they have rested; `noise_m`: their
    tracker's standard deviation. `quiet_from`: the frame from which hands come to rest, the arm
    follows well, and nothing else happens. `arm_follows`: the arm follows well all the time;
    `deadlines_kept`: no tick is missed.
    """

    settings: Settings
    geometry: ArmGeometry
    frames: np.ndarray
    measured: Vector
    boxes: Vector
    receiving: np.ndarray
    hands: Vector
    still_s: Vector
    noise_m: float
    quiet_from: int
    arm_follows: bool
    deadlines_kept: bool

    @property
    def quiet_s(self) -> float:
        """Duration of the quiet part at the end."""
        return (len(self.frames) - self.quiet_from) * self.settings.period_s

    @cached_property
    def placed(self) -> Vector:
        """Ends of the capsules (T, N, 2, 3) [m]."""
        return self.geometry.place(self.frames["joints"])[0]

    @cached_property
    def placed_on(self) -> Vector:
        """Ends of the capsules (T - 1, N, 2, 3) [m] STEP_S after each frame but the last."""
        return self.geometry.place(
            self.frames["joints"][:-1] + STEP_S * self.frames["joint_velocities"][1:]
        )[0]

    @cached_property
    def tool_speeds(self) -> tuple[Vector, Vector]:
        """Speeds (T,) of the tool [m/s]: now, and when all joint accelerations have decreased to
        0.
        """
        joints = self.frames["joints"]
        velocities = self.frames["joint_velocities"]
        accelerations = self.frames["joint_accelerations"]
        jerk = np.array(self.settings.joints.jerk)
        crest = velocities + accelerations * np.abs(accelerations) / (2.0 * jerk)
        speeds = self.geometry.tool_speeds
        return speeds(joints, velocities), speeds(joints, crest)


Bound: TypeAlias = Callable[[Session], Vector]


def _excess(count: int, value: Vector | float, allowed: Vector | float, where: Vector) -> Vector:
    """The excess of values over the allowed ones where a condition holds; 0 elsewhere."""
    return np.where(where, np.broadcast_to(np.asarray(value) - allowed, count), 0.0)


def _with_first(of_pairs: Vector) -> Vector:
    """Values of pairs of frames (T - 1,), assigned to the later frame (T,)."""
    return np.concatenate([[0.0], of_pairs])


def _commanded(session: Session) -> np.ndarray:
    return session.frames["commanded"] == 1


def _pairs(where: np.ndarray) -> np.ndarray:
    """True (T - 1,) if a condition holds at a frame and at the previous one."""
    return where[1:] & where[:-1]


def _following(session: Session) -> np.ndarray:
    return session.frames["mode"] == Mode.FOLLOW


def _jumps(session: Session) -> np.ndarray:
    """True (T - 1,) if joints moved to a frame by more than their velocities."""
    frames = session.frames
    dt = session.settings.period_s
    moved = np.diff(frames["joints"], axis=0)
    moved -= 0.5 * dt * (frames["joint_velocities"][1:] + frames["joint_velocities"][:-1])
    jumped = np.abs(moved) > np.array(session.settings.joints.jerk) * dt**3 + 2 * ROUNDING
    return jumped.any(axis=1) & _pairs(_commanded(session))


def _norms(values: Vector) -> Vector:
    return np.linalg.norm(values, axis=-1)


# --- joints ---


def every_number_is_finite(session: Session) -> Vector:
    frames = session.frames
    fields = [frames[name].reshape(len(frames), -1) for name in frames.dtype.names or ()]
    return 1.0 - np.all([np.isfinite(field).all(axis=1) for field in fields], axis=0)


def joints_are_within_limits_or_move_inwards(session: Session) -> Vector:
    joints = session.frames["joints"]
    limits = session.settings.joints
    beyond = np.maximum(joints - limits.upper, limits.lower - joints)
    excess = (beyond[1:] - np.maximum(0.0, beyond[:-1])).max(axis=1) - ROUNDING
    return _with_first(np.where(_pairs(_commanded(session)), excess, 0.0))


def _relative_to_limit(session: Session, field: str, limit: tuple[float, ...]) -> Vector:
    share = np.abs(session.frames[field]) / np.array(limit)
    return _excess(len(share), share.max(axis=1), 1.0 + ROUNDING, _commanded(session))


def joint_speeds_are_within_limits(session: Session) -> Vector:
    return _relative_to_limit(session, "joint_velocities", session.settings.joints.velocity)


def joint_accelerations_are_within_limits(session: Session) -> Vector:
    return _relative_to_limit(session, "joint_accelerations", session.settings.joints.acceleration)


def joint_jerks_are_within_limits(session: Session) -> Vector:
    jerk = np.array(session.settings.joints.jerk)
    dt = session.settings.period_s
    jerks = np.abs(np.diff(session.frames["joint_accelerations"], axis=0)) / dt
    excess = (jerks - jerk * (1.0 + ROUNDING) - ROUNDING / dt).max(axis=1)
    return _with_first(np.where(_pairs(_commanded(session)) & ~_jumps(session), excess, 0.0))


def joints_jump_only_at_rest_and_to_where_the_arm_is(session: Session) -> Vector:
    frames = session.frames
    speed = np.abs(frames["joint_velocities"][:-1]).max(axis=1)
    error_rad = np.abs(frames["joints"][1:] - session.measured[1:]).max(axis=1)
    return _with_first(
        np.where(_jumps(session), np.maximum(speed, error_rad - AS_MEASURED_RAD), 0.0)
    )


def joints_that_move_are_commanded(session: Session) -> Vector:
    return _excess(
        len(session.frames),
        np.abs(session.frames["joint_velocities"]).max(axis=1),
        0.0,
        ~_commanded(session),
    )


# --- setpoint ---


def _rise(session: Session, field: str, limit: float) -> Vector:
    """The rise of a norm beyond a limit; a norm that begins beyond it may only decrease."""
    norm = _norms(session.frames[field])
    excess = norm[1:] - np.maximum(norm[:-1], limit) * (1.0 + ROUNDING) - ROUNDING
    return _with_first(np.where(_pairs(_following(session)), excess, 0.0))


def setpoint_speed_is_within_its_limit(session: Session) -> Vector:
    return _rise(session, "setpoint_velocity", session.settings.tool.max_speed)


def setpoint_is_slow_while_it_engages(session: Session) -> Vector:
    """A setpoint that begins faster than the engage speed may only slow down."""
    rise = _rise(session, "setpoint_velocity", session.settings.tool.engaging_speed)
    return np.where(session.frames["flags"] & Flag.ENGAGING > 0, rise, 0.0)


def setpoint_acceleration_is_within_its_limit(session: Session) -> Vector:
    return _rise(session, "setpoint_acceleration", session.settings.tool.acceleration)


def setpoint_jerk_is_within_its_limit(session: Session) -> Vector:
    jerk = session.settings.tool.jerk
    dt = session.settings.period_s
    jerks = _norms(np.diff(session.frames["setpoint_acceleration"], axis=0)) / dt
    excess = jerks - jerk * (1.0 + 1e-6) - ROUNDING / dt
    return _with_first(np.where(_pairs(_following(session)), excess, 0.0))


def setpoint_does_not_jump(session: Session) -> Vector:
    frames = session.frames
    dt = session.settings.period_s
    moved = np.diff(frames["setpoint"], axis=0)
    moved -= 0.5 * dt * (frames["setpoint_velocity"][1:] + frames["setpoint_velocity"][:-1])
    excess = np.abs(moved).max(axis=1) - session.settings.tool.jerk * dt**3 - ROUNDING
    return _with_first(np.where(_pairs(_following(session)), excess, 0.0))


def setpoint_passes_no_bound_of_its_own(session: Session) -> Vector:
    """The bounds whose violation the service reports as a fault."""
    return (session.frames["reason"] == Reason.SETPOINT).astype(float)


def setpoint_turning_speed_is_within_its_limit(session: Session) -> Vector:
    return _rise(session, "setpoint_turning", session.settings.tool.max_turn_speed * (1.0 + 1e-6))


def setpoint_turning_acceleration_is_within_its_limit(session: Session) -> Vector:
    limit = session.settings.tool.max_turn_acceleration
    dt = session.settings.period_s
    accelerations = _norms(np.diff(session.frames["setpoint_turning"], axis=0)) / dt
    excess = accelerations - limit * (1.0 + 1e-6) - 1e-5
    return _with_first(np.where(_pairs(_following(session)), excess, 0.0))


# --- workspace ---


def _runs(session: Session) -> Iterator[slice]:
    """Frames in which the arm follows without a pause and with the same workspace."""
    is_unchanged = np.concatenate(
        [[False], (session.boxes[1:] == session.boxes[:-1]).all(axis=(1, 2))]
    )
    following = _following(session)
    begins = np.flatnonzero(following & ~(np.concatenate([[False], following[:-1]]) & is_unchanged))
    ends = np.append(begins, len(following))[1:]
    for begin, end in zip(begins, ends, strict=True):
        pauses = np.flatnonzero(~following[begin:end])
        yield slice(begin, begin + pauses[0] if len(pauses) else end)


def _outside(session: Session, point: str) -> Vector:
    """The distance (T,) [m] of a point outside the workspace and the planes of the reach; negative
    inside.
    """
    reach = session.settings.reach
    positions_m = session.frames[point]
    lower = np.maximum(session.boxes[:, 0], (reach.min_x, -np.inf, reach.min_z))
    return np.maximum(lower - positions_m, positions_m - session.boxes[:, 1]).max(axis=1)


def setpoint_stays_in_the_workspace(session: Session) -> Vector:
    """This holds where following began at rest. A setpoint that begins outside moves no farther
    out.
    """
    outside = _outside(session, "setpoint")
    excess = np.zeros(len(session.frames))
    for run in _runs(session):
        if not session.frames["setpoint_velocity"][run.start].any():
            excess[run] = outside[run] - max(0.0, outside[run.start]) - POSITION_ROUNDING_M
    return excess


def tool_leaves_the_workspace_by_little(session: Session) -> Vector:
    outside = _outside(session, "tool")
    excess = np.zeros(len(session.frames))
    for run in _runs(session):
        excess[run] = outside[run] - max(0.0, outside[run.start]) - OUTSIDE_M
    return excess


def tool_is_near_its_setpoint(session: Session) -> Vector:
    """Within BEHIND_M, or within WAITING_M plus the stopping distance from the largest speed."""
    gap = _norms(session.frames["tool"] - session.frames["setpoint"])
    tool = session.settings.tool
    v = tool.max_speed
    a = 0.4 * tool.acceleration
    j = tool.jerk / np.sqrt(3.0)
    stop_m = 0.5 * v * (v / a + a / j) if v > a**2 / j else v * np.sqrt(v / j)
    return _excess(len(gap), gap, max(BEHIND_M, WAITING_M + stop_m), _following(session))


# --- speed of the tool ---


def tool_speed_is_within_its_limit_while_following(session: Session) -> Vector:
    limit = session.settings.tool.max_speed + SPEED_ROUNDING_MPS
    return _excess(len(session.frames), session.tool_speeds[0], limit, _following(session))


def tool_hardly_speeds_up_in_a_stop(session: Session) -> Vector:
    """Below 1.01 times the greater of its speed and the speed to which it was accelerating, plus
    100 mm/s; and always below 1.01 times its limit, plus 10 mm/s.
    """
    speed, crest = session.tool_speeds
    following = _following(session)
    limit = STOP_RISE * session.settings.tool.max_speed + STOP_RISE_MPS
    allowed = np.full(len(speed), limit)
    is_over = ~session.frames["joint_velocities"].any(axis=1)
    is_over |= session.frames["reason"] == Reason.BLOCKED  # a way out is no stop
    stop_limit = limit
    for k in range(len(speed)):
        if following[k]:
            stop_limit = STOP_RISE * max(speed[k], crest[k]) + SLOW_RISE_MPS
        elif is_over[k]:
            stop_limit = limit
        allowed[k] = min(limit, stop_limit) if not following[k] else np.inf
    return speed - allowed


def service_causes_no_fault_of_its_own(session: Session) -> Vector:
    """No fault for a tool that is too fast, and none of an arm that follows and reports."""
    frames = session.frames
    is_caused = frames["reason"] == Reason.TOOL_SPEED
    if session.deadlines_kept:
        is_caused |= np.isin(frames["reason"], (Reason.ARM_ERROR, Reason.ARM_SILENT))
    return ((frames["mode"] == Mode.FAULT) & is_caused & session.arm_follows).astype(float)


# --- people ---


def allowed_speeds(distance: Vector, hand_speed: Vector | float, session: Session) -> Vector:
    """Speeds s (K,) [m/s] toward a hand from which a stop ends the clearance c away:
    d - c = (s + h) t + s² / 2b + s h / b, with the hand's speed h, reaction time t and brake b.
    """
    people = session.settings.people
    late = people.brake * (session.settings.hands.stale_ms + people.reaction_ms) / 1000.0
    square = late**2 + hand_speed**2 + 2.0 * people.brake * (distance - people.distance)
    return np.maximum(0.0, np.sqrt(np.maximum(square, 0.0)) - late - hand_speed)


def _approaches(
    session: Session, side: int, capsule: int, hands: Vector
) -> tuple[np.ndarray, Vector, Vector, Vector, Vector]:
    """Motion of a capsule near a hand (T - 1, 3): indices (K,) of the previous frames; ends of the
    capsule then and STEP_S later; distances [m], and speeds [m/s] toward the hand as if it rested.
    """
    geometry = session.geometry
    frames = session.frames
    now = session.placed[:-1, capsule]
    later = session.placed_on[:, capsule]
    radius = geometry.radii[capsule] + session.settings.people.radius
    half = 0.5 * geometry.forearm
    where = at_least(now, hands + half, float(np.linalg.norm(half))) < NEAR_M + radius
    where &= _norms(later - now).max(axis=1) > MOVING_MPS * STEP_S
    k = np.flatnonzero(where & (frames["hand_ages"][1:, side] >= 0) & _pairs(_commanded(session)))
    before, after = (
        between_segments(ends[k], _forearms(session, hands[k])) for ends in (now, later)
    )
    return k, later[k], before - radius, (before - after) / STEP_S, before


def _forearms(session: Session, hands: Vector) -> Vector:
    return np.stack([hands, hands + session.geometry.forearm], axis=1)


def _moving_capsules(session: Session) -> np.ndarray:
    return np.flatnonzero(session.geometry.links > 0)


def arm_does_not_approach_a_resting_hand_too_fast(session: Session) -> Vector:
    """The hands truly rest, and are seen."""
    excess = np.zeros(len(session.frames))
    stale = session.settings.hands.stale_ms / 1000.0
    for side in (0, 1):
        ages_s = session.frames["hand_ages"][1:, side] * session.settings.period_s
        resting = (session.still_s[1:, side] > RESTING_S) & (ages_s < stale)
        if not resting.any():
            continue
        for capsule in _moving_capsules(session):
            k, _, distance, speed, _ = _approaches(session, side, capsule, session.hands[1:, side])
            allowed = allowed_speeds(distance + ESTIMATE_M + 3.0 * session.noise_m, 0.0, session)
            allowed = _with_contact(session, side, capsule, k, allowed)
            over = np.where(resting[k], speed - allowed - SLIP_MPS - RESTING_MPS, 0.0)
            excess[k + 1] = np.maximum(excess[k + 1], over)
    return excess


def arm_brakes_where_it_approaches_a_hand_too_fast(session: Session) -> Vector:
    """The hands are the estimated ones, which may approach faster than joints brake."""
    excess = np.zeros(len(session.frames))
    frames = session.frames
    ticks = max(1, int(BRAKED_S / session.settings.period_s))
    for side in (0, 1):
        hands = frames["hands"][1:, side]
        velocities = frames["hand_velocities"][1:, side]
        for capsule in _moving_capsules(session):
            k, _, distance, speed, before = _approaches(session, side, capsule, hands)
            later = _forearms(session, hands[k] + STEP_S * velocities[k])
            coming = np.maximum(
                0.0, (before - between_segments(session.placed[k, capsule], later)) / STEP_S
            )
            allowed = _with_contact(
                session, side, capsule, k, allowed_speeds(distance, coming, session)
            )
            over = np.full(len(frames), -1.0)
            speeds = np.zeros(len(frames))
            over[k + 1] = speed - allowed - SLIP_MPS - ESTIMATED_MPS
            speeds[k + 1] = speed
            too_fast = np.flatnonzero(over > 0.0)
            for run in np.split(too_fast, np.flatnonzero(np.diff(too_fast) > 1) + 1):
                if len(run) > ticks and speeds[run[ticks]] > max(
                    BRAKED_SHARE * speeds[run[0]], SLOW_MPS
                ):
                    excess[run] = np.maximum(excess[run], over[run])
    return excess


def _with_contact(
    session: Session, side: int, capsule: int, k: np.ndarray, allowed: Vector
) -> Vector:
    """The tool's link may touch a hand that a via-point lets receive."""
    if session.geometry.links[capsule] < session.geometry.joints:
        return allowed
    return np.where(
        session.receiving[k + 1, side],
        np.maximum(allowed, session.settings.people.contact_speed),
        allowed,
    )


# --- table, boxes, the arm itself ---


def _intrusion(
    session: Session, distances: Callable[[np.ndarray], Vector], clearance: float
) -> Vector:
    """The depth (T,) [m] in a clearance beyond the depth at the arm's last start, from the
    distances (K,) [m] at frames (K,).
    """
    commanded = _commanded(session)
    is_start = commanded & ~np.concatenate([[False], commanded[:-1] & ~_jumps(session)])
    frames = np.unique(
        np.concatenate([np.arange(0, len(commanded), EVERY), np.flatnonzero(is_start)])
    )
    frames = frames[commanded[frames]]
    excess = np.zeros(len(commanded))
    if len(frames):
        distance = distances(frames)
        begin = distance[
            np.maximum.accumulate(np.where(is_start[frames], np.arange(len(frames)), 0))
        ]
        excess[frames] = np.minimum(clearance - PASSED_M, begin - WORSE_M) - distance
    return excess


def _intrusion_of_boxes(session: Session, boxes: Vector) -> Vector:
    excess = np.zeros(len(session.frames))
    clearance = session.settings.obstacles.clearance
    for box in boxes:
        for capsule in _moving_capsules(session):
            distances = partial(_distances_of_box, session, box, capsule, clearance)
            excess = np.maximum(excess, _intrusion(session, distances, clearance))
    return excess


def _distances_of_box(
    session: Session, box: Vector, capsule: int, clearance: float, frames: np.ndarray
) -> Vector:
    """Distances (K,) of a capsule at frames (K,) from a box, or lower bounds if these suffice."""
    ends = session.placed[frames, capsule]
    radius = session.geometry.radii[capsule]
    out = at_least(ends, box.mean(axis=0), 0.5 * float(np.linalg.norm(box[1] - box[0]))) - radius
    near = out < clearance
    out[near] = segments_to_box(ends[near], box) - radius
    return out


def arm_keeps_clear_of_the_table(session: Session) -> Vector:
    return _intrusion_of_boxes(session, session.geometry.boxes[:1])


def arm_keeps_clear_of_boxes(session: Session) -> Vector:
    return _intrusion_of_boxes(session, session.geometry.boxes[1:])


def arm_keeps_clear_of_itself(session: Session) -> Vector:
    excess = np.zeros(len(session.frames))
    clearance = min(OWN_CLEARANCE_M, session.settings.obstacles.clearance)
    for first, second in session.geometry.pairs:
        distances = partial(_distances_of_pair, session, first, second, clearance)
        excess = np.maximum(excess, _intrusion(session, distances, clearance))
    return excess


def _distances_of_pair(
    session: Session, first: int, second: int, clearance: float, frames: np.ndarray
) -> Vector:
    """Distances (K,) of two capsules at frames (K,), or lower bounds if these suffice."""
    ends = session.placed[frames, first]
    others = session.placed[frames, second]
    radii = session.geometry.radii[first] + session.geometry.radii[second]
    out = at_least(ends, others.mean(axis=1), 0.5 * _norms(others[:, 1] - others[:, 0])) - radii
    near = out < clearance
    out[near] = between_segments(ends[near], others[near]) - radii
    return out


# --- the end, with hands at rest ---


def _at_the_end(session: Session, excess: float) -> Vector:
    out = np.zeros(len(session.frames))
    out[-1] = excess
    return out


def _last(session: Session, seconds: float) -> np.ndarray:
    return session.frames[-max(2, round(seconds / session.settings.period_s)) :]


def _is_target_steady(session: Session) -> bool:
    return bool(np.ptp(_last(session, LOOK_S)["target"], axis=0).max() < NET_MOTION_M)


def _off_target_m(session: Session) -> float:
    return float(np.linalg.norm(session.frames["tool"][-1] - session.frames["target"][-1]))


def _net_motion_m(session: Session) -> float:
    lately = _last(session, LOOK_S)["tool"]
    return float(np.linalg.norm(lately[-1] - lately[0]))


def arm_comes_to_rest_with_the_hands(session: Session) -> Vector:
    """The root mean square of all joint accelerations, once the tool has been at its target for a
    while. A tool that is kept away from its target for that time may tremble slightly. A moving
    target is not judged, as a steep skill amplifies the tracker's noise.
    """
    settled = _last(session, SETTLED_S)
    if (
        session.quiet_s < SETTLED_S
        or (settled["mode"] != Mode.FOLLOW).any()
        or not _is_target_steady(session)
    ):
        return _at_the_end(session, 0.0)
    distance_m = _norms(settled["tool"] - settled["target"])
    if (distance_m < THERE_M).all():
        allowed = AT_REST_RADPS2 if session.noise_m == 0.0 else AT_REST_NOISY_RADPS2
    elif (distance_m > THERE_M).all() and np.ptp(settled["tool"], axis=0).max() < NET_MOTION_M:
        allowed = KEPT_BACK_RADPS2
    else:
        return _at_the_end(session, 0.0)
    return _at_the_end(
        session,
        float(np.sqrt((_last(session, LOOK_S)["joint_accelerations"] ** 2).mean())) - allowed,
    )


def tool_is_never_stuck_in_silence(session: Session) -> Vector:
    """At the end the tool is at its target, on its way, or reported to be stuck or kept away."""
    if session.quiet_s < SETTLED_S or not _is_target_steady(session):
        return _at_the_end(session, 0.0)
    if not _following(session)[-1] or _net_motion_m(session) >= NET_MOTION_M:
        return _at_the_end(session, 0.0)
    lately = _last(session, STUCK_S)
    if (lately["flags"] & Flag.STUCK).any() or (lately["mode"] != Mode.FOLLOW).any():
        return _at_the_end(session, 0.0)
    is_kept_away = bool((lately["flags"] & Flag.SEPARATION).any())
    return _at_the_end(session, _off_target_m(session) - (STUCK_M if is_kept_away else THERE_M))


def hands_at_rest_and_resets_end_every_fault(session: Session) -> Vector:
    is_fault = session.quiet_s > SETTLED_S and session.frames["mode"][-1] == Mode.FAULT
    return _at_the_end(session, float(is_fault))


BOUNDS: tuple[Bound, ...] = (
    setpoint_is_slow_while_it_engages,
    every_number_is_finite,
    joints_are_within_limits_or_move_inwards,
    joint_speeds_are_within_limits,
    joint_accelerations_are_within_limits,
    joint_jerks_are_within_limits,
    joints_jump_only_at_rest_and_to_where_the_arm_is,
    joints_that_move_are_commanded,
    setpoint_speed_is_within_its_limit,
    setpoint_acceleration_is_within_its_limit,
    setpoint_jerk_is_within_its_limit,
    setpoint_does_not_jump,
    setpoint_passes_no_bound_of_its_own,
    setpoint_turning_speed_is_within_its_limit,
    setpoint_turning_acceleration_is_within_its_limit,
    setpoint_stays_in_the_workspace,
    tool_leaves_the_workspace_by_little,
    tool_is_near_its_setpoint,
    tool_speed_is_within_its_limit_while_following,
    tool_hardly_speeds_up_in_a_stop,
    service_causes_no_fault_of_its_own,
    arm_does_not_approach_a_resting_hand_too_fast,
    arm_brakes_where_it_approaches_a_hand_too_fast,
    arm_keeps_clear_of_the_table,
    arm_keeps_clear_of_boxes,
    arm_keeps_clear_of_itself,
    arm_comes_to_rest_with_the_hands,
    tool_is_never_stuck_in_silence,
    hands_at_rest_and_resets_end_every_fault,
)


def broken(session: Session) -> list[str]:
    """Each violated bound: its name, the largest excess, and its frame."""
    out = []
    for bound in BOUNDS:
        excess = bound(session)
        worst = int(np.argmax(excess))
        if not excess[worst] <= 0.0:
            mode = Mode(session.frames["mode"][worst])
            reason = Reason(session.frames["reason"][worst])
            out.append(
                f"{bound.__name__}: by {excess[worst]:.5g} at frame {worst} ({mode.name} "
                f"{reason.name})"
            )
    return out
