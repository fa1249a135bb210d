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
from service.core.frame import Record, Records, Vector, as_array
from service.core.separation.body import body_of
from service.core.separation.capsules import between_segments, nearest_to_box, place, to_box

FARTHEST = 3.0  # [m] no distance is told as greater
IRRELEVANT = 1.5  # [m/s] nothing on the arm is as fast: pairs that may do this make no row
TABLE_DEPTH = 1.0  # [m] below its top, nothing is free
PEOPLE_ROOM, THINGS_ROOM = 0.01, 0.005  # [m] kept more where motion is planned ...
PLAN_SHARE = 0.8  # ... and of the braking: its ramps need that
COMES = 5.0  # [1/s] of the way to a thing's clearance; and back to it where it lacks, as small errors add up ...
LEAVES = 0.02  # [m/s] ... at most so fast, twice as fast as joints may slip,
LEVER = 0.1  # [m/s] ... and only by what the joints can move so fast
SLIP = 0.01  # [m/s] that joints which start one after the other may approach at all
NEAR_PLACE = 0.02  # [m] beside a place's radius, each axis
AHEAD_S = np.array([0.0, 0.04, 0.08, 0.12, 0.16])  # moments the rule is asked about
CHANGE_S = 0.07  # over which a hand's acceleration fades
STEADY = 0.1  # [m/s] slower hands tremble, and nothing is foreseen of them; all of it at twice that
RAMP_S = 0.08  # of a braking, and until a hand's new velocity is known
UNSURE = 0.2  # [m/s] a hand whose velocity's standard deviation is greater has only just been seen


class Separation:
    """What the rule says at a tick: `rows` (K, J) of which the first `count` are in force, times
    joint velocities at most `plan` (K,) [m/s] where motion is planned and `allowed` (K,) at all.

    `told` (3,): distance of the nearest hand [m], the least speed that is allowed toward one, and
    the greatest share of the setpoint's speed at which the tool could go along.
    """

    def __init__(self, settings: Settings, urdf: str) -> None:
        people, things, table = settings.people, settings.obstacles, settings.table
        self._body = body_of(settings, urdf)
        moving = np.flatnonzero(self._body.links)
        self._first = int(moving[0])
        centre, half = np.array(table.centre), np.array([*table.half_size, 0.0])
        boxes = [[centre - half - [0.0, 0.0, TABLE_DEPTH], centre + half]]
        boxes += [[np.subtract(b.centre, b.half_size), np.add(b.centre, b.half_size)] for b in things.boxes]
        self._boxes = np.array(boxes)
        direction = np.array(people.toward_elbow)
        self._hand = np.array([people.radius, *(people.length / np.linalg.norm(direction) * direction)])
        reaction_s = (settings.hands.stale_ms + people.reaction_ms) / 1000
        self._people = np.array(
            [people.brake, reaction_s, people.clearance, people.contact_speed, people.unknown_speed]
        )
        self._things = np.array([things.brake, things.reaction_ms / 1000, things.clearance])
        count, joints = len(self._body.links), len(settings.joints.names)
        most = 2 * count * len(AHEAD_S) + 3 * count * len(boxes) + len(self._body.pairs)
        self._fastest = np.array(settings.joints.velocity)
        self.rows, self.plan, self.allowed = np.zeros((most, joints)), np.zeros(most), np.zeros(most)
        self.told, self.count = np.array([FARTHEST, IRRELEVANT, 1.0]), 0
        self._placed = np.zeros((2, count, 2, 3))
        self._contacts = np.empty((0, 8))

    def expect(self, places: Iterable[ViaPoint]) -> None:
        """From now on the tool may touch a hand at those of the taught places where it goes with
        that hand.
        """
        found = [[*p.left, *p.right, p.radius, ("left", "right").index(p.follow)] for p in places if p.follow != "none"]
        self._contacts = np.array(found).reshape(-1, 8)

    def look(self, state: Record, q: Vector, tool: Vector, jacobian: Vector) -> None:
        """Finds what the rule says at joints q (J,) [rad], where the tool is at `tool` (3,) [m] and
        has this Jacobian (6, J), for the state's hands.
        """
        self.count = _look(
            as_array(state),
            q,
            tool,
            jacobian,
            *self._body,
            self._first,
            self._boxes,
            self._hand,
            self._people,
            self._things,
            self._contacts,
            self._fastest,
            self._placed,
            self.rows,
            self.plan,
            self.allowed,
            self.told,
        )

    def excess(self, velocity: Vector, acceleration: Vector, jerk: Vector) -> float:
        """By how much joints that move so (J,) [rad/s, rad/s²] pass what is allowed [m/s], or will
        as their acceleration comes to 0 with this jerk; at most 0 if they do not.
        """
        return float(_excess(self.rows, self.allowed, self.count, velocity, acceleration, jerk))


