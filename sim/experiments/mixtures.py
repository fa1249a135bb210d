"""Rivals that model hands and tool together, for the comparison on modelled people: mixture
regression, the same in task-parameterised form, and interaction ProMPs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kmp import GaussianMixture
from sim.experiments.results import Array
from sim.experiments.seeds import BY_EXPERIMENT
from sim.experiments.trials import Predicted
from sim.people import Places
from sim.scene import TOOL_FROM_HAND
from sim.sessions import SessionDemonstration

LEAST_STD_M, SEED = 0.001, BY_EXPERIMENT["people"].method
UNUSUAL = 0.001  # share of the demonstrations' samples that are less usual than the threshold
SLACK = 10.0  # [nat] less usual than those: far


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


def way_gone(shown: SessionDemonstration) -> Array:
    """The share (T,) of the way that hands and tool have gone; rest is none."""
    window = np.ones(13) / 13  # half a second
    x = np.stack([np.convolve(np.pad(c, 6, mode="edge"), window, mode="valid") for c in joined(shown).T], axis=1)
    speed = np.linalg.norm(np.gradient(x, axis=0).reshape(-1, 3, 3), axis=2).sum(axis=1)
    gone = np.cumsum(np.maximum(speed - 0.0008, 0.00005))  # [m]: less than 2 cm/s is no way gone
    return np.asarray((gone - gone[0]) / (gone[-1] - gone[0]))


@dataclass(frozen=True)
class MixtureRegression:
    """A Gaussian mixture of hands and tool, conditioned on the hands (GMR). Knows no places."""

    components: int = 10

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedMixture:
        """The mixture, by EM."""
        samples = np.concatenate([joined(one) for one in demonstrations])
        mixture = GaussianMixture.fit(samples, components=self.components, seed=SEED)
        return LearnedMixture(mixture, _threshold([log_density(mixture, one.hands) for one in demonstrations]))


@dataclass(frozen=True, eq=False)
class LearnedMixture:
    """A mixture, and the log density of hands below which they are far."""

    mixture: GaussianMixture
    threshold: float
    memoryless = True

    def place(self, places: Places) -> LearnedMixture:
        """The same: it cannot be told."""
        return self

    def mean(self, hands: Array, rest: Array) -> Array:
        """As `trials.Placed`."""
        return self.mixture.regress(hands).mean

    def predict(self, hands: Array, rest: Array) -> Predicted:
        """As `trials.Placed`; far where such hands were not seen."""
        found = self.mixture.regress(hands)
        return Predicted(found.mean, found.covariance, log_density(self.mixture, hands) < self.threshold)


def log_density(mixture: GaussianMixture, hands: Array) -> Array:
    """Of hands (T, 6) under a mixture of hands and more: (T,) [nat]."""
    logs = np.log(mixture.weights) + np.stack(
        [
            _log_normal(hands, mean[:6], covariance[:6, :6])
            for mean, covariance in zip(mixture.means, mixture.covariances, strict=True)
        ],
        axis=1,
    )
    return _log_sum(logs)


def _log_sum(logs: Array) -> Array:
    top = logs.max(axis=1)
    return np.asarray(top + np.log(np.exp(logs - top[:, None]).sum(axis=1)))


def _log_normal(x: Array, mean: Array, covariance: Array) -> Array:
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, (x - mean).T)
    return np.asarray(-np.log(np.diag(root)).sum() - 0.5 * (white**2).sum(axis=0) - 0.5 * len(mean) * np.log(2 * np.pi))


def _threshold(densities: Sequence[Array]) -> float:
    return float(np.quantile(np.concatenate(densities), UNUSUAL)) - SLACK


@dataclass(frozen=True)
class TaskParameterised:
    """TP-GMM (Calinon 2016): one mixture seen from frames at the start and at each place, whose
    normals are multiplied where the frames are now, and then conditioned on the hands.

    A frame moves hands and tool each by where they are at its place.
    """

    components: int = 10
    regularization_m: float = 0.02
    iterations: int = 40

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedFrames:
        """The mixture, by EM from equal spans of the way; the frames share responsibilities."""
        local = np.concatenate([joined(one)[:, None] - frames(one.places) for one in demonstrations])  # (M, 4, 9)
        phase = 0.999 * np.concatenate([way_gone(one) for one in demonstrations])
        count = self.components
        share = np.eye(count)[(phase * count).astype(int)]
        weights, means, covariances = np.empty(0), np.empty(0), np.empty(0)
        for _ in range(self.iterations):
            total = share.sum(axis=0) + 1e-9
            weights = total / total.sum()
            means = np.einsum("mk,mfi->kfi", share, local) / total[:, None, None]
            off = local[:, None] - means
            covariances = np.einsum("mk,mkfi,mkfj->kfij", share, off, off, optimize=True) / total[:, None, None, None]
            covariances += self.regularization_m**2 * np.eye(9)
            logs = np.log(weights) + np.stack(
                [sum(_log_normal(local[:, f], means[k, f], covariances[k, f]) for f in range(4)) for k in range(count)],
                axis=1,
            )
            share = np.exp(logs - _log_sum(logs)[:, None])
        learned = LearnedFrames(weights, means, covariances, -np.inf)
        placed = [log_density(learned.place(one.places).mixture, one.hands) for one in demonstrations]
        return LearnedFrames(weights, means, covariances, _threshold(placed))


@dataclass(frozen=True, eq=False)
class LearnedFrames:
    """A mixture in four frames: weights (K,), means (K, 4, 9), covariances (K, 4, 9, 9) [m]."""

    weights: Array
    means: Array
    covariances: Array
    threshold: float

    def place(self, places: Places) -> LearnedMixture:
        """The mixture where the frames are now."""
        precisions = np.linalg.inv(self.covariances)
        covariances = np.linalg.inv(precisions.sum(axis=1))
        moved = self.means + frames(places)
        means = np.einsum("kij,kj->ki", covariances, np.einsum("kfij,kfj->ki", precisions, moved))
        covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
        return LearnedMixture(GaussianMixture(self.weights, means, covariances), self.threshold)


@dataclass(frozen=True)
class InteractionProMP:
    """Interaction ProMP (Amor et al. 2014; Ewerton et al. 2015): hands and tool share a
    distribution of weights over the phase, which is conditioned on the places.

    The phase is estimated from the hands so far by a hidden Markov model over a grid; the tool is
    the expectation over it, conditioned on where the hands are now. Not conditioned: weights on
    earlier hands.
    """

    bases: int = 15
    ridge: float = 0.1  # times the mean variance of the weights, added to each
    by_length: bool = True  # the phase of a demonstration: the way gone, else time
    hands_m: float = 0.02  # by which hands are off what the model says
    cells: int = 100
    sharpness: float = 0.1  # of one observation of the hands: they come faster than they tell anything new

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedInteraction:
        """The distribution of the weights."""
        weights, residuals, at = [], [], []
        for one in demonstrations:
            x, phase = joined(one), self.phase(one)
            basis = self.basis(phase)
            w = np.linalg.solve(basis.T @ basis + 1e-3 * np.eye(self.bases), basis.T @ x)
            residuals.append(np.mean((x - basis @ w) ** 2, axis=0))
            weights.append(w.T.ravel())
            order = np.argmin(np.linalg.norm(x[:, None] - frames(one.places), axis=2), axis=0)
            at.append(phase[order])
        w = np.array(weights)
        covariance = np.cov(w.T)
        covariance += self.ridge * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
        noise = np.mean(residuals, axis=0)
        base = LearnedInteraction(self, w.mean(axis=0), covariance, noise, np.median(at, axis=0), -np.inf)
        usual = [base.place(one.places).evidence(one.hands)[::5] for one in demonstrations]
        return LearnedInteraction(self, base.mean, covariance, noise, base.at, _threshold(usual))

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
        return way_gone(one)


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
        """Conditioned on hands and tool at each place."""
        method, mean, covariance = self.method, self.mean, self.covariance
        std = max(places.std_m / np.sqrt(3.0), LEAST_STD_M)
        noise = np.concatenate([np.full(6, std**2 + method.hands_m**2), np.full(3, std**2)])
        for phase, wanted in zip(self.at, frames(places), strict=True):
            rows = np.kron(np.eye(9), method.basis(np.array([phase])))
            gain = np.linalg.solve(rows @ covariance @ rows.T + np.diag(noise), rows @ covariance).T
            mean = mean + gain @ (wanted - rows @ mean)
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
    every: int = 5  # ticks from one look at the phase to the next
    memoryless = False

    def evidence(self, hands: Array) -> Array:
        """Log density (T,) of hands (T, 6) at the likeliest phase."""
        return np.asarray(self._likelihoods(hands).max(axis=1))

    def mean(self, hands: Array, rest: Array) -> Array:
        """As `trials.Placed`."""
        return self.predict(hands, rest).mean

    def predict(self, hands: Array, rest: Array) -> Predicted:
        """As `trials.Placed`."""
        logs = self._likelihoods(hands)
        beliefs = self._phases(logs)  # (T, Z)
        over = self.covariances[:, :6, :6]
        gains = np.linalg.solve(over, self.covariances[:, :6, 6:])  # (Z, 6, 3)
        left = self.covariances[:, 6:, 6:] - np.einsum("zio,zip->zop", gains, self.covariances[:, :6, 6:])
        constant = self.means[:, 6:] - np.einsum("zi,zio->zo", self.means[:, :6], gains)
        tools = constant + np.einsum("ti,zio->tzo", hands, gains, optimize=True)
        mean = np.einsum("tz,tzo->to", beliefs, tools)
        off = tools - mean[:, None]
        covariance = np.einsum("tz,zop->top", beliefs, left) + np.einsum(
            "tz,tzo,tzp->top", beliefs, off, off, optimize=True
        )
        return Predicted(mean, covariance, logs.max(axis=1) < self.threshold)

    def _likelihoods(self, hands: Array) -> Array:
        rows = zip(self.means, self.covariances, strict=True)
        return np.stack([_log_normal(hands, mean[:6], covariance[:6, :6]) for mean, covariance in rows], axis=1)

    def _phases(self, logs: Array) -> Array:
        """The belief in each phase (T, Z), from the hands until then."""
        cells = self.method.cells
        steps = {-1: 0.05, 0: 0.60, 1: 0.25, 2: 0.08, 3: 0.02}
        move = np.sum([share * np.eye(cells, k=step) for step, share in steps.items()], axis=0) + 1e-6
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
