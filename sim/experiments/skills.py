"""What is compared on modelled people: ours, and the simplest rivals. All are told the same places.

A method is a frozen set of parameters with `learn`; a model `place`s itself in a scene; what is
placed predicts. See `trials.Method`. To add one, add a class here or beside, and a row in `table`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.skill.skill import Skill
from service.core.skill.via_points import neighbourhoods
from service.learning.learn import learn
from service.learning.skill_file import StoredSkill
from service.learning.via_points import adapted
from sim.experiments.results import Array
from sim.experiments.trials import Predicted
from sim.people import Places
from sim.sessions import SessionDemonstration
from sim.teach import places_of, recorded

COVARIANCE_EVERY = 4  # ticks: as often as a slow tracker speaks
FOLLOW = np.hstack([np.eye(3), np.zeros((3, 3))])  # how the tool goes with the hands at the handover


def via_points(places: Places, *, start: bool = False) -> tuple[ViaPoint, ...]:
    """The places as the bench teaches them; the start too, if asked."""
    return places_of(places)[0 if start else 1 :]


@dataclass(frozen=True)
class Service:
    """Ours: `service.learning`, told the places, as the service uses it."""

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """The skill that the service learns by default."""
        return LearnedByService(learn([recorded(one) for one in demonstrations]), start=True)


@dataclass(frozen=True)
class ServiceAsPaper:
    """The paper's way in the service: a mixture makes the reference, places are its via-points."""

    ell: float = 5.0
    penalty: float = 2.0
    spread_m: float = 0.01
    components: int = 10

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedByService:
        """The skill with these parameters."""
        taken = [recorded(one) for one in demonstrations]
        return LearnedByService(
            learn(taken, ell=self.ell, penalty=self.penalty, spread_m=self.spread_m, components=self.components),
            start=False,
        )


@dataclass(frozen=True, eq=False)
class LearnedByService:
    """A skill of the service, and whether the start is among its places."""

    skill: StoredSkill
    start: bool

    def place(self, places: Places) -> Skill:
        """The skill adapted to the places."""
        return adapted(self.skill, via_points(places, start=self.start), tolerance=TOLERANCE_M)


@dataclass(frozen=True)
class NoDemonstrations:
    """Kernel regression through places and start alone; never far, as there is nothing to be near
    to.
    """

    ell: float = 5.0  # [1/m²] of exp(-ell |s - s'|²)
    deviation_m: float = 0.2  # where no place is near

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> NoDemonstrations:
        """Nothing is learned."""
        return self

    def place(self, places: Places) -> PlacedProcess:
        """The regression through these places."""
        at, wanted, std = neighbourhoods(via_points(places, start=True))
        kernel = Kernel(self.deviation_m**2, np.full(6, 1.0 / np.sqrt(2.0 * self.ell)))
        return PlacedProcess.of([kernel], [at], [wanted], [std**2], centre=wanted.mean(axis=0))


@dataclass(frozen=True)
class LookUp:
    """The mean of the taught tools, weighted by powers of the hands' distance; never far."""

    power: float = 4.0
    deviation_m: float = 0.03

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LookUp:
        """Nothing is learned."""
        return self

    def place(self, places: Places) -> PlacedLookUp:
        """The table of these places."""
        return PlacedLookUp(via_points(places, start=True), self)


@dataclass(frozen=True, eq=False)
class PlacedLookUp:
    """The table of four places."""

    points: tuple[ViaPoint, ...]
    method: LookUp
    memoryless = True

    def mean(self, hands: Array, rest: Array) -> Array:
        """As `trials.Placed`."""
        return self._weighed(hands)[0]

    def predict(self, hands: Array, rest: Array) -> Predicted:
        """As `trials.Placed`; the covariance is that of the weighted tools, and a constant."""
        mean, weights, tools = self._weighed(hands)
        off = tools - mean[:, None]
        covariance = np.einsum("tp,tpi,tpj->tij", weights, off, off) + self.method.deviation_m**2 * np.eye(3)
        return Predicted(mean, covariance, np.zeros(len(hands), bool))

    def _weighed(self, hands: Array) -> tuple[Array, Array, Array]:
        at = np.array([[*p.left, *p.right] for p in self.points])
        away = hands[:, None] - at
        tools = np.array([p.tool for p in self.points]) + np.stack(
            [away[:, i] @ (FOLLOW.T if p.follow == "left" else np.zeros((6, 3))) for i, p in enumerate(self.points)],
            axis=1,
        )
        weights = 1.0 / (np.sum(away**2, axis=2) + 1e-8) ** (self.method.power / 2.0)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("tp,tpi->ti", weights, tools), weights, tools


