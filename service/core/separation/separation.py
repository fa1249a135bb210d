"""How fast the parts of the arm may approach hands, things and each other: the speed-and-separation
rule of ISO/TS 15066, as inequalities of the joints' velocities.

A pair of parts whose points nearest to each other lie `distance` apart gives one row: the speed at
which the arm's joints bring these together is at most what the rule allows there. What leaves has a
negative speed and is never limited. The tool may touch a hand gently where a taught place says that
the tool goes with that hand, while the hands are at that place.

Where a hand and a part pass each other, what leads past the hand now may lead into it a moment
later, as the direction between them turns faster than joints brake. So the rule is also asked about
moments ahead, as if hands and joints went on as they do; what can still be braked until then is
allowed on top.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract.requests import ViaPoint
from service.core.frame import Record, Records, Vector, as_array, parameters, structured
from service.core.geometry import between_segments, carry_back, nearest_to_box, place, to_box
from service.core.separation.body import body_of, own_clearance
from service.core.separation.clearance import FARTHEST, ITSELF, NOBODY, PEOPLE, THINGS, clearance

TABLE_DEPTH = 1.0  # [m] below its top, nothing is free
PEOPLE_ROOM = 0.01  # [m] from people, kept more where motion is planned
THINGS_ROOM = 0.01  # [m] from things, likewise
PLAN_SHARE = 0.8  # of the braking that is planned with: its ramps need the rest
PLAN_BRAKE = np.array(
    [1.0, 0.5, 0.5]
)  # of the tool's acceleration in a stop, for people and things: no more is planned with ...
PLAN_REACTION_S = 0.02  # ... nor with less reaction time: joints that are let nearer more quickly swing there
CLEARANCE_GAIN = (
    5.0  # [1/s] of the way to the clearance of a thing or part, and back to it where small errors have added up
)
RETREAT_SPEED = 0.02  # [m/s] at most, back to a clearance: twice as fast as joints may slip
RETREAT_MIN_AUTHORITY = 0.1  # [m/s] only what the joints can move so fast is moved back
SLIP = 0.01  # [m/s] that joints which start one after the other may approach at all ...
SLIP_DEPTH = 0.0005  # [m] ... less the deeper inside a clearance, a tenth from here on
NEAR_VIA_POINT = 0.02  # [m] beside a via-point's radius, each axis
AHEAD_S = np.array([0.0, 0.04, 0.08, 0.12, 0.16])  # moments the rule is asked about
CHANGE_S = 0.07  # over which a hand's acceleration fades
RAMP_S = 0.08  # of a braking, and until a hand's new velocity is known
UNSURE = 0.2  # [m/s] a hand whose velocity's standard deviation is greater has only just been seen
UNSEEN_MPS2 = 5.0  # [m/s²] a hand that is not seen comes ever faster, by so much
CONTACT = np.dtype([("hands", np.float64, (2, 3)), ("radius", np.float64), ("side", np.int64)])


class Separation:
    """What the rule says at a tick.

    `constraints` (K,), of which the first `count` are in force: `row` (J,) times joint velocities
    is at most `planned` [m/s] where motion is planned, and `allowed` [m/s] at all. `nearest_m` of
    the hands, the least `speed_limit` [m/s] toward one, and `setpoint_share`, the greatest share of
    the setpoint's speed at which the tool could go along.
    """

    def __init__(self, settings: Settings, urdf: str) -> None:
        people, things, table, limits = settings.people, settings.obstacles, settings.table, settings.joints
        body = body_of(settings, urdf)
        self.max_speed = float(body.capsules["max_speed"].max())
        centre, half = np.array(table.centre), np.array([*table.half_size, 0.0])
        boxes = [[centre - half - [0.0, 0.0, TABLE_DEPTH], centre + half]]
        boxes += [[np.subtract(b.centre, b.half_size), np.add(b.centre, b.half_size)] for b in things.boxes]
        self._boxes = np.array(boxes)
        self._capsules, self._pairs = body.capsules, body.pairs
        direction, brake = np.array(people.toward_elbow), np.array([people.brake, things.brake, things.brake])
        late_s = things.reaction_ms / 1000
        reaction_s = np.array([(settings.hands.stale_ms + people.reaction_ms) / 1000, late_s, late_s])
        self._parameters = parameters(
            brake=brake,
            reaction_s=reaction_s,
            planned_brake=PLAN_SHARE * np.minimum(brake, PLAN_BRAKE * settings.tool.stop_acceleration),
            planned_reaction_s=np.maximum(reaction_s, PLAN_REACTION_S),
            clearance=np.array([people.clearance, things.clearance, own_clearance(settings)]),
            room=np.array([PEOPLE_ROOM, THINGS_ROOM, THINGS_ROOM]),
            contact_speed=float(people.contact_speed),
            unknown_speed=float(people.unknown_speed),
            unseen_s=np.array([settings.hands.stale_ms, settings.hands.unseen_ms]) / 1000,
            period_s=settings.period_s,
            tremor_speed=float(people.tremor_speed),
            hand_radius=float(people.radius),
            forearm=people.length / np.linalg.norm(direction) * direction,
            frames=body.frames,
            axes=body.axes,
            max_velocity=np.array(limits.velocity, np.float64),
            first=int(np.flatnonzero(body.capsules["link"])[0]),
        )
        self._bare = self._parameters.copy()
        self._bare["clearance"] = 0.0
        capsules, joints = len(body.capsules), len(limits.names)
        most = 2 * capsules * len(AHEAD_S) + 3 * capsules * len(boxes) + len(body.pairs)
        self._jerk = np.array(limits.jerk)
        self.constraints = self.constraints_for(joints, most)
        self._contacts = structured(0, CONTACT)
        self.count, self.nearest_m, self.speed_limit, self.setpoint_share = 0, FARTHEST, self.max_speed, 1.0

    @staticmethod
    def constraints_for(joints: int, count: int) -> Records:
        """So many constraints of an arm with so many joints."""
        return structured(count, [("row", np.float64, (joints,)), ("planned", np.float64), ("allowed", np.float64)])

    def set_contacts(self, via_points: Iterable[ViaPoint]) -> None:
        """From now on the tool may touch a hand at those of the via-points where it goes with that
        hand.
        """
        found = [
            (np.array([p.left, p.right]), p.radius, ("left", "right").index(p.follow))
            for p in via_points
            if p.follow != "none"
        ]
        self._contacts = structured(len(found), CONTACT)
        self._contacts[:] = found

    def step(self, state: Record, frame: Record, here: Records) -> None:
        """Finds what the rule says for the state's hands at the arm's kinematics `here` (1,)."""
        self.count, self.nearest_m, self.speed_limit, self.setpoint_share = _step(
            as_array(state),
            here,
            self._parameters,
            self._capsules,
            self._pairs,
            self._boxes,
            self._contacts,
            self.constraints,
        )
        frame["hand_distance"], frame["hand_limit"] = self.nearest_m, self.speed_limit

    def clearance(self, joints: Vector, hands: Vector) -> tuple[float, int, int]:
        """How far the arm at joints (J,) [rad] is from people with hands (H, 3) [m], from things
        and from itself, less what is kept from them [m]; the capsule that is nearest, and to what:
        the number of a box, the table's is 0, or NEAR_HAND or NEAR_ITSELF.
        """
        found: tuple[float, int, int] = clearance(
            joints, hands, self._parameters, self._capsules, self._pairs, self._boxes
        )
        return found

    def intrusion(self, joints: Vector) -> tuple[float, int, int]:
        """By how much [m] a part of the arm is inside of a thing or of another part, if above 0;
        the number of the joint that moves it; and the thing, as `clearance` says.
        """
        clear, part, thing = clearance(joints, NOBODY, self._bare, self._capsules, self._pairs, self._boxes)
        return -clear, int(self._capsules["link"][part]) - 1, thing

    def share(self, velocity: Vector) -> float:
        """How much of joint velocities (J,) [rad/s] is slow enough for all that is near."""
        return float(_share_of(self.constraints, self.count, velocity))

    def excess(self, velocity: Vector, acceleration: Vector) -> float:
        """By how much joints that move so (J,) [rad/s, rad/s²] pass what is allowed [m/s], or will
        as their acceleration comes to 0; at most 0 if they do not.
        """
        return float(_excess(self.constraints, self.count, velocity, acceleration, self._jerk)[0])

    def less(self, velocity: Vector, moved: tuple[Vector, Vector]) -> Vector:
        """The velocities (J,) [rad/s] nearest to these by which what joints that have `moved` so
        (J,) [rad/s, rad/s²] pass the most is passed no more.
        """
        excess, k = _excess(self.constraints, self.count, *moved, self._jerk)
        row = self.constraints["row"][k]
        slower: Vector = velocity - excess / (row @ row) * row
        return slower


@compiled
def allowed_speed(distance: float, hand_speed: float, brake: float, reaction: float, clearance: float) -> float:
    """Speed [m/s] toward something `distance` [m] away that comes at `hand_speed` [m/s] all the
    time, from which a stop that begins a reaction time [s] late and brakes so [m/s²] ends
    `clearance` away.
    """
    square = hand_speed**2 + (brake * reaction) ** 2 + 2.0 * brake * (distance - clearance)
    return max(0.0, math.sqrt(max(square, 0.0)) - brake * reaction - hand_speed)


@compiled
def _step(
    states: Records,
    heres: Records,
    parameters: Records,
    capsules: Records,
    pairs: Vector,
    boxes: Vector,
    contacts: Records,
    constraints: Records,
) -> tuple[int, float, float, float]:
    """`Separation.step`: how many constraints; nearest, speed limit and setpoint's share."""
    state, here, given = states[0], heres[0], parameters[0]
    joints, near, forearm, count = len(here.joints), np.empty(9), np.empty((2, 3)), 0
    later, velocity, placed = np.empty(joints), np.empty(3), np.empty((2, len(capsules), 2, 3))
    now, then = placed[0], placed[1]
    place(here.joints, given.frames, given.axes, capsules, now)
    nearest_m, setpoint_share = FARTHEST, 1.0
    speed_limit = capsules[0].max_speed
    for capsule in range(len(capsules)):
        speed_limit = max(speed_limit, capsules[capsule].max_speed)
    for side in range(2):
        if state.hand_ticks[side] < 0:
            continue
        variance = 0.0
        for mode in range(state.mode_probabilities.shape[1]):
            variance += state.mode_probabilities[side, mode] * state.mode_covariances[side, mode, 1, 1]
        known, receives = variance <= UNSURE * UNSURE, _receives(contacts, state.hands, side)
        age_s = (state.tick - state.hand_ticks[side]) * given.period_s
        # of one that is not seen, while the arm may go on: by so much faster and nearer it may be
        unseen_s = age_s - given.unseen_s[0] if given.unseen_s[0] < age_s < given.unseen_s[1] else 0.0
        speed_up = min(UNSEEN_MPS2 * unseen_s, given.unknown_speed)
        nearer = speed_up * (unseen_s - 0.5 * speed_up / UNSEEN_MPS2)
        moment = _swiftness(state.hands[side, 1], given.tremor_speed) if known else 0.0
        for k in range(len(AHEAD_S) if moment > 0.0 else 1):
            ahead = moment * AHEAD_S[k]
            parts = now if k == 0 else then
            if k > 0:
                for j in range(joints):
                    later[j] = here.joints[j] + ahead * state.joints[1, j]
                place(later, given.frames, given.axes, capsules, then)
            faster = CHANGE_S * (1.0 - math.exp(-ahead / CHANGE_S))
            for i in range(3):
                v, a = state.hands[side, 1, i], state.hands[side, 2, i]
                velocity[i] = v + faster * a
                moved = ahead * v + CHANGE_S * (ahead - faster) * a
                forearm[0, i] = state.hands[side, 0, i] + moved
                forearm[1, i] = forearm[0, i] + given.forearm[i]
            braked = given.brake[PEOPLE] * max(ahead - RAMP_S, 0.0)
            for capsule in range(given.first, len(capsules)):
                part, constraint = capsules[capsule], constraints[count]
                distance = between_segments(parts[capsule], forearm, near) - part.radius - given.hand_radius
                if k == 0:
                    nearest_m = min(nearest_m, distance)
                distance -= nearer
                coming = 0.0
                for i in range(3):
                    coming -= near[6 + i] * velocity[i]
                coming = max(coming, 0.0) + speed_up if known else given.unknown_speed
                least = given.contact_speed if receives and part.link == joints else 0.0
                if k == 0:
                    most = max(least, _allowed(parameters, PEOPLE, distance, coming))
                    speed_limit = min(speed_limit, most)
                planned = _planned(parameters, PEOPLE, distance, coming, least, braked)
                if planned < part.max_speed:
                    constraint.planned = planned
                    constraint.allowed = max(least, _allowed(parameters, PEOPLE, distance, coming)) + braked + SLIP
                    if k > 0:
                        carry_back(near, then[capsule], now[capsule])
                    _bring_together(constraints, count, near, 0, heres, part.link, 1.0)
                    if part.link == joints:
                        setpoint_share = min(setpoint_share, _share(near, planned, state.setpoint[1]))
                    count += _may_pass(constraints, count, planned, given.max_velocity)
    for capsule in range(given.first, len(capsules)):
        part = capsules[capsule]
        for box in range(len(boxes)):
            inner = nearest_to_box(now[capsule], boxes[box])
            for where in range(3):  # the ends too: a capsule that lies along a face may tip
                share = inner if where == 0 else where - 1.0
                distance = to_box(now[capsule], share, boxes[box], near) - part.radius
                planned = _planned(parameters, THINGS, distance, 0.0, 0.0, 0.0)
                twice = where > 0 and share == inner
                if not twice and planned < part.max_speed:
                    _bring_together(constraints, count, near, 0, heres, part.link, 1.0)
                    planned = _limit(constraints, count, parameters, THINGS, distance, planned)
                    if part.link == joints:
                        setpoint_share = min(setpoint_share, _share(near, planned, state.setpoint[1]))
                    count += _may_pass(constraints, count, planned, given.max_velocity)
    for pair in range(len(pairs)):
        one, other = capsules[pairs[pair, 0]], capsules[pairs[pair, 1]]
        distance = between_segments(now[pairs[pair, 0]], now[pairs[pair, 1]], near) - one.radius - other.radius
        planned = _planned(parameters, ITSELF, distance, 0.0, 0.0, 0.0)
        if planned < one.max_speed + other.max_speed:
            _bring_together(constraints, count, near, 0, heres, one.link, 1.0)
            _bring_together(constraints, count, near, 3, heres, other.link, -1.0)
            planned = _limit(constraints, count, parameters, ITSELF, distance, planned)
            count += _may_pass(constraints, count, planned, given.max_velocity)
    return count, nearest_m, speed_limit, setpoint_share


