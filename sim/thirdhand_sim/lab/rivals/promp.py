"""ProMPs: of a trajectory, and of hands and tool together (interaction ProMP)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thirdhand_sim.lab.results import Array, ExperimentError
from thirdhand_sim.lab.rivals.method import DependsOn, Observed, Predicted
from thirdhand_sim.lab.rivals.mixtures import frames, joined, log_normal, path_share, threshold
from thirdhand_sim.people import Places
from thirdhand_sim.sessions import SessionDemonstration

BASES = 20  # basis functions of each axis over time
# Multiple of the mean variance of the weights. Of 0 to 100, ProMP with this one changes a letter
# away from via-points about as little as KMP.
RIDGE = 10.0
PROMP_LEAST_STD_M = 0.001


def learned_promp(
    times: Sequence[Array], trajectories: Sequence[Array], *, bases: int, ridge: float = RIDGE
) -> Any:
    """The ProMP (of movement_primitives) of trajectories (T, O) at times (T,) [s], from 0.

    With H demonstrations, the weights' covariance has the rank H - 1, so at most H - 1 numbers can
    be met, but three places in space have nine. Therefore `ridge` times the mean variance is added
    to the diagonal; with it, ProMP meets via-points as it does in the paper.

    Raises ExperimentError.
    """
    try:
        from movement_primitives.promp import ProMP
    except ImportError:
        raise ExperimentError(
            "ProMPs need movement_primitives, which is not installed: pip install "
            "'thirdhand[experiments]'"
        ) from None
    primitive = ProMP(n_dims=trajectories[0].shape[1], n_weights_per_dim=bases)
    # `imitate` divides the given times in place
    primitive.imitate([t.copy() for t in times], list(trajectories))
    variance = ridge * np.trace(primitive.weight_cov) / len(primitive.weight_cov)
    return primitive.from_weight_distribution(
        primitive.weight_mean, primitive.weight_cov + variance * np.eye(len(primitive.weight_cov))
    )


@dataclass(frozen=True)
class InteractionProMP:
    """Interaction ProMP (Amor et al. 2014; Ewerton et al. 2015): hands and tool share a
    distribution of weights over the phase, which is conditioned on the places.

    A hidden Markov model over a grid estimates the phase from the hands so far; the tool is the
    expectation over the phase, conditioned on the present hands. The weights are not conditioned on
    earlier hands.
    """

    bases: int = 15
    ridge: float = 0.1  # this multiple of the mean variance of the weights is added to each
    by_length: bool = True  # the phase of a demonstration: share of the path, else of the time
    hands_m: float = 0.02  # deviation of the hands from the model
    cells: int = 100
    sharpness: float = 0.1  # weight of an observation, as consecutive ones are correlated

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedInteraction:
        """The distribution of the weights."""
        weights = []
        residuals = []
        phases = []
        for demonstration in demonstrations:
            x = joined(demonstration)
            phase = self.phase(demonstration)
            basis = self.basis(phase)
            w = np.linalg.solve(basis.T @ basis + 1e-3 * np.eye(self.bases), basis.T @ x)
            residuals.append(np.mean((x - basis @ w) ** 2, axis=0))
            weights.append(w.T.ravel())
            order = np.argmin(
                np.linalg.norm(x[:, None] - frames(demonstration.places), axis=2), axis=0
            )
            phases.append(phase[order])
        w = np.array(weights)
        covariance = np.cov(w.T)
        covariance += self.ridge * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
        noise = np.mean(residuals, axis=0)
        base = LearnedInteraction(
            self, w.mean(axis=0), covariance, noise, np.median(phases, axis=0), -np.inf
        )
        usual = [
            base.place(demonstration.places).evidence(demonstration.hands)[::5]
            for demonstration in demonstrations
        ]
        return replace(base, threshold=threshold(usual))

    def basis(self, phase: Array) -> Array:
        """(T, B) normalised radial functions of the phase (T,) in [0, 1]."""
        centres = np.linspace(-0.05, 1.05, self.bases)
        width = 1.1 / (self.bases - 1)
        rows = np.exp(-0.5 * ((phase[:, None] - centres) / width) ** 2)
        return np.asarray(rows / rows.sum(axis=1, keepdims=True))

    def phase(self, one: SessionDemonstration) -> Array:
        """The phase (T,) of a demonstration's samples."""
        if not self.by_length:
            return np.linspace(0.0, 1.0, len(one.times))
        return path_share(one)


