"""The service's core in process, with an arm that moves exactly as commanded."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import Frame, Tick
from thirdhand.core.skill.skill import Skill, clamp
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.lab.results import Array

USUAL = Settings()


def controller(skill: Skill, settings: Settings, tuning: Tuning = TUNING) -> Controller:
    """The service's core with an arm that is where it is commanded."""
    arm = msgspec.structs.replace(settings.arm, source="assumed")
    return Controller(
        msgspec.structs.replace(settings, arm=arm),
        skill,
        urdf=robot_description(settings),
        tuning=tuning,
    )


def frames(
    skill: Skill, ticks: Iterable[Tick], settings: Settings, tuning: Tuning = TUNING
) -> NDArray[np.void]:
    """The service's frames (T,) of ticks."""
    log: list[Frame] = []
    with threadpool_limits(1):
        run(controller(skill, settings, tuning), ticks, [lambda tick, frame: log.append(frame)])
    return np.array(log)


def targets(skill: Skill, hands: Array, settings: Settings = USUAL) -> Array:
    """Targets (T, 3) [m] of the service for hands (T, 6) [m] at rest."""
    still = np.zeros(3)
    reach = settings.reach
    return np.array(
        [
            clamp(target, still, still, box=skill.workspace, reach=reach).position
            for target in skill.mean(hands)
        ]
    )
