"""The service's own skill as a method, and the paper's."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians, ViaPointMissed
from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.method import DependsOn, Law, Observed, Predicted
from thirdhand_sim.people import Places
from thirdhand_sim.sessions import SessionDemonstration
from thirdhand_sim.teach import places_of, recorded

COMPONENTS, POINTS, SEED = 10, 200, EXPERIMENTS["statistics"].seeds.method
PAPER_ELL, PAPER_LAMBDA, PAPER_VIA_STD_M = 0.5, 2.0, 0.001


@dataclass(frozen=True)
class Service:
    """The skill that the service learns by default, with the start among its via-points."""

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """By `thirdhand.workbench.learning`."""
        return LearnedByService(learn([recorded(one) for one in demonstrations]), start=True)


@dataclass(frozen=True)
class ServiceAsPaper:
    """The paper's way in the service: a mixture makes the reference, places are via-points."""

    ell: float = 5.0
    penalty: float = 2.0
    spread_m: float = 0.01
    components: int = 10

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """The skill with these parameters."""
        taken = [recorded(one) for one in demonstrations]
        return LearnedByService(
            learn(taken, ell=self.ell, penalty=self.penalty, spread_m=self.spread_m, components=self.components)
        )


@dataclass(frozen=True, eq=False)
class LearnedByService:
    """A skill of the service, and whether the start is among its via-points."""

    skill: StoredSkill
    start: bool = False

    def place(self, places: Places) -> Skill:
        """The skill adapted to the places."""
        return adapted(self.skill, places_of(places)[0 if self.start else 1 :], tolerance=TOLERANCE_M)


@dataclass(frozen=True)
class Paper:
    """KMP with the paper's ell = 0.5 and lambda = 2 (in metres), each place a bare point of
    variance 1e-6 m².
    """

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedAsPaper:
        """A mixture by EM, its regression at sampled inputs, and a KMP of that."""
        samples = joined(demonstrations)
        mixture = GaussianMixture.fit(samples, components=COMPONENTS, seed=SEED)
        inputs = mixture.sample_inputs(POINTS, dimensions=6, seed=SEED)
        reference, centre = mixture.regress(inputs), samples[:, 6:].mean(axis=0)
        kernel = GaussianKernel(PAPER_ELL)
        return LearnedAsPaper(KMP.fit(inputs, reference, kernel=kernel, lambda_mean=PAPER_LAMBDA, prior_mean=centre))


@dataclass(frozen=True, eq=False)
class LearnedAsPaper:
    """The primitive before it is adapted."""

    primitive: KMP

    def place(self, places: Places) -> Law:
        """Adapted to the places."""
        points = places_of(places)[1:]
        desired = Gaussians.of([point.tool for point in points], deviation=PAPER_VIA_STD_M)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)  # the experiment counts these
            hands = [[*point.left, *point.right] for point in points]
            primitive = self.primitive.adapt(hands, desired, tolerance=TOLERANCE_M)

        def predict(seen: Observed) -> Predicted:
            return Predicted(primitive.mean(seen.hands))

        return Law(predict, DependsOn.HANDS)


def joined(demonstrations: Sequence[SessionDemonstration]) -> Array:
    """Hands and tool (T, 9) [m] of all demonstrations."""
    return np.concatenate([np.hstack([one.hands, one.tool]) for one in demonstrations])
