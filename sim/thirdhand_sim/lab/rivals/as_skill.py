"""Predictions of a rival as a skill that the service's core can run.

For all rivals the same core estimates, holds, clamps, follows and limits; only the predictions
differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from thirdhand.core.numerics import MOTION_STEP_S
from thirdhand.core.skill.model import Motion, Seen
from thirdhand.core.skill.pose import NO_GRIPPER
from thirdhand.core.skill.skill import Earlier, Prediction, Skill
from thirdhand.core.skill.tuning import CALM_MPS, MAX_TARGET_MPS2
from thirdhand_sim.bench import Bench
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.method import Observed, PlacedModel

HandsToTool: TypeAlias = Callable[[Array], Array]
"""From hands (M, 6) [m] to tool (M, 3) [m]."""
STEPS = np.array([-1.0, 0.0, 1.0])


def along_hands(law: HandsToTool, hands: Array, velocities: Array, accelerations: Array) -> Array:
    """Motion of the tool (T, 3, 3) by a law, for hands (T, 6) [m] with these velocities and
    accelerations, computed as the service does for its skill between via-points.
    """
    speed = np.repeat(np.linalg.norm(velocities.reshape(-1, 2, 3), axis=2), 3, axis=1)
    goes = 1.0 - np.exp(-((speed / CALM_MPS) ** 4))
    step = MOTION_STEP_S * goes * velocities
    bend = 0.5 * MOTION_STEP_S**2 * goes * accelerations
    return differences(*(law(hands + sign * step + abs(sign) * bend) for sign in STEPS))


def differences(behind: Array, now: Array, ahead: Array) -> Array:
    """Motion (..., 3, 3) at the middle one of three positions (..., 3) [m], MOTION_STEP_S apart."""
    acceleration = (ahead - 2.0 * now + behind) / MOTION_STEP_S**2
    motion = [
        now,
        (ahead - behind) / (2.0 * MOTION_STEP_S),
        np.clip(acceleration, -MAX_TARGET_MPS2, MAX_TARGET_MPS2),
    ]
    return np.stack(motion, axis=-2)


class RivalSaid(NamedTuple):
    """A rival's prediction: motion (3, 3), covariance (3, 3) [m²], and True if the hands are far
    from its data.
    """

    motion: Array
    covariance: Array = np.zeros((3, 3))
    far: bool = False


@dataclass(frozen=True, eq=False)
class Rival(Skill):
    """A skill that predicts by another law, from hands (6,), their velocities and accelerations;
    all else is that of the skill it was made from.
    """

    says: Callable[[Array, Array, Array], RivalSaid] = field(kw_only=True)

    def predicted(self, seen: Seen, before: Earlier | None) -> Prediction:
        """The law's tool, rounded as the service does; the gate is 1 where hands are far."""
        prediction = self.says(*seen.now.copy())
        position, velocity, acceleration = np.round(prediction.motion, 6)
        turn = self.constant_turn
        gate_m = float(prediction.far)
        motion = Motion(position, velocity, acceleration, prediction.covariance, gate_m)
        return Prediction(*motion, turn, NO_GRIPPER)


def rival(skill: Skill, says: Callable[[Array, Array, Array], RivalSaid], **changed: Any) -> Skill:
    """The skill with another law, and with other changed fields."""
    values = {attribute.name: getattr(skill, attribute.name) for attribute in fields(Skill)}
    # The digest is that of the name only: no recording needs more.
    return Rival(
        **{**values, "name": "rival", "threshold": 0.5, "digest": b"rival".ljust(16), **changed},
        says=says,
    )


def in_bench(skill: Skill, placed: PlacedModel | Skill) -> Callable[[Bench], Skill]:
    """A placed model as a bench's skill, made from `skill`. A rival is never far from its data."""
    if isinstance(placed, Skill):
        return lambda bench: placed

    def of_hands(*moving: Array) -> RivalSaid:
        return RivalSaid(
            along_hands(lambda at: placed.mean(Observed.resting(at)), *(x[None] for x in moving))[0]
        )

    return lambda bench: rival(skill, of_hands)
