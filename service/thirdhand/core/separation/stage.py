"""Separation stage: limits of joint velocity, modelled on speed and separation monitoring.

For each pair of nearby parts there is a row, `row · dq <= limit`. It limits the speed at which the
joints move the nearest points of the pair toward each other. Parts that move away from each other
have a negative speed and are not limited. Inside of a clearance of things or of the arm itself, the
planned limit is negative: the parts must return. The tool may touch a hand gently at a via-point
where the skill says that the tool goes with that hand, while the hands are at that via-point.

When a hand and a part pass each other, the direction between them can turn faster than joints
brake: motion past the hand becomes motion toward it. So the rule is also evaluated a moment ahead,
at positions that are extrapolated for hands and joints. The speed that can be braked until then is
added to the limit there. `separation.step` has the formulas.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Record, Records, Vector, as_array, parameters, structured
from thirdhand.core.separation import FARTHEST_REPORTED_M, TABLE_DEPTH_M
from thirdhand.core.separation.body import body_of, own_clearance
from thirdhand.core.separation.clearance import NOBODY, clearance
from thirdhand.core.separation.step import excess_of, share_of, step
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.vectors import times
from thirdhand.settings.config import Settings

CONTACT = np.dtype([("hands", np.float64, (2, 3)), ("radius", np.float64), ("side", np.int64)])


class Separation:
    """Separation's constraints at a tick.

    `constraints` (K,), of which the first `count` are active: `row` (J,) times the joint velocities
    [rad/s, m/s] is at most `planned` [m/s] in planned motion, and at most `allowed` [m/s] in every
    motion. `nearest_m`: distance of the nearest hand. `speed_limit` [m/s]: smallest allowed speed
    toward a hand. `setpoint_share`: largest share of the setpoint's speed at which the tool can
    follow.
    """

    def __init__(self, settings: Settings, urdf: str, *, tuning: Tuning = TUNING) -> None:
        numbers = tuning.separation
        people = settings.people
        things = settings.obstacles
        table = settings.table
        limits = settings.joints
        body = body_of(settings, urdf, tuning)
        self.max_speed = float(body.capsules["max_speed"].max())
        centre = np.array(table.centre)
        half = np.array([*table.half_size, 0.0])

        # the table, then the boxes of the settings
        boxes = [[centre - half - [0.0, 0.0, TABLE_DEPTH_M], centre + half]]
        boxes += [
            [np.subtract(b.centre, b.half_size), np.add(b.centre, b.half_size)]
            for b in things.boxes
        ]
        self._boxes = np.array(boxes)
        self._capsules = body.capsules
        self._pairs = body.pairs

        direction = np.array(people.toward_elbow)
        brake = np.array([people.brake, things.brake, things.brake])
        late_s = things.reaction_ms / 1000
        reaction_s = np.array(
            [(settings.hands.longest_stale_ms + people.reaction_ms) / 1000, late_s, late_s]
        )
        lookahead_s = 0.5 * numbers.brake_ramp_s * np.arange(5.0)
        self._parameters = parameters(
            brake=brake,
            reaction_s=reaction_s,
            planned_brake=numbers.planned_brake_share
            * np.minimum(
                brake, np.array(numbers.planned_brake_limits) * settings.tool.stop_acceleration
            ),
            planned_reaction_s=np.maximum(reaction_s, numbers.planned_reaction_s),
            clearance=np.array(
                [people.distance, things.clearance, own_clearance(settings, tuning)]
            ),
            planned_margin=numbers.planned_margin_m,
            planned_brake_share=numbers.planned_brake_share,
            clearance_gain_per_s=numbers.clearance_gain_per_s,
            slip_speed_mps=numbers.slip_speed_mps,
            retreat_speed_mps=2.0 * numbers.slip_speed_mps,
            # A part returns only if the joints, unstrained, can move it at this speed.
            retreat_authority_mps=5.0 * (2.0 * numbers.slip_speed_mps),
            # Inside a clearance the tolerated excess falls linearly, to a tenth at 0.9 of this
            # depth: the arm slips by as much in a reaction time.
            slip_depth_m=numbers.slip_speed_mps * numbers.planned_reaction_s,
            # time until braking has built up, and with which a hand's acceleration fades
            brake_ramp_s=numbers.brake_ramp_s,
            lookahead_s=lookahead_s,
            # A hand approaches at `unknown_speed` until its velocity is better known than after
            # its first sample.
            unknown_velocity_std_mps=2.0 * tuning.intake.start_speed_std_mps / 3.0,
            # A hand out of sight accelerates toward the arm as much as a hand brakes.
            unseen_acceleration_mps2=tuning.setpoint.hand_brake_mps2,
            contact_margin_m=numbers.contact_margin_m,
            contact_speed=float(people.contact_speed),
            unknown_speed=numbers.unknown_speed_mps,
            unseen_s=np.array([settings.hands.longest_stale_ms, settings.hands.unseen_ms]) / 1000,
            period_s=settings.period_s,
            # A slower hand's motion is ignored as tremor; from twice that it counts in full.
            tremor_speed=2.0 * tuning.intake.hand_still_mps,
            hand_radius=float(people.radius),
            forearm=people.length / np.linalg.norm(direction) * direction,
            frames=body.frames,
            axes=body.axes,
            max_velocity=np.array(limits.velocity, np.float64),
            # the first capsule that a joint moves
            first=int(np.flatnonzero(body.capsules["link"])[0]),
        )
        self._bare = self._parameters.copy()  # for `intrusion`
        self._bare["clearance"] = 0.0

        capsules = len(body.capsules)
        joints = len(limits.names)
        most = 2 * capsules * len(lookahead_s) + 3 * capsules * len(boxes) + len(body.pairs)
        self._jerk = np.array(limits.jerk)
        self._weights = np.square(limits.acceleration)
        self.constraints = self.constraints_for(joints, most)
        self._contacts = structured(0, CONTACT)
        self.count = 0
        self.nearest_m = FARTHEST_REPORTED_M
        self.speed_limit = self.max_speed
        self.setpoint_share = 1.0

    @staticmethod
    def constraints_for(joints: int, count: int) -> Records:
        """Allocate `count` constraints for an arm of `joints` joints."""
        return structured(
            count,
            [("row", np.float64, (joints,)), ("planned", np.float64), ("allowed", np.float64)],
        )

    def set_contacts(self, via_points: Iterable[ViaPoint]) -> None:
        """Allow the tool to touch a hand at the via-points where it goes with that hand."""
        contacts = [
            (np.array([p.left, p.right]), p.radius, ("left", "right").index(p.follow))
            for p in via_points
            if p.follow != "none"
        ]
        self._contacts = structured(len(contacts), CONTACT)
        self._contacts[:] = contacts

    def step(self, state: Record, frame: Record, here: Records) -> None:
        """Update the constraints for the state's hands and the arm's kinematics `here` (1,)."""
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
        frame["hand_distance"] = self.nearest_m
        frame["hand_limit"] = self.speed_limit

    def clearance(self, joints: Vector, hands: Vector) -> tuple[float, int, int]:
        """Smallest distance [m] beyond the clearances, at joints (J,) [rad, m], hands (H, 3) [m].

        People, things and the arm itself count. Also returns the number of the nearest capsule, and
        what it is nearest to: the number of a box (0 is the table), NEAR_HAND or NEAR_ITSELF.
        """
        nearest: tuple[float, int, int] = clearance(
            joints, hands, self._parameters, self._capsules, self._pairs, self._boxes
        )
        return nearest

    def intrusion(self, joints: Vector) -> tuple[float, int, int]:
        """Depth [m] to which the arm is inside of a thing or of itself; below 0 if it is not.

        Also returns the index of the joint that moves this part, and the thing, as `clearance`
        does.
        """
        clear, part, thing = clearance(
            joints, NOBODY, self._bare, self._capsules, self._pairs, self._boxes
        )
        return -clear, int(self._capsules["link"][part]) - 1, thing

    def share(self, velocity: Vector) -> float:
        """Largest share, at most 1, of joint velocities (J,) that keeps all planned limits."""
        return float(share_of(self.constraints, self.count, velocity, self._parameters))

    def excess(self, velocity: Vector, acceleration: Vector) -> float:
        """Largest excess [m/s] over the `allowed` limits at this motion of the joints.

            max over k of ( max(row_k · dq, row_k · (dq + ddq |ddq| / 2 jerk)) - allowed_k )

        The second term is the speed once all accelerations have come to 0. An excess of 0 or less
        means that all limits hold. Both arguments are (J,), [rad/s, rad/s²].
        """
        return float(excess_of(self.constraints, self.count, velocity, acceleration, self._jerk)[0])

    def less(self, velocity: Vector, acceleration: Vector) -> Vector:
        """Joint velocities (J,), changed as little as possible to end the largest excess.

            velocity - excess W row / (row · W row),    W = diag(max_acceleration²)

        The excess is that of `velocity` and `acceleration` (J,), [rad/s, rad/s²]. Joints with a
        higher limit of acceleration take a larger part of the change.
        """
        excess, k = excess_of(self.constraints, self.count, velocity, acceleration, self._jerk)
        row = self.constraints["row"][k]
        change = self._weights * row
        slower: Vector = velocity - excess / times(row[None], change)[0] * change
        return slower