@compiled
def allowed_speed(distance: float, hand_speed: float, brake: float, reaction: float, clearance: float) -> float:
    """Speed [m/s] toward something `distance` [m] away that comes at `hand_speed` [m/s] all the
    time, from which a stop that begins a reaction time [s] late and brakes so [m/s²] ends
    `clearance` away.
    """
    square = hand_speed**2 + (brake * reaction) ** 2 + 2.0 * brake * (distance - clearance)
    return max(0.0, math.sqrt(max(square, 0.0)) - brake * reaction - hand_speed)


@compiled
def _look(
    states: Records,
    q: Vector,
    tool: Vector,
    jacobian: Vector,
    frames: Vector,
    axes: Vector,
    links: Vector,
    ends: Vector,
    radii: Vector,
    pairs: Vector,
    first: int,
    boxes: Vector,
    hand: Vector,
    people: Vector,
    things: Vector,
    contacts: Vector,
    max_speed: Vector,
    placed: Vector,
    rows: Vector,
    plan: Vector,
    allowed: Vector,
    told: Vector,
) -> int:
    """`Separation.look`: rows that were found."""
    state, near, forearm, count = states[0], np.empty(9), np.empty((2, 3)), 0
    later, velocity, here, there = np.empty(len(q)), np.empty(3), placed[0], placed[1]
    place(q, frames, axes, links, ends, here)
    told[0], told[1], told[2] = FARTHEST, IRRELEVANT, 1.0
    for side in range(2):
        if state.hand_ticks[side] < 0:
            continue
        variance = 0.0
        for mode in range(state.modes.shape[1]):
            variance += state.modes[side, mode] * state.covariances[side, mode, 1, 1]
        known, receives = variance <= UNSURE * UNSURE, _receives(contacts, state.hands, side)
        moment = _swiftness(state.hands[side, 1]) if known else 0.0
        for k in range(len(AHEAD_S) if moment > 0.0 else 1):
            ahead = moment * AHEAD_S[k]
            parts = here if k == 0 else there
            if k > 0:
                for j in range(len(q)):
                    later[j] = q[j] + ahead * state.joints[1, j]
                place(later, frames, axes, links, ends, there)
            faster = CHANGE_S * (1.0 - math.exp(-ahead / CHANGE_S))
            for i in range(3):
                v, a = state.hands[side, 1, i], state.hands[side, 2, i]
                velocity[i] = v + faster * a
                moved = ahead * v + CHANGE_S * (ahead - faster) * a
                forearm[0, i] = state.hands[side, 0, i] + moved
                forearm[1, i] = forearm[0, i] + hand[1 + i]
            braked = people[0] * max(ahead - RAMP_S, 0.0)
            for capsule in range(first, len(links)):
                distance = between_segments(parts[capsule], forearm, near) - radii[capsule] - hand[0]
                coming = 0.0
                for i in range(3):
                    coming -= near[6 + i] * velocity[i]
                coming = max(coming, 0.0) if known else people[4]
                least = people[3] if receives and links[capsule] == len(q) else 0.0
                if k == 0:
                    most = max(least, allowed_speed(distance, coming, people[0], people[1], people[2]))
                    told[0], told[1] = min(told[0], distance), min(told[1], most)
                if _add(near, distance, coming, least, braked, people, PEOPLE_ROOM, plan, allowed, count):
                    if k > 0:
                        _carry_back(near, there[capsule], here[capsule])
                    _bring_together(rows[count], near, 0, tool, jacobian, links[capsule], 1.0)
                    if links[capsule] == len(q):
                        told[2] = min(told[2], _share(near, plan[count], state.setpoint[1]))
                    count += _may_pass(rows[count], plan[count], max_speed)
    for capsule in range(first, len(links)):
        for box in range(len(boxes)):
            inner = nearest_to_box(here[capsule], boxes[box])
            for where in range(3):  # the ends too: a capsule that lies along a face may tip
                share = inner if where == 0 else where - 1.0
                distance = to_box(here[capsule], share, boxes[box], near) - radii[capsule]
                twice = where > 0 and share == inner
                if not twice and _add(near, distance, 0.0, 0.0, 0.0, things, THINGS_ROOM, plan, allowed, count):
                    plan[count] = min(plan[count], max(COMES * (distance - things[2]), -LEAVES))
                    _bring_together(rows[count], near, 0, tool, jacobian, links[capsule], 1.0)
                    if plan[count] < 0.0 and not _may_pass(rows[count], LEVER, max_speed):
                        plan[count] = 0.0
                    if links[capsule] == len(q):
                        told[2] = min(told[2], _share(near, plan[count], state.setpoint[1]))
                    count += _may_pass(rows[count], plan[count], max_speed)
    for pair in range(len(pairs)):
        one, other = pairs[pair, 0], pairs[pair, 1]
        distance = between_segments(here[one], here[other], near) - radii[one] - radii[other]
        if _add(near, distance, 0.0, 0.0, 0.0, things, THINGS_ROOM, plan, allowed, count):
            _bring_together(rows[count], near, 0, tool, jacobian, links[one], 1.0)
            _bring_together(rows[count], near, 3, tool, jacobian, links[other], -1.0)
            count += _may_pass(rows[count], plan[count], max_speed)
    return count


