"""Gaussian processes from hands to tool: one posterior, and three ways to choose the kernel.

`GaussianProcess` assumes independent demonstrations, but not independent samples. `SampleProcess`
assumes independent samples. `by_folds` chooses lengths that predict some demonstrations best from
the others, for inputs beside the hands too.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.skill.via_points import neighbourhoods
from thirdhand_sim.lab.people.left_out import LeftOut
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.method import DependsOn, Law, Learn, Observed, Predicted
from thirdhand_sim.lab.rivals.service import GMR_SEED, joined
from thirdhand_sim.people import Places
from thirdhand_sim.sessions import SessionDemonstration
from thirdhand_sim.teach import via_points_of

COVARIANCE_EVERY = 4  # ticks from one covariance to the next, about the rate of a slow tracker
VIA_STD_M = 0.001
PROCESS_SAMPLES = 400
FOLDS = 4
# Candidates for the hands' lengths, in the inputs' median distance, and ratios of other inputs'
# lengths.
LENGTHS = (0.15, 0.3, 0.6, 1.2)
LENGTH_RATIOS = (1.0, 0.3, 3.0)
PROCESS_NOISES = (0.01, 0.1, 1.0)


class Posterior(NamedTuple):
    """A process conditioned on N outputs: a Cholesky factor of K + Sigma, and the weights (K +
    Sigma)^-1 y.
    """

    root: tuple[Array, bool]
    weights: Array  # (N, 3)
    centre: Array  # (3,)

    @staticmethod
    def of(covariance: Array, outputs: Array, centre: Array, *, lower: bool = True) -> Posterior:
        """The posterior from K + Sigma (N, N) and outputs (N, 3) [m]; `lower` is the triangle of
        the factor.
        """
        root = cho_factor(covariance, lower=lower)
        return Posterior(root, cho_solve(root, outputs - centre), centre)

    def mean(self, rows: Array) -> Array:
        """k (K + Sigma)^-1 y for rows k (M, N) of the kernel: (M, 3)."""
        return np.asarray(rows @ self.weights + self.centre)

    def explained(self, rows: Array) -> Array:
        """k (K + Sigma)^-1 k' (M,), by which the data lower the variance."""
        factor, lower = self.root
        white = solve_triangular(factor, rows.T, lower=lower, trans="N" if lower else "T")
        return np.asarray(np.sum(white**2, axis=0))


@dataclass(frozen=True, eq=False)
class ProcessKernel:
    """A squared exponential: variance [m²], and a length for each input [m]."""

    variance: float
    lengths: Array

    def __call__(self, a: Array, b: Array) -> Array:
        return np.asarray(
            self.variance * np.exp(-0.5 * cdist(a / self.lengths, b / self.lengths, "sqeuclidean"))
        )


@dataclass(frozen=True, eq=False)
class PlacedProcess:
    """A process in a scene. The last group of its data is the scene itself: a query shares all
    kernels with it, and only the first kernel with other groups.
    """

    kernels: Sequence[ProcessKernel]
    inputs: Array
    scene: Any
    posterior: Posterior
    threshold: float
    depends_on = DependsOn.HANDS

    @staticmethod
    def of(
        kernels: Sequence[ProcessKernel],
        inputs: Sequence[Array],
        outputs: Sequence[Array],
        noise: Sequence[Array],
        *,
        centre: Array,
        threshold: float = np.inf,
    ) -> PlacedProcess:
        """The process of groups of data: inputs (N, 6), outputs (N, 3) [m], noise (N,) [m²]."""
        s = np.concatenate(inputs)
        owner = np.repeat(np.arange(len(inputs)), [len(group) for group in inputs])
        k = kernels[0](s, s)
        for kernel in kernels[1:]:
            k += (owner[:, None] == owner) * kernel(s, s)
        posterior = Posterior.of(
            k + np.diag(np.concatenate(noise) + 1e-9), np.concatenate(outputs), centre
        )
        return PlacedProcess(kernels, s, owner == len(inputs) - 1, posterior, threshold)

    def _rows(self, hands: Array) -> Array:
        rows = self.kernels[0](hands, self.inputs)
        for kernel in self.kernels[1:]:
            rows[:, self.scene] += kernel(hands, self.inputs[self.scene])
        return rows

    def mean(self, seen: Observed) -> Array:
        """As `PlacedModel.mean`."""
        return self.posterior.mean(self._rows(seen.hands))

    def predict(self, seen: Observed) -> Predicted:
        """As `PlacedModel.predict`."""
        rows = self._rows(seen.hands)
        prior = sum(kernel.variance for kernel in self.kernels)
        sparse_variance = np.maximum(
            prior - self.posterior.explained(rows[::COVARIANCE_EVERY]), 1e-6
        )
        variance = np.repeat(sparse_variance, COVARIANCE_EVERY)[: len(rows)]
        covariance = variance[:, None, None] * np.eye(3)
        return Predicted(self.posterior.mean(rows), covariance, np.sqrt(variance) > self.threshold)


