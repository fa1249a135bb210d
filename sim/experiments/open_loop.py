"""What the service's core makes of hands whose arm does as it is told, and how what a rival
predicts becomes a skill that the core can run.

So all that is compared is estimated, held, clamped, followed and limited by one `Controller`; only
the predictions differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.core.controller import Controller, run
from service.core.frame import Frame, Tick
from service.core.intake.hand_estimator import STILL
from service.core.skill.pose import NO_GRIPPER
from service.core.skill.skill import Earlier, Prediction, Skill, clamp
from service.core.skill.tuning import CALM_MPS, MAX_TARGET_MPS2, MOTION_STEP_S
from service.settings.config import Settings, robot_description
from sim.experiments.results import Array

Law: TypeAlias = Callable[[Array], Array]
"""From hands (M, 6) [m] to tool (M, 3) [m]."""
USUAL = Settings()


def controller(skill: Skill, settings: Settings) -> Controller:
    """The service's core with an arm that is where it is told to be."""
    settings = msgspec.structs.replace(settings, arm=msgspec.structs.replace(settings.arm, source="assumed"))
    return Controller(settings, skill, urdf=robot_description(settings))


def frames(skill: Skill, ticks: Iterable[Tick], settings: Settings) -> NDArray[np.void]:
    """The service's frames (T,) of ticks."""
    found: list[Frame] = []
    run(controller(skill, settings), ticks, [lambda tick, frame: found.append(frame)])
    return np.array(found)


def targets(skill: Skill, hands: Array, settings: Settings = USUAL) -> Array:
    """Where the service would lead the tool (T, 3) [m] for hands (T, 6) [m] that rest there."""
    still, reach = np.zeros(3), settings.reach
    return np.array([clamp(at, still, still, box=skill.workspace, reach=reach).position for at in skill.mean(hands)])


def along_hands(law: Law, hands: Array, velocities: Array, accelerations: Array) -> Array:
    """The tools (T, 3) [m] of a law for hands (T, 6) [m] that move so, their velocities and
    accelerations, (T, 3, 3) together: as the service takes them of its skill between places.
    """
    speed = np.repeat(np.linalg.norm(velocities.reshape(-1, 2, 3), axis=2), 3, axis=1)
    goes = 1.0 - np.exp(-((speed / CALM_MPS) ** 4))
    step, bend = MOTION_STEP_S * goes * velocities, 0.5 * MOTION_STEP_S**2 * goes * accelerations
    return differences(*(law(hands + way * step + abs(way) * bend) for way in (-1.0, 0.0, 1.0)))


def differences(behind: Array, now: Array, ahead: Array) -> Array:
    """The middle one's motion (..., 3, 3), from positions (..., 3) [m] MOTION_STEP_S apart."""
    acceleration = (ahead - 2.0 * now + behind) / MOTION_STEP_S**2
    motion = [now, (ahead - behind) / (2.0 * MOTION_STEP_S), np.clip(acceleration, -MAX_TARGET_MPS2, MAX_TARGET_MPS2)]
    return np.stack(motion, axis=-2)


class Said(NamedTuple):
    """What a rival predicts: motion (3, 3), covariance (3, 3) [m²], whether the hands are far from
    its data.
    """

    motion: Array
    covariance: Array = np.zeros((3, 3))
    far: bool = False


@dataclass(frozen=True, eq=False)
class Rival(Skill):
    """A skill that predicts by another law, from hands (6,), their velocities and accelerations;
    all else is the skill's it was made from.
    """

    says: Callable[[Array, Array, Array], Said] = field(kw_only=True)

    def predict(
        self,
        hands: Array,
        velocities: Array,
        accelerations: Array,
        stillness: Array = STILL,
        *,
        before: Earlier | None = None,
        past: Array | None = None,
        turns: Array | None = None,
        belief: Array | None = None,
        period_s: float = 0.0,
        lead_s: float = 0.0,
    ) -> Prediction:
        """The law's tool, rounded as the service does; the gate is 1 where hands are far."""
        said = self.says(hands.reshape(6), velocities.reshape(6), accelerations.reshape(6))
        position, velocity, acceleration = np.round(said.motion, 6)
        turn, gate_m = self.constant_turn, float(said.far)
        return Prediction(position, velocity, acceleration, said.covariance, gate_m, 0.0, turn, NO_GRIPPER)


def rival(skill: Skill, says: Callable[[Array, Array, Array], Said], **changed: Any) -> Skill:
    """The skill with another law, and what else is changed."""
    own = {one.name: getattr(skill, one.name) for one in fields(Skill)}
    # its digest is of its name: nothing is recorded that would need the rest
    return Rival(**{**own, "name": "rival", "threshold": 0.5, "digest": b"rival".ljust(16), **changed}, says=says)


def by_law(skill: Skill, law: Law) -> Skill:
    """The skill with a law of where hands are; none is ever far."""
    return rival(skill, lambda *moving: Said(along_hands(law, *(x[None] for x in moving))[0]))
