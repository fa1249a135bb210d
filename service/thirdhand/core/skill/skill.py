"""Skill as the control loop uses it: predict from the motion of two hands the motion of the tool,
its orientation and the gripper's closure; clamp targets to the workspace.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from kmp.arrays.immutable import Immutable, frozen
from kmp.compiled import compiled
from thirdhand.contract.requests import TOLERANCE_M, ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.intake.hand_estimator import STILL
from thirdhand.core.numerics import MAX_TARGET_M
from thirdhand.core.skill import ORDER
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import delayed, turn_lag_s
from thirdhand.core.skill.model import NO_CLOCK, NORMAL, Model, Regions, Seen, Target
from thirdhand.core.skill.pose import NO_GRIPPER, LearnedGripper, LearnedOrientation, Turn
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.settings.config import Reach

NEVER = -(2**60)  # a tick before any other: filters have forgotten what happened then


def clamp(
    position: Vector, velocity: Vector, acceleration: Vector, *, box: Vector, reach: Reach
) -> Target:
    """Clamp a target (3,) [m], [m/s], [m/s²] to the box (2, 3) [m] and to the reach.

    For a position outside, the outward components of velocity and acceleration are removed.
    """
    if is_inside(position, box, reach_of(reach)):
        return Target(position, velocity, acceleration, clamped=False)
    boxed = np.minimum(np.maximum(position, box[0]), box[1])
    inside = boxed == position
    velocity = velocity * inside
    acceleration = acceleration * inside
    reached, outward = _nearest(np.minimum(np.maximum(boxed, -MAX_TARGET_M), MAX_TARGET_M), reach)
    if not outward:
        return Target(boxed, velocity, acceleration, not inside.all())
    return Target(
        reached, _without(velocity, outward), _without(acceleration, outward), clamped=True
    )


@functools.cache
def reach_of(reach: Reach) -> Vector:
    """Reach (7,) for `is_inside`: centre, inner and outer radius, least x and z [m]."""
    return np.array([*reach.centre, reach.inner, reach.outer, reach.min_x, reach.min_z])


@compiled
def is_inside(position: Vector, box: Vector, reach: Vector) -> bool:
    """True if a position (3,) [m] is inside the box (2, 3) and the reach (7,) of `reach_of`."""
    square = 0.0
    for i in range(3):
        if not box[0, i] <= position[i] <= box[1, i]:
            return False
        square += (position[i] - reach[i]) ** 2
    near = reach[3] * reach[3]
    far = reach[4] * reach[4]
    return bool(near <= square <= far and position[0] >= reach[5] and position[2] >= reach[6])


def is_reachable(position: Vector, reach: Reach) -> bool:
    """True if a position (3,) [m] is inside the reach."""
    return not _nearest(position, reach)[1]


def _nearest(point: Vector, reach: Reach) -> tuple[Vector, list[Vector]]:
    """Reachable point near a point (3,) [m], and the outward normals (3,) of the boundaries to
    which it was moved.

    The boundaries are applied in this order: least x and z, outer sphere, inner sphere. Where a
    sphere moves the point across a plane, it is put on the circle in which they meet. So the point
    is reachable, but not always the nearest one.
    """
    x, y, z = (point - reach.centre).tolist()
    inner = reach.inner
    outer = reach.outer
    min_x = reach.min_x - reach.centre[0]
    floor = reach.min_z - reach.centre[2]

    # into the half-spaces
    moved_x = x < min_x
    moved_z = z < floor
    x = max(x, min_x)
    z = max(z, floor)

    # into the outer sphere, and back across the plane of the least x
    distance = math.hypot(x, y, z)
    moved_out = distance > outer
    if moved_out:
        x = x * outer / distance
        y = y * outer / distance
        z = z * outer / distance
        if x < min_x:
            moved_x = True
            x = min_x
            shrink = math.sqrt(max(outer**2 - x**2, 0.0)) / max(math.hypot(y, z), 1e-12)
            y = y * min(shrink, 1.0)
            z = z * min(shrink, 1.0)

    # out of the inner sphere, and back across the plane of the least z
    distance = math.hypot(x, y, z)
    moved_in = distance < inner
    if moved_in:
        grow = inner / max(distance, 1e-12)
        x = x * grow
        y = y * grow
        z = z * grow
        if z < floor:
            moved_z = True
            z = floor
            grow = math.sqrt(max(inner**2 - z**2, 0.0)) / max(math.hypot(x, y), 1e-12)
            x = x * max(grow, 1.0)
            y = y * max(grow, 1.0)

    if not (moved_x or moved_z or moved_out or moved_in):
        return point, []
    radial = np.array([x, y, z]) / max(math.hypot(x, y, z), 1e-12)
    boundaries = (
        (moved_x, np.array([-1.0, 0.0, 0.0])),
        (moved_z, np.array([0.0, 0.0, -1.0])),
        (moved_out, radial),
        (moved_in, -radial),
    )
    return np.array([x, y, z]) + reach.centre, [normal for moved, normal in boundaries if moved]


def _without(vector: Vector, normals: list[Vector]) -> Vector:
    """Remove the components of a vector (3,) along the outward normals (3,); for several normals,
    by up to 20 alternating projections.
    """
    for _ in range(20 if len(normals) > 1 else 1):
        for normal in normals:
            along = vector * normal
            vector = vector - max(float(along[0] + along[1] + along[2]), 0.0) * normal
    return vector


UNTOLD = np.empty((0, 18))  # orientation of hands if it is not known
MODELS: tuple[type[Model], ...] = (HandsKMP, SegmentedKMP)
"""All types of models."""
Earlier: TypeAlias = tuple[Vector, Vector, float, float]
"""Covariances of position (3, 3) [m²] and orientation (3, 3) [rad²], closure of the gripper, and
what the gate compares [m], as predicted at the newest sample of a hand."""


class Prediction(NamedTuple):
    """Predicted motion of the tool, its orientation, the gripper's closure, and uncertainties."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²] of the model, before the calibration by `Regions`
    gate_m: float  # [m] distance that is compared with the skill's threshold, see `Model.measure`
    ambiguity: float  # probability that the tool belongs elsewhere, in another segment
    signs: Vector  # (SIGNS,) of an error, see `support`
    turn: Turn
    closure: float  # of the gripper, 0 (open) to 1 (closed); NO_GRIPPER if the skill has none


