"""The skill as the loop uses it: from the motion of two hands to where the tool should be, how that
moves, and how sure it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.intake.stillness import STILL
from service.core.record import Record, Vector
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.model import Model
from service.core.skill.pose import NO_GRIPPER, LearnedGripper, LearnedOrientation, Turn
from service.core.skill.task_parameterized import TaskParameterized

MODELS: tuple[type[Model], ...] = (HandsKMP, TaskParameterized)
"""All that a skill may predict with."""
STATE_FIELDS = tuple(field for model in MODELS for field in model.state_fields)
"""What skills remember from tick to tick: the state has these fields, whichever is in force."""

Known: TypeAlias = tuple[Vector, Vector, float]
"""What was predicted at the newest sample of a hand: covariances of position (3, 3) [m²] and
orientation (3, 3) [rad²], and the closure of the gripper."""


class Prediction(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    gate_m: float  # [m] what is compared with the skill's threshold, see `Model.measure`
    turn: Turn
    closure: float  # of the gripper, 0 (open) to 1 (closed); NO_GRIPPER where the skill has none


@dataclass(frozen=True, eq=False)
class Skill:
    """Immutable: a model of how the tool goes with both hands, and what belongs to it.

    Made by `service.learning`, which learns, adapts and stores it.
    """

    name: str
    model: Model
    orientation: Vector  # (4,) of the tool where none was learned, quaternion x y z w
    workspace: Vector  # (2, 3) lower and upper corner for targets [m]
    threshold: float  # [m] hands whose `gate_m` is above it are far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0  # of the mixture that it was learned with, 0 for none
    via_points: tuple[ViaPoint, ...] = ()
    turn: LearnedOrientation | None = None
    gripper: LearnedGripper | None = None
    tolerance: float = TOLERANCE_M  # [m] a reference point nearer to a via-point gives way
    digest: bytes = bytes(16)  # 16 bytes of its file that tell it from any other

    def predict(
        self,
        hands: Vector,
        velocities: Vector,
        accelerations: Vector,
        stillness: Vector = STILL,
        *,
        before: Known | None = None,
        memory: Record | None = None,
    ) -> Prediction:
        """The prediction for hands (2, 3) [m] that move so, and are so still (2,).

        Covariances take as long as all else; what was predicted just `before` may be given.
        `memory` is the state, for a model that remembers.

        Rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines that differ in the last bits agree on all
        that follows.
        """
        stacked = np.empty((3, 2, 3))
        stacked[0], stacked[1], stacked[2] = hands, velocities, accelerations
        moving = stacked.reshape(3, 6)
        motion = self.model.predict(moving, stillness, None if before is None else before[0], memory)
        if self.turn is None and self.gripper is None:
            return Prediction(*motion, self.constant_turn, NO_GRIPPER)
        return Prediction(*motion, *self._beside(moving, stillness, before))

    def _beside(self, moving: Vector, stillness: Vector, before: Known | None) -> tuple[Turn, float]:
        """The orientation, learned or constant, and the closure of the gripper."""
        at, velocity = self.model.moving_inputs(moving, stillness)
        turn = self.constant_turn
        if self.turn is not None:
            turn = self.turn.predict(at, velocity, covariance=None if before is None else before[1])
        if self.gripper is None or before is not None:
            return turn, NO_GRIPPER if before is None else before[2]
        return turn, self.gripper.predict(at)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) [m] that are so still (T, 2), or wholly."""
        return self.model.mean(hands, stillness)

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] that it knows."""
        return self.model.hands

    @cached_property
    def constant_turn(self) -> Turn:
        """What is predicted where no orientation was learned."""
        return Turn(np.ascontiguousarray(self.orientation, np.float64), np.zeros(3), np.zeros((3, 3)))

    @cached_property
    def demonstrated(self) -> Vector:
        """Least and greatest corner (2, 2, 3) of where it knows the left and the right hand [m]."""
        hands = self.hands.reshape(-1, 2, 3)
        return np.stack([hands.min(axis=0), hands.max(axis=0)])
