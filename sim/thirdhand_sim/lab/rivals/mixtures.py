"""Gaussian mixtures of hands and tool: mixture regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kmp import GaussianMixture
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.method import DependsOn, Observed, Predicted
from thirdhand_sim.people import Places
from thirdhand_sim.scene import TOOL_FROM_HAND
from thirdhand_sim.sessions import SessionDemonstration

MIXTURE_SEED = EXPERIMENTS["people"].seeds.method
# Hands are far if their log density is below this quantile of the demonstrations', less a slack
# [nat].
UNUSUAL = 0.001
THRESHOLD_SLACK = 10.0


def frames(places: Places) -> Array:
    """Hands and tool at start, handover, glass and soldering, as perceived: (4, 9) [m]."""
    p = places
    return np.array(
        [
            np.concatenate([p.left_start, p.right_start, p.robot_start]),
            np.concatenate([p.handover, p.right_start, p.handover + TOOL_FROM_HAND]),
            np.concatenate([p.board, p.iron, p.glass]),
            np.concatenate([p.board, p.right_final, p.carry]),
        ]
    )


def joined(shown: SessionDemonstration) -> Array:
    """Hands and tool (T, 9) [m]."""
    return np.hstack([shown.hands, shown.tool])


def path_share(shown: SessionDemonstration) -> Array:
    """Share (T,) of the path of hands and tool; at rest it does not grow."""
    window = np.ones(13) / 13  # half a second
    x = np.stack(
        [np.convolve(np.pad(c, 6, mode="edge"), window, mode="valid") for c in joined(shown).T],
        axis=1,
    )
    speed = np.linalg.norm(np.gradient(x, axis=0).reshape(-1, 3, 3), axis=2).sum(axis=1)
    travel_m = np.cumsum(np.maximum(speed - 0.0008, 0.00005))  # [m] slower than 2 cm/s is rest
    return np.asarray((travel_m - travel_m[0]) / (travel_m[-1] - travel_m[0]))


@dataclass(frozen=True)
class MixtureRegression:
    """A Gaussian mixture of hands and tool, conditioned on the hands (GMR), without places."""

    components: int = 10

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedMixture:
        """The mixture, by EM."""
        samples = np.concatenate([joined(demonstration) for demonstration in demonstrations])
        mixture = GaussianMixture.fit(samples, components=self.components, seed=MIXTURE_SEED)
        return LearnedMixture(
            mixture,
            threshold(
                [log_density(mixture, demonstration.hands) for demonstration in demonstrations]
            ),
        )


@dataclass(frozen=True, eq=False)
class LearnedMixture:
    """A mixture, and the log density of hands below which they are far."""

    mixture: GaussianMixture
    threshold: float
    depends_on = DependsOn.HANDS

    def place(self, places: Places) -> LearnedMixture:
        """The model itself, which ignores the places."""
        return self

    def mean(self, seen: Observed) -> Array:
        """As `PlacedModel.mean`."""
        return self.mixture.regress(seen.hands).mean

    def predict(self, seen: Observed) -> Predicted:
        """As `PlacedModel.predict`; it holds for hands that were not demonstrated."""
        regression = self.mixture.regress(seen.hands)
        return Predicted(
            regression.mean,
            regression.covariance,
            log_density(self.mixture, seen.hands) < self.threshold,
        )


def log_density(mixture: GaussianMixture, hands: Array) -> Array:
    """Log density (T,) [nat] of hands (T, 6) under a mixture of hands and more."""
    logs = np.log(mixture.weights) + np.stack(
        [
            log_normal(hands, mean[:6], covariance[:6, :6])
            for mean, covariance in zip(mixture.means, mixture.covariances, strict=True)
        ],
        axis=1,
    )
    top = logs.max(axis=1)
    return np.asarray(top + np.log(np.exp(logs - top[:, None]).sum(axis=1)))


def log_normal(x: Array, mean: Array, covariance: Array) -> Array:
    """Log density (T,) of x (T, D) under a normal distribution."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, (x - mean).T)
    return np.asarray(
        -np.log(np.diag(root)).sum()
        - 0.5 * (white**2).sum(axis=0)
        - 0.5 * len(mean) * np.log(2 * np.pi)
    )


def threshold(densities: Sequence[Array]) -> float:
    """The log density [nat] below which hands are far from the demonstrations."""
    return float(np.quantile(np.concatenate(densities), UNUSUAL)) - THRESHOLD_SLACK
