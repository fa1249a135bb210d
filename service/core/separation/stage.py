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

from collections.abc import Iterable

import numpy as np

from service.config import Settings
from service.contract.requests import ViaPoint
from service.core.frame import Record, Records, Vector, as_array, parameters, structured
from service.core.separation.body import body_of, own_clearance
from service.core.separation.clearance import NOBODY, clearance
from service.core.separation.step import excess_of, share_of, step
from service.core.separation.tuning import (
    FARTHEST_REPORTED_M,
    LOOKAHEAD_S,
    PEOPLE_PLANNED_MARGIN_M,
    PLANNED_BRAKE_LIMITS,
    PLANNED_BRAKE_SHARE,
    PLANNED_REACTION_S,
    TABLE_DEPTH_M,
    THINGS_PLANNED_MARGIN_M,
)

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
        boxes = [[centre - half - [0.0, 0.0, TABLE_DEPTH_M], centre + half]]
        boxes += [[np.subtract(b.centre, b.half_size), np.add(b.centre, b.half_size)] for b in things.boxes]
        self._boxes = np.array(boxes)
        self._capsules, self._pairs = body.capsules, body.pairs
        direction, brake = np.array(people.toward_elbow), np.array([people.brake, things.brake, things.brake])
        late_s = things.reaction_ms / 1000
        reaction_s = np.array([(settings.hands.stale_ms + people.reaction_ms) / 1000, late_s, late_s])
        self._parameters = parameters(
            brake=brake,
            reaction_s=reaction_s,
            planned_brake=PLANNED_BRAKE_SHARE
            * np.minimum(brake, PLANNED_BRAKE_LIMITS * settings.tool.stop_acceleration),
            planned_reaction_s=np.maximum(reaction_s, PLANNED_REACTION_S),
            clearance=np.array([people.clearance, things.clearance, own_clearance(settings)]),
            room=np.array([PEOPLE_PLANNED_MARGIN_M, THINGS_PLANNED_MARGIN_M, THINGS_PLANNED_MARGIN_M]),
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
        most = 2 * capsules * len(LOOKAHEAD_S) + 3 * capsules * len(boxes) + len(body.pairs)
        self._jerk = np.array(limits.jerk)
        self.constraints = self.constraints_for(joints, most)
        self._contacts = structured(0, CONTACT)
        self.count, self.nearest_m, self.speed_limit, self.setpoint_share = 0, FARTHEST_REPORTED_M, self.max_speed, 1.0

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
        self.count, self.nearest_m, self.speed_limit, self.setpoint_share = step(
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
        return float(share_of(self.constraints, self.count, velocity))

    def excess(self, velocity: Vector, acceleration: Vector) -> float:
        """By how much joints that move so (J,) [rad/s, rad/s²] pass what is allowed [m/s], or will
        as their acceleration comes to 0; at most 0 if they do not.
        """
        return float(excess_of(self.constraints, self.count, velocity, acceleration, self._jerk)[0])

    def less(self, velocity: Vector, moved: tuple[Vector, Vector]) -> Vector:
        """The velocities (J,) [rad/s] nearest to these by which what joints that have `moved` so
        (J,) [rad/s, rad/s²] pass the most is passed no more.
        """
        excess, k = excess_of(self.constraints, self.count, *moved, self._jerk)
        row = self.constraints["row"][k]
        slower: Vector = velocity - excess / (row @ row) * row
        return slower