@dataclass(frozen=True)
class GaussianProcess:
    """A Gaussian process over demonstrations that differ: a common function of the hands, plus a
    function of each demonstration, both with kernels of maximum likelihood.

    Samples of a demonstration are therefore not independent; demonstrations are. A scene is a
    further demonstration, whose places are known. (Hierarchical model of Behseta et al. 2005, and
    Hensman et al. 2013.)
    """

    each: int = 30  # samples of a demonstration
    own_m: float = 0.0  # least deviation of a demonstration's own function
    gate: float = 1.5  # hands are far above this multiple of the largest held-out deviation

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedProcess:
        """The process with its kernels."""
        rows = [
            np.linspace(0, len(demo.times) - 1, self.each).astype(int) for demo in demonstrations
        ]
        inputs = np.concatenate(
            [demo.hands[index] for demo, index in zip(demonstrations, rows, strict=True)]
        )
        outputs = np.concatenate(
            [demo.tool[index] for demo, index in zip(demonstrations, rows, strict=True)]
        )
        owner = np.repeat(np.arange(len(demonstrations)), self.each)
        same_owner = owner[:, None] == owner
        centre = outputs.mean(axis=0)
        left, right = (cdist(part, part, "sqeuclidean") for part in (inputs[:, :3], inputs[:, 3:]))

        def cost(log: Array) -> tuple[float, Array]:
            shared, individual, l_s, r_s, l_o, r_o, noise = np.exp(log)
            first = shared**2 * np.exp(-0.5 * (left / l_s**2 + right / r_s**2))
            second = same_owner * individual**2 * np.exp(-0.5 * (left / l_o**2 + right / r_o**2))
            root = cho_factor(
                first + second + (noise**2 + 1e-8) * np.eye(len(same_owner)), lower=True
            )
            weights = cho_solve(root, outputs - centre)
            outer = 0.5 * (3.0 * cho_solve(root, np.eye(len(same_owner))) - weights @ weights.T)
            by_first = outer * first
            by_second = outer * second
            slopes = [2.0 * by_first.sum(), 2.0 * by_second.sum()]
            slopes += [(by_first * left).sum() / l_s**2, (by_first * right).sum() / r_s**2]
            slopes += [(by_second * left).sum() / l_o**2, (by_second * right).sum() / r_o**2]
            slopes += [2.0 * noise**2 * np.trace(outer)]
            value = 3.0 * np.log(np.diag(root[0])).sum() + 0.5 * np.sum(
                weights * (outputs - centre)
            )
            return float(value), np.array(slopes)

        begin = np.log([0.2, max(0.05, self.own_m), 0.3, 0.3, 0.3, 0.3, 0.005])
        bounds = [(0.02, 2.0), (max(self.own_m, 0.02), 2.0)] + [(0.05, 3.0)] * 4 + [(0.001, 0.05)]
        limits: list[tuple[float, float]] = np.log(bounds).tolist()
        optimum = np.exp(
            minimize(
                cost, begin, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 100}
            ).x
        )
        kernels = [
            ProcessKernel(optimum[i] ** 2, np.repeat(optimum[2 + 2 * i : 4 + 2 * i], 3))
            for i in (0, 1)
        ]
        base = LearnedProcess(
            kernels[0], kernels[1], float(optimum[6]), inputs, outputs, owner, centre, np.inf
        )
        variances = [base.without(i).variances(demo.hands) for i, demo in enumerate(demonstrations)]
        return replace(base, threshold=self.gate * float(np.sqrt(np.concatenate(variances).max())))