@dataclass(frozen=True, eq=False)
class Skill(Immutable):
    """Model of the tool's motion as a function of both hands' motion, with its threshold,
    workspace, orientation and gripper. `workbench.learning` learns skills; `skills` adapts and
    stores them.
    """

    name: str
    model: Model
    orientation: Vector  # (4,) quaternion x y z w of the tool if no orientation was learned
    workspace: Vector  # (2, 3) lower and upper corner of the box for targets [m]
    threshold: float  # [m] hands whose `gate_m` is above it are far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0  # components of the Gaussian mixture of the demonstrations; 0: no mixture
    via_points: tuple[ViaPoint, ...] = ()
    turn: LearnedOrientation | None = None
    gripper: LearnedGripper | None = None
    tolerance: float = TOLERANCE_M  # [m] a via-point replaces reference points within this distance
    digest: bytes = bytes(16)  # 16 bytes that identify the skill's file
    conductor: int | None = None  # side of the hand that leads alone; None: both hands matter
    regions: Regions = NORMAL
    residual_risk: str = ""  # what somebody accepted at learning, and who did; empty: nothing

    def __post_init__(self) -> None:
        frozen(self.workspace)

    def predict(
        self,
        hands: Vector,
        velocities: Vector,
        accelerations: Vector,
        stillness: Vector = STILL,
        *,
        before: Earlier | None = None,
        past: Vector | None = None,
        turns: Vector | None = None,
        belief: Vector | None = None,
        period_s: float = 0.0,
        lead_s: float = 0.0,
        clock: Vector = NO_CLOCK,
    ) -> Prediction:
        """Predict tool, orientation and gripper for the hands' positions, velocities and
        accelerations (2, 3) [m, m/s, m/s²] and stillness (2,), `lead_s` earlier than the
        demonstrated tool.

        * `before`: covariances and closure of an earlier prediction. They are then returned as they
          are, because computing covariances takes as long as all else.
        * `past` (ORDER, 2, 3) [m]: memory of the hands. Without it, the hands have always been
          where they are.
        * `turns` (TURNS, 2, 9): filters of the hands' rotation matrices, see `remember`. Without
          it, the orientation is the mean of the demonstrations.
        * `belief` (MOST_SEGMENTS,): probability of each segment, updated in place if `period_s` >
          0. Without it, the hands have always been at rest.
        * `clock` (3,) or more: clock of the task [s] and its two derivatives, see `task_clock`.

        The result is rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines whose last bits differ agree
        in all that follows.
        """
        now = self._conducting(np.stack([hands, velocities, accelerations])).reshape(3, 6)
        memory = (
            np.tile(now[0], (ORDER, 1))
            if past is None
            else self._conducting(past).reshape(ORDER, 6)
        )
        if belief is None:
            belief = self.model.belief(now[0])
        moving = now
        late_s = self.model.delay_s - lead_s
        if late_s:
            moving = np.empty((3, 6))
            delayed(now, memory, late_s, moving)
        if self.conductor is not None:
            stillness = stillness[[self.conductor] * 2]
        rotations = UNTOLD if turns is None else self._conducting(turns).reshape(len(turns), -1)
        return self.predicted(
            Seen(
                moving,
                stillness,
                memory,
                rotations,
                turn_lag_s(late_s),
                now,
                belief,
                period_s,
                clock,
            ),
            before,
        )

    def predicted(self, seen: Seen, before: Earlier | None) -> Prediction:
        """Prediction for hands that move like this; `before` as in `predict`."""
        motion = self.model.predict(seen, None if before is None else before[0])
        if before is not None and math.isnan(motion.gate_m):
            motion = motion._replace(gate_m=before[3])
        if self.turn is None and self.gripper is None:
            return Prediction(*motion, self.constant_turn, NO_GRIPPER)
        inputs, velocity = self.model.moving_inputs(seen)
        turn = self.constant_turn
        if self.turn is not None:
            turn = self.turn.predict(
                inputs, velocity, covariance=None if before is None else before[1]
            )
        if self.gripper is None or before is not None:
            return Prediction(*motion, turn, NO_GRIPPER if before is None else before[2])
        return Prediction(*motion, turn, self.gripper.predict(inputs))

    def _conducting(self, both: Vector) -> Vector:
        """Arrays of both hands (M, 2, D). If one hand leads alone, the other hand's values are
        replaced by its values.
        """
        return both if self.conductor is None else both[:, [self.conductor] * 2]

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """Tool positions (T, 3) [m] for hands (T, 6) [m] at rest; `names` are the via-points at
        which they rest, if given.
        """
        return self.model.mean(self.conducting(hands), names)

    def conducting(self, hands: Vector) -> Vector:
        """Hands (T, 6) [m]; if one hand leads alone, the other one is put where it is."""
        return self._conducting(np.reshape(hands, (-1, 2, 3))).reshape(-1, 6)

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] of the demonstrations."""
        return self.model.hands

    @cached_property
    def constant_turn(self) -> Turn:
        """Orientation that is predicted if none was learned."""
        return Turn(np.array(self.orientation, np.float64), np.zeros(3), np.zeros((3, 3)))

    @cached_property
    def demonstrated(self) -> Vector:
        """Lower and upper corner (2, 2, 3) [m] of the boxes of the left and right hand in the
        demonstrations.
        """
        hands = self.hands.reshape(-1, 2, 3)
        return np.stack([hands.min(axis=0), hands.max(axis=0)])