@dataclass(frozen=True, eq=False)
class Kernel:
    """A squared exponential: variance [m²], and a length for each input [m]."""

    variance: float
    lengths: Array

    def __call__(self, a: Array, b: Array) -> Array:
        return np.asarray(self.variance * np.exp(-0.5 * cdist(a / self.lengths, b / self.lengths, "sqeuclidean")))


@dataclass(frozen=True)
class GaussianProcess:
    """A Gaussian process over demonstrations that differ: one function of the hands that all share,
    and one of each demonstration's own, both with kernels found by maximum likelihood.

    So its samples are not taken for independent: demonstrations are. A scene is one more
    demonstration, of which the places are known. (Hierarchical model of Behseta et al. 2005, and
    Hensman et al. 2013.)
    """

    each: int = 30  # samples of a demonstration
    own_m: float = 0.0  # least deviation of a demonstration's own function
    gate: float = 1.5  # times the largest deviation along a demonstration that is left out: far

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedProcess:
        """The process with its kernels."""
        rows = [np.linspace(0, len(one.times) - 1, self.each).astype(int) for one in demonstrations]
        inputs = np.concatenate([one.hands[some] for one, some in zip(demonstrations, rows, strict=True)])
        outputs = np.concatenate([one.tool[some] for one, some in zip(demonstrations, rows, strict=True)])
        owner = np.repeat(np.arange(len(demonstrations)), self.each)
        same = owner[:, None] == owner
        centre = outputs.mean(axis=0)
        left, right = (cdist(part, part, "sqeuclidean") for part in (inputs[:, :3], inputs[:, 3:]))

        def cost(log: Array) -> tuple[float, Array]:
            shared, own, l_s, r_s, l_o, r_o, noise = np.exp(log)
            first = shared**2 * np.exp(-0.5 * (left / l_s**2 + right / r_s**2))
            second = same * own**2 * np.exp(-0.5 * (left / l_o**2 + right / r_o**2))
            root = cho_factor(first + second + (noise**2 + 1e-8) * np.eye(len(same)), lower=True)
            weights = cho_solve(root, outputs - centre)
            outer = 0.5 * (3.0 * cho_solve(root, np.eye(len(same))) - weights @ weights.T)
            by_first, by_second = outer * first, outer * second
            slopes = [2.0 * by_first.sum(), 2.0 * by_second.sum()]
            slopes += [(by_first * left).sum() / l_s**2, (by_first * right).sum() / r_s**2]
            slopes += [(by_second * left).sum() / l_o**2, (by_second * right).sum() / r_o**2]
            slopes += [2.0 * noise**2 * np.trace(outer)]
            value = 3.0 * np.log(np.diag(root[0])).sum() + 0.5 * np.sum(weights * (outputs - centre))
            return float(value), np.array(slopes)

        begin = np.log([0.2, max(0.05, self.own_m), 0.3, 0.3, 0.3, 0.3, 0.005])
        bounds = [
            (np.log(low), np.log(high))
            for low, high in [(0.02, 2.0), (max(self.own_m, 0.02), 2.0)] + [(0.05, 3.0)] * 4 + [(0.001, 0.05)]
        ]
        found = np.exp(minimize(cost, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 100}).x)
        kernels = [Kernel(found[i] ** 2, np.repeat(found[2 + 2 * i : 4 + 2 * i], 3)) for i in (0, 1)]
        base = LearnedProcess(kernels[0], kernels[1], float(found[6]), inputs, outputs, owner, centre, np.inf)
        held_out = [
            base.without(i).place(None).predict(one.hands, one.hands).deviation for i, one in enumerate(demonstrations)
        ]
        return base.gated(self.gate * max(float(one.max()) for one in held_out))