@dataclass(frozen=True, eq=False)
class LearnedProcess:
    """Samples (N, 6) and (N, 3) [m], the demonstration of each, and the kernels."""

    shared: ProcessKernel
    own: ProcessKernel
    noise: float
    inputs: Array
    outputs: Array
    owner: Any
    centre: Array
    threshold: float  # deviation [m] above which hands are far

    def without(self, number: int) -> LearnedProcess:
        """The process without one demonstration."""
        mask = self.owner != number
        return replace(
            self, inputs=self.inputs[mask], outputs=self.outputs[mask], owner=self.owner[mask]
        )

    def variances(self, hands: Array) -> Array:
        """Predicted variances (T,) [m²] at hands (T, 6) [m] in an unknown scene."""
        covariance = self.place(None).predict(Observed.resting(hands)).covariance
        assert covariance is not None
        return covariance[:, 0, 0]

    def place(self, places: Places | None) -> PlacedProcess:
        """The process in a scene with these places, or in an unknown scene."""
        via_hands, via_tools, std = neighbourhoods(
            () if places is None else via_points_of(places)[1:]
        )
        groups = [self.owner == number for number in np.unique(self.owner)]
        inputs = [self.inputs[group] for group in groups] + [via_hands]
        outputs = [self.outputs[group] for group in groups] + [via_tools]
        noise = [np.full(int(group.sum()), self.noise**2) for group in groups] + [std**2]
        return PlacedProcess.of(
            [self.shared, self.own],
            inputs,
            outputs,
            noise,
            centre=self.centre,
            threshold=self.threshold,
        )


@dataclass(frozen=True)
class SampleProcess:
    """A Gaussian process of the demonstrations' samples, with lengths and noise by maximum
    likelihood, or with one length for all inputs by `ell` [1/m²].

    The neighbourhoods of places, as in the service's skill, are data with 1 mm of noise, and
    replace the samples near them.
    """

    every: int = 20
    ell: float | None = None

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LearnedSamples:
        """The process with its kernel."""
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        samples = joined(demonstrations)[:: self.every]
        inputs = samples[:, :6]
        outputs = samples[:, 6:]
        centre = samples[:, 6:].mean(axis=0)
        if self.ell is None:
            size = ConstantKernel(0.05, (1e-4, 1e2))
            lengths = RBF(np.full(6, 0.3), (0.03, 10.0))
            kernel = size * lengths + WhiteKernel(1e-4, (1e-6, 1e-2))
        else:
            lengths = RBF(np.full(6, (2 * self.ell) ** -0.5), "fixed")
            kernel = ConstantKernel(0.05) * lengths + WhiteKernel(1e-4, "fixed")
        fitted = (
            GaussianProcessRegressor(kernel, random_state=GMR_SEED)
            .fit(inputs, outputs - centre)
            .kernel_
        )
        shared = ProcessKernel(
            float(fitted.k1.k1.constant_value), np.asarray(fitted.k1.k2.length_scale)
        )
        return LearnedSamples(shared, float(fitted.k2.noise_level), inputs, outputs, centre)