@compiled
def _may_pass(row: Vector, limit: float, max_speed: Vector) -> int:
    """1 if joints within their greatest speeds can pass a limit along a row (J,), else 0."""
    most = 0.0
    for j in range(len(row)):
        most += abs(row[j]) * max_speed[j]
    return 1 if most > limit else 0


@compiled
def _swiftness(velocity: Vector) -> float:
    """0 for a hand that rests or trembles, 1 for one that goes somewhere."""
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    return min(max(speed / STEADY - 1.0, 0.0), 1.0)


@compiled
def _share(near: Vector, limit: float, velocity: Vector) -> float:
    """How much of a velocity (3,) stays under a limit along the normal."""
    along = near[6] * velocity[0] + near[7] * velocity[1] + near[8] * velocity[2]
    limit = max(limit, 0.0)
    return limit / along if along > limit else 1.0


@compiled
def _receives(contacts: Vector, hands: Vector, side: int) -> bool:
    """Whether the hands are at a taught place where the tool goes with this one."""
    for at in range(len(contacts)):
        if contacts[at, 7] == side:
            far = 0.0
            for hand in range(2):
                for i in range(3):
                    far = max(far, abs(hands[hand, 0, i] - contacts[at, 3 * hand + i]))
            if far <= contacts[at, 6] + NEAR_PLACE:
                return True
    return False


@compiled
def _add(
    near: Vector,
    distance: float,
    coming: float,
    least: float,
    braked: float,
    rule: Vector,
    room: float,
    plan: Vector,
    allowed: Vector,
    count: int,
) -> bool:
    """Writes the limits of a pair behind `count` others: what the rule says, but at least `least`,
    and what is `braked` until then; not if nothing can be so fast, and then false.
    """
    planned = allowed_speed(distance, coming, PLAN_SHARE * rule[0], rule[1], rule[2] + room)
    planned = max(PLAN_SHARE * least, planned) + PLAN_SHARE * braked
    if planned >= IRRELEVANT:
        return False
    plan[count] = planned
    allowed[count] = max(least, allowed_speed(distance, coming, rule[0], rule[1], rule[2])) + braked + SLIP
    return True


@compiled
def _carry_back(near: Vector, then: Vector, now: Vector) -> None:
    """Moves the first point of `near` from where it is on a segment (2, 3) to the same point of the
    segment now.
    """
    long = whole = 0.0
    for i in range(3):
        way = then[1, i] - then[0, i]
        long += way * (near[i] - then[0, i])
        whole += way * way
    share = long / whole if whole > 0.0 else 0.0
    for i in range(3):
        near[i] = now[0, i] + share * (now[1, i] - now[0, i])


@compiled
def _bring_together(row: Vector, near: Vector, at: int, tool: Vector, jacobian: Vector, link: int, sign: float) -> None:
    """Adds to row (J,) the speed along the normal, times the sign, of the point near[at:at + 3] of
    a link that the first joints move.
    """
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
def _excess(rows: Vector, allowed: Vector, count: int, dq: Vector, ddq: Vector, jerk: Vector) -> float:
    """`Separation.excess`."""
    most = -IRRELEVANT
    for k in range(count):
        now = crest = 0.0
        for j in range(len(dq)):
            now += rows[k, j] * dq[j]
            crest += rows[k, j] * (dq[j] + ddq[j] * abs(ddq[j]) / (2.0 * jerk[j]))
        most = max(most, max(now, crest) - allowed[k])
    return most