@compiled
def _allowed(parameters: Records, rule: int, distance: float, coming: float) -> float:
    """Speed [m/s] that a rule allows."""
    given = parameters[0]
    return allowed_speed(distance, coming, given.brake[rule], given.reaction_s[rule], given.clearance[rule])


@compiled
def _planned(parameters: Records, rule: int, distance: float, coming: float, least: float, braked: float) -> float:
    """Speed [m/s] that is planned with: less than the rule allows, but at least `least`, and what
    is `braked` until then.
    """
    given = parameters[0]
    brake, reaction_s = given.planned_brake[rule], given.planned_reaction_s[rule]
    planned = allowed_speed(distance, coming, brake, reaction_s, given.clearance[rule] + given.room[rule])
    return max(PLAN_SHARE * least, planned) + PLAN_SHARE * braked


@compiled
def _limit(constraints: Records, k: int, parameters: Records, rule: int, distance: float, planned: float) -> float:
    """Set the limits of a constraint to a thing or to another part; the planned speed [m/s].

    With the distance `left` to the clearance, parts slow down to CLEARANCE_GAIN * left. Inside of
    the clearance they return, if the joints can move them, and may slip the less the deeper they
    are.
    """
    given, constraint = parameters[0], constraints[k]
    left = distance - given.clearance[rule]
    slip = min(max(1.0 + left / SLIP_DEPTH, 0.1), 1.0) * SLIP
    constraint.allowed = _allowed(parameters, rule, distance, 0.0) + slip
    planned = min(planned, max(CLEARANCE_GAIN * left, -RETREAT_SPEED))
    if planned < 0.0 and not _may_pass(constraints, k, RETREAT_MIN_AUTHORITY, given.max_velocity):
        planned = 0.0
    constraint.planned = planned
    return planned


