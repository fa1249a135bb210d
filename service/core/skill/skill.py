"""The skill as the loop uses it: from the motion of two hands to where the tool should be, how that
moves, and how sure it is.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from kmp import KMP
from kmp.compiled import compiled
from kmp.query import MotionPrediction
from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.intake.stillness import STILL
from service.core.record import Vector
from service.core.skill.places import Places, Task
from service.core.skill.pose import NO_GRIPPER, LearnedGripper, LearnedOrientation, Turn
from service.core.skill.task_parameterized import Moving, Placed
from service.core.skill.via_points import bent

MOTION_STEPS, COVARIANCE_STEPS = 1e6, 1e10  # [1/m], [1/m²] to which a prediction is rounded

Known: TypeAlias = tuple[Vector, Vector, float]
"""What was predicted at the newest sample of a hand: covariances of position (3, 3) [m²] and
orientation (3, 3) [rad²], and the closure of the gripper."""


class LearnedBetween(NamedTuple):
    """What a skill between places knows besides: its task, where its places were in the mean of the
    demonstrations, and by how much (M, 3) [m] the tool was off at some inputs (M, F) when
    demonstrations were left out.
    """

    task: Task
    nominal: Places
    seen: Vector
    errors: Vector


class Prediction(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    deviation: float  # [m] what is compared with the skill's threshold, see `Skill.deviations`
    turn: Turn
    closure: float  # of the gripper, 0 (open) to 1 (closed); NO_GRIPPER where the skill has none


@dataclass(frozen=True, eq=False)
class Skill:
    """Immutable: a KMP from both hands' positions (6 inputs [m]) to the tool's (3 outputs [m]), and
    what belongs to it; or, with `between`, one from their shares of its places to the tool's.

    Made by `service.learning`, which learns, adapts and stores it.
    """

    name: str
    primitive: KMP
    orientation: Vector  # (4,) of the tool where none was learned, quaternion x y z w
    workspace: Vector  # (2, 3) lower and upper corner for targets [m]
    threshold: float  # [m] a deviation above it is far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0  # of the mixture that it was learned with, 0 for none
    via_points: tuple[ViaPoint, ...] = ()
    turn: LearnedOrientation | None = None
    gripper: LearnedGripper | None = None
    tolerance: float = TOLERANCE_M  # [m] a reference point nearer to a via-point gives way
    between: LearnedBetween | None = None
    figures: str = field(default="", repr=False)  # JSON of what was found in learning; empty where it was not judged
    file: bytes = field(default=b"", repr=False)  # all of the above, as it is stored and recorded

    def predict(
        self,
        hands: Vector,
        velocities: Vector,
        accelerations: Vector,
        rest: Vector = STILL,
        *,
        before: Known | None = None,
    ) -> Prediction:
        """The prediction for hands (2, 3) [m] that move so, and rest so much (2,), see `core.rest`.

        Equation (8) of Huang et al. 2019, its derivatives along the motion, its covariance.
        Covariances take as long as all else; what was predicted just `before` may be given.

        Rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines that differ in the last bits agree on all
        that follows.
        """
        moving = hands.reshape(6), velocities.reshape(6), accelerations.reshape(6)
        found: MotionPrediction | Moving
        if self.placed is None:
            found = self.primitive.predict_motion(*moving, covariance=before is None)
        else:
            found = self.placed.moving(*moving, rest, covariance=before is None)
        given = before[0] if before is not None else found.covariance
        assert given is not None
        motion, rounded = np.empty((3, 3)), np.empty((3, 3))
        deviation = _round(found.mean, found.velocity, found.acceleration, given, motion, rounded)
        if isinstance(found, Moving):
            deviation = round(found.off * MOTION_STEPS) / MOTION_STEPS
        turn, closure = self._beside(*moving[:2], rest, before)
        return Prediction(motion[0], motion[1], motion[2], rounded, deviation, turn, closure)

    def _beside(self, hands: Vector, velocities: Vector, rest: Vector, before: Known | None) -> tuple[Turn, float]:
        """The orientation, learned or constant, and the closure of the gripper."""
        if self.turn is None and self.gripper is None:
            return self.constant_turn, NO_GRIPPER
        if self.placed is None:
            at, moving = hands, velocities
        else:
            at, moving = self.placed.moving_inputs(hands, velocities, rest)
        turn = self.constant_turn
        if self.turn is not None:
            turn = self.turn.predict(at, moving, covariance=None if before is None else before[1])
        if self.gripper is None or before is not None:
            return turn, NO_GRIPPER if before is None else before[2]
        return turn, self.gripper.predict(at)

    def inputs(self, hands: Vector) -> Vector:
        """The primitives' inputs (T, I) of hands (T, 6) [m] at rest."""
        return hands if self.placed is None else self.placed.inputs(hands)[0]

    @cached_property
    def constant_turn(self) -> Turn:
        """What is predicted where no orientation was learned."""
        return Turn(np.ascontiguousarray(self.orientation, np.float64), np.zeros(3), np.zeros((3, 3)))

    def mean(self, hands: Vector, rest: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) [m] that rest, wholly or so much (T, 2)."""
        hands = np.asarray(hands, np.float64)
        if self.placed is None:
            return self.primitive.mean(hands)
        return self.placed.mean(hands, rest)

    def covariances(self, hands: Vector, rest: Vector | None = None) -> Vector:
        """How sure `mean` is, (T, 3, 3) [m²]."""
        if self.placed is None:
            return self.primitive.predict(hands).covariance
        inputs, _ = self.placed.inputs(hands, rest)
        return np.array([self.placed.covariance(row) for row in inputs])

    def deviations(self, hands: Vector) -> Vector:
        """What the threshold is for, (T,) [m], for hands (T, 6) [m]: the predicted standard
        deviation, root mean square over the axes; between places, how far a hand is off them.
        """
        if self.placed is None:
            return standard_deviations(self.covariances(hands))
        return np.asarray(self.placed.inputs(hands)[1].max(axis=1))

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] that it knows: of its reference points, or at its places."""
        return self.primitive.inputs if self.placed is None else self.placed.corners_of_hands()

    @cached_property
    def placed(self) -> Placed | None:
        """A skill between places, among those in force."""
        if self.between is None:
            return None
        task, nominal, seen, errors = self.between
        layout = task.layout(nominal.told(self.via_points))
        plain = Placed.of(task, layout, self.primitive, seen, errors)
        others = [point for point in self.via_points if point.name not in task.names]
        return plain.through(*bent(plain.mean, plain.corners_of_hands(), others))

    @cached_property
    def demonstrated(self) -> Vector:
        """Least and greatest corner (2, 2, 3) of where it knows the left and the right hand [m]."""
        hands = self.hands.reshape(-1, 2, 3)
        return np.stack([hands.min(axis=0), hands.max(axis=0)])

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that tell this skill from any other."""
        return hashlib.blake2b(self.file, digest_size=16).digest()


def standard_deviations(covariances: Vector) -> Vector:
    """Standard deviations (...) of covariances (..., 3, 3), root mean square over the axes."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariances, axis1=-2, axis2=-1), 0.0) / 3))


@compiled
def _round(
    mean: Vector, velocity: Vector, acceleration: Vector, covariance: Vector, motion: Vector, rounded: Vector
) -> float:
    """Rounds a prediction into `motion` (3, 3) and `rounded` (3, 3); its deviation."""
    variance = 0.0
    for i in range(3):
        motion[0, i] = np.rint(mean[i] * MOTION_STEPS) / MOTION_STEPS
        motion[1, i] = np.rint(velocity[i] * MOTION_STEPS) / MOTION_STEPS
        motion[2, i] = np.rint(acceleration[i] * MOTION_STEPS) / MOTION_STEPS
        for j in range(3):
            rounded[i, j] = np.rint(covariance[i, j] * COVARIANCE_STEPS) / COVARIANCE_STEPS
        variance += rounded[i, i]
    return math.sqrt(variance / 3.0)