@dataclass(frozen=True, eq=False)
class LearnedSamples:
    """Samples (N, 6) and (N, 3) [m], kernel and noise [m²]."""

    kernel: ProcessKernel
    noise: float
    inputs: Array
    outputs: Array
    centre: Array

    def place(self, places: Places) -> PlacedProcess:
        """The process in a scene with these places."""
        via_hands, via_tools, _ = neighbourhoods(via_points_of(places)[1:])
        is_far = cdist(self.inputs, via_hands).min(axis=1) >= TOLERANCE_M
        inputs = np.concatenate([self.inputs[is_far], via_hands])
        outputs = np.concatenate([self.outputs[is_far], via_tools])
        noise = np.concatenate(
            [np.full(int(is_far.sum()), self.noise), np.full(len(via_hands), VIA_STD_M**2)]
        )
        # Closed loops amplify rounding: the factor's other triangle moves the events of a scene by
        # 0.8 mm.
        covariance = self.kernel(inputs, inputs) + np.diag(noise)
        posterior = Posterior.of(covariance, outputs, self.centre, lower=False)
        return PlacedProcess([self.kernel], inputs, slice(None), posterior, np.inf)


def by_folds(inputs: Callable[[Observed | LeftOut], list[Array]]) -> Learn:
    """A process whose noise and length for each group of inputs predict held-out demonstrations
    best; its variance is scaled to these errors.
    """

    def learn(shown: Sequence[LeftOut]) -> Law:
        count = max(2, PROCESS_SAMPLES // len(shown))
        rows = [
            np.unique(np.linspace(0, len(take.tool) - 1, count).round().astype(int))
            for take in shown
        ]
        tool = np.concatenate([take.tool[index] for take, index in zip(shown, rows, strict=True)])
        thin = [[x[index] for x in inputs(take)] for take, index in zip(shown, rows, strict=True)]
        groups = [np.concatenate(parts) for parts in zip(*thin, strict=True)]
        squares = [cdist(x, x, "sqeuclidean") for x in groups]
        usual = [max(float(np.median(d)), 1e-6) for d in squares]
        fold_of = np.repeat(np.arange(len(shown)) % FOLDS, [len(index) for index in rows])

        def solved(known: Array, noise: float, kept: Any = slice(None)) -> Posterior:
            return Posterior.of(
                known + noise * np.eye(len(known)), tool[kept], tool[kept].mean(axis=0)
            )

        tried = []
        for length, other, noise in itertools.product(
            LENGTHS, LENGTH_RATIOS if len(groups) > 1 else LENGTH_RATIOS[:1], PROCESS_NOISES
        ):
            lengths = length**2 * np.array(usual) * [1.0, *[other**2] * (len(groups) - 1)]
            gram = np.exp(
                -0.5
                * np.sum([d / square for d, square in zip(squares, lengths, strict=True)], axis=0)
            )
            errors = []
            variances = []
            for fold in np.unique(fold_of):
                training = fold_of != fold
                held = fold_of == fold
                posterior = solved(gram[np.ix_(training, training)], noise, training)
                across = gram[np.ix_(held, training)]
                errors.append(np.sum((tool[held] - posterior.mean(across)) ** 2, axis=1))
                variances.append(1.0 + noise - posterior.explained(across))
            squared_errors = np.concatenate(errors)
            left = np.concatenate(variances)
            tried.append(
                (
                    float(squared_errors.mean()),
                    lengths,
                    noise,
                    float(np.mean(squared_errors / left)) / 3.0,
                )
            )
        _, lengths, noise, scale = min(tried, key=lambda one: one[0])

        def kernel(a: list[Array], b: list[Array]) -> Array:
            distances = [
                cdist(x, y, "sqeuclidean") / square
                for x, y, square in zip(a, b, lengths, strict=True)
            ]
            return np.asarray(np.exp(-0.5 * np.sum(distances, axis=0)))

        posterior = solved(kernel(groups, groups), noise)

        def predict(seen: Observed) -> Predicted:
            rows = kernel(inputs(seen), groups)
            left = np.maximum(scale * (1.0 + noise - posterior.explained(rows)), 1e-6)
            return Predicted(posterior.mean(rows), left[:, None, None] * np.eye(3))

        return Law(predict)

    return learn