@compiled
def _may_pass(constraints: Records, k: int, limit: float, max_velocity: Vector) -> int:
    """1 if joints within their greatest velocities can pass a limit along a constraint, else 0."""
    most = 0.0
    for j in range(len(max_velocity)):
        most += abs(constraints[k].row[j]) * max_velocity[j]
    return 1 if most > limit else 0


@compiled
def _swiftness(velocity: Vector, tremor_speed: float) -> float:
    """0 for a hand that rests or trembles, 1 for one that goes somewhere."""
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    return min(max(speed / tremor_speed - 1.0, 0.0), 1.0)


@compiled
def _share(near: Vector, limit: float, velocity: Vector) -> float:
    """How much of a velocity (3,) stays under a limit along the normal."""
    along = near[6] * velocity[0] + near[7] * velocity[1] + near[8] * velocity[2]
    limit = max(limit, 0.0)
    return limit / along if along > limit else 1.0


@compiled
def _receives(contacts: Records, hands: Vector, side: int) -> bool:
    """Whether the hands are at a via-point where the tool goes with this one."""
    for contact in contacts:
        if contact.side == side:
            far = 0.0
            for hand in range(2):
                for i in range(3):
                    far = max(far, abs(hands[hand, 0, i] - contact.hands[hand, i]))
            if far <= contact.radius + NEAR_VIA_POINT:
                return True
    return False