@dataclass(frozen=True, eq=False)
class LearnedProcess:
    """Samples (N, 6) and (N, 3) [m] of demonstrations, whose each is, and the two kernels."""

    shared: Kernel
    own: Kernel
    noise: float
    inputs: Array
    outputs: Array
    owner: Any
    centre: Array
    threshold: float

    def without(self, number: int) -> LearnedProcess:
        """With one demonstration left out."""
        kept = self.owner != number
        rows = self.inputs[kept], self.outputs[kept], self.owner[kept]
        return LearnedProcess(self.shared, self.own, self.noise, *rows, self.centre, self.threshold)

    def gated(self, threshold: float) -> LearnedProcess:
        """With another deviation [m] from which on hands are far."""
        rows = self.inputs, self.outputs, self.owner
        return LearnedProcess(self.shared, self.own, self.noise, *rows, self.centre, threshold)

    def place(self, places: Places | None) -> PlacedProcess:
        """The process in a scene with these places, or of which nothing is known."""
        at, wanted, std = neighbourhoods(() if places is None else via_points(places))
        groups = [self.owner == number for number in np.unique(self.owner)]
        inputs = [self.inputs[group] for group in groups] + [at]
        outputs = [self.outputs[group] for group in groups] + [wanted]
        noise = [np.full(int(group.sum()), self.noise**2) for group in groups] + [std**2]
        return PlacedProcess.of(
            [self.shared, self.own], inputs, outputs, noise, centre=self.centre, threshold=self.threshold
        )


class PredictedWithDeviation(Predicted):
    """A prediction whose axes have one deviation (T,) [m]."""

    @property
    def deviation(self) -> Array:
        """(T,) [m]."""
        return np.asarray(np.sqrt(self.covariance[:, 0, 0]))


@dataclass(frozen=True, eq=False)
class PlacedProcess:
    """A Gaussian process, solved. The last group of its data is the scene at hand, with which a
    query shares all kernels; with the others the first one only.
    """

    kernels: Sequence[Kernel]
    inputs: Array
    scene: Any
    root: tuple[Array, bool]
    weights: Array
    centre: Array
    threshold: float
    memoryless = True

    @staticmethod
    def of(
        kernels: Sequence[Kernel],
        inputs: Sequence[Array],
        outputs: Sequence[Array],
        noise: Sequence[Array],
        *,
        centre: Array,
        threshold: float = np.inf,
    ) -> PlacedProcess:
        """The process of groups of data: inputs (N, 6), outputs (N, 3) [m], noise (N,) [m²]."""
        s, owner = np.concatenate(inputs), np.repeat(np.arange(len(inputs)), [len(one) for one in inputs])
        k = kernels[0](s, s)
        for kernel in kernels[1:]:
            k += (owner[:, None] == owner) * kernel(s, s)
        root = cho_factor(k + np.diag(np.concatenate(noise) + 1e-9), lower=True)
        weights = cho_solve(root, np.concatenate(outputs) - centre)
        return PlacedProcess(kernels, s, owner == len(inputs) - 1, root, weights, centre, threshold)

    def _rows(self, hands: Array) -> Array:
        rows = self.kernels[0](hands, self.inputs)
        for kernel in self.kernels[1:]:
            rows[:, self.scene] += kernel(hands, self.inputs[self.scene])
        return rows

    def mean(self, hands: Array, rest: Array) -> Array:
        """As `trials.Placed`."""
        return np.asarray(self._rows(hands) @ self.weights + self.centre)

    def predict(self, hands: Array, rest: Array) -> PredictedWithDeviation:
        """As `trials.Placed`."""
        rows = self._rows(hands)
        white = solve_triangular(self.root[0], rows[::COVARIANCE_EVERY].T, lower=True)
        some = np.maximum(self._prior - np.sum(white**2, axis=0), 1e-6)
        variance = np.repeat(some, COVARIANCE_EVERY)[: len(hands)]
        covariance = variance[:, None, None] * np.eye(3)
        return PredictedWithDeviation(rows @ self.weights + self.centre, covariance, np.sqrt(variance) > self.threshold)

    @cached_property
    def _prior(self) -> float:
        return sum(kernel.variance for kernel in self.kernels)