@dataclass(frozen=True, eq=False)
class LearnedInteraction:
    """Mean and covariance of the weights, noise (9,) [m²], and the phases (4,) of `frames`."""

    method: InteractionProMP
    mean: Array
    covariance: Array
    noise: Array
    at: Array
    threshold: float

    def place(self, places: Places) -> PlacedInteraction:
        """The model conditioned on hands and tool at each place."""
        method = self.method
        mean = self.mean
        covariance = self.covariance
        std = max(places.std_m / np.sqrt(3.0), PROMP_LEAST_STD_M)
        noise = np.concatenate([np.full(6, std**2 + method.hands_m**2), np.full(3, std**2)])
        for phase, frame in zip(self.at, frames(places), strict=True):
            rows = np.kron(np.eye(9), method.basis(np.array([phase])))
            gain = np.linalg.solve(rows @ covariance @ rows.T + np.diag(noise), rows @ covariance).T
            mean = mean + gain @ (frame - rows @ mean)
            covariance = covariance - gain @ rows @ covariance
        grid = np.linspace(0.0, 1.0, method.cells)
        basis = method.basis(grid)
        means = (mean.reshape(9, -1) @ basis.T).T
        blocks = covariance.reshape(9, method.bases, 9, method.bases)
        covariances = np.einsum("zb,ibjc,zc->zij", basis, blocks, basis, optimize=True)
        covariances += np.diag(self.noise + 1e-6)
        covariances[:, :6, :6] += method.hands_m**2 * np.eye(6)
        return PlacedInteraction(method, means, covariances, self.threshold)


@dataclass(frozen=True, eq=False)
class PlacedInteraction:
    """Hands and tool at each of Z phases: means (Z, 9) [m], covariances (Z, 9, 9) [m²]."""

    method: InteractionProMP
    means: Array
    covariances: Array
    threshold: float
    every: int = 5  # ticks from one estimate of the phase to the next
    depends_on = DependsOn.PAST

    def evidence(self, hands: Array) -> Array:
        """Log density (T,) of hands (T, 6) at the most likely phase."""
        return np.asarray(self._likelihoods(hands).max(axis=1))

    def mean(self, seen: Observed) -> Array:
        """As `PlacedModel.mean`."""
        return self.predict(seen).mean

    def predict(self, seen: Observed) -> Predicted:
        """As `PlacedModel.predict`."""
        logs = self._likelihoods(seen.hands)
        beliefs = self._phases(logs)  # (T, Z)
        over = self.covariances[:, :6, :6]
        gains = np.linalg.solve(over, self.covariances[:, :6, 6:])  # (Z, 6, 3)
        left = self.covariances[:, 6:, 6:] - np.einsum(
            "zio,zip->zop", gains, self.covariances[:, :6, 6:]
        )
        constant = self.means[:, 6:] - np.einsum("zi,zio->zo", self.means[:, :6], gains)
        tools = constant + np.einsum("ti,zio->tzo", seen.hands, gains, optimize=True)
        mean = np.einsum("tz,tzo->to", beliefs, tools)
        offsets = tools - mean[:, None]
        covariance = np.einsum("tz,zop->top", beliefs, left) + np.einsum(
            "tz,tzo,tzp->top", beliefs, offsets, offsets, optimize=True
        )
        return Predicted(mean, covariance, logs.max(axis=1) < self.threshold)

    def _likelihoods(self, hands: Array) -> Array:
        rows = zip(self.means, self.covariances, strict=True)
        return np.stack(
            [log_normal(hands, mean[:6], covariance[:6, :6]) for mean, covariance in rows], axis=1
        )

    def _phases(self, logs: Array) -> Array:
        """The belief in each phase (T, Z), from the hands until then."""
        cells = self.method.cells
        steps = {-1: 0.05, 0: 0.60, 1: 0.25, 2: 0.08, 3: 0.02}
        move = (
            np.sum([share * np.eye(cells, k=step) for step, share in steps.items()], axis=0) + 1e-6
        )
        move /= move.sum(axis=1, keepdims=True)
        belief = np.exp(-np.arange(cells) / 3.0)
        belief /= belief.sum()
        out = np.empty_like(logs)
        for k in range(0, len(logs), self.every):
            scaled = self.method.sharpness * logs[k]
            belief = (belief @ move) * np.exp(scaled - scaled.max())
            belief /= belief.sum()
            out[k : k + self.every] = belief
        return out