@compiled
def _bring_together(
    constraints: Records, k: int, near: Vector, at: int, heres: Records, link: int, sign: float
) -> None:
    """Adds to a constraint's row the speed along the normal, times the sign, of the point
    near[at:at + 3] of a link that the first joints move.
    """
    row, tool, jacobian = constraints[k].row, heres[0].position, heres[0].jacobian
    if sign > 0.0:
        row[:] = 0.0
    x, y, z = near[at] - tool[0], near[at + 1] - tool[1], near[at + 2] - tool[2]
    n0, n1, n2 = near[6], near[7], near[8]
    for j in range(link):
        wx, wy, wz = jacobian[3, j], jacobian[4, j], jacobian[5, j]
        speed = n0 * (jacobian[0, j] + wy * z - wz * y)
        speed += n1 * (jacobian[1, j] + wz * x - wx * z)
        speed += n2 * (jacobian[2, j] + wx * y - wy * x)
        row[j] += sign * speed


@compiled
def _share_of(constraints: Records, count: int, velocity: Vector) -> float:
    """`Separation.share`."""
    share = 1.0
    for k in range(count):
        speed = 0.0
        for j in range(len(velocity)):
            speed += constraints[k].row[j] * velocity[j]
        limit = max(constraints[k].planned, 0.5 * SLIP)
        if speed > limit:
            share = min(share, limit / speed)
    return share


@compiled
def _excess(constraints: Records, count: int, dq: Vector, ddq: Vector, jerk: Vector) -> tuple[float, int]:
    """`Separation.excess`, and of which constraint."""
    most, which = -math.inf, 0
    for k in range(count):
        constraint = constraints[k]
        now = crest = 0.0
        for j in range(len(dq)):
            now += constraint.row[j] * dq[j]
            crest += constraint.row[j] * (dq[j] + ddq[j] * abs(ddq[j]) / (2.0 * jerk[j]))
        if max(now, crest) - constraint.allowed > most:
            most, which = max(now, crest) - constraint.allowed, k
    return most, which
