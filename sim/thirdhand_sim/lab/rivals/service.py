"""The service's own skill as a method: learned by default, and in the paper's way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.results import Array
from thirdhand_sim.people import Places
from thirdhand_sim.sessions import SessionDemonstration
from thirdhand_sim.teach import recorded, via_points_of

GMR_COMPONENTS = 10
GMR_SEED = EXPERIMENTS["statistics"].seeds.method


@dataclass(frozen=True)
class Service:
    """The skill that the service learns by default, with the start among its via-points."""

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """The skill that `thirdhand.workbench.learning` learns."""
        return LearnedByService(
            learn([recorded(demonstration) for demonstration in demonstrations]), start=True
        )


@dataclass(frozen=True)
class ServiceAsPaper:
    """The paper's way in the service: a mixture makes the reference, places are via-points."""

    ell: float = 5.0
    penalty: float = 2.0
    spread_m: float = 0.01
    components: int = 10

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """The skill with these parameters."""
        taken = [recorded(demonstration) for demonstration in demonstrations]
        return LearnedByService(
            learn(
                taken,
                ell=self.ell,
                penalty=self.penalty,
                spread_m=self.spread_m,
                components=self.components,
            )
        )


@dataclass(frozen=True, eq=False)
class LearnedByService:
    """A skill of the service, and True if the start is among its via-points."""

    skill: StoredSkill
    start: bool = False

    def place(self, places: Places) -> Skill:
        """The skill adapted to the places."""
        return adapted(
            self.skill, via_points_of(places)[0 if self.start else 1 :], tolerance=TOLERANCE_M
        )


def joined(demonstrations: Sequence[SessionDemonstration]) -> Array:
    """Hands and tool (T, 9) [m] of all demonstrations."""
    return np.concatenate(
        [np.hstack([demonstration.hands, demonstration.tool]) for demonstration in demonstrations]
    )
