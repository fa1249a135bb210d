"""From demonstrations to a primitive in one call, with the kernel's lengths and the lambdas chosen where none are given.

Chosen by leaving one demonstration out: what is learned from the others must predict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.checks import Array, numbers
from kmp.gaussians import Gaussians
from kmp.gmm import GaussianMixture
from kmp.immutable import Immutable, frozen
from kmp.kernel import GaussianKernel, Kernel, VelocityKernel
from kmp.primitive import KMP

_ELLS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # over twice the variance of the inputs
_LAMBDAS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # over the mean variance of the reference
_OF_MEAN = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5)  # lambda of the covariance, over that of the mean
_STEP = 4.0  # of the search around the best
_SWEEPS = 2
_HELD_OUT = 200  # points of a demonstration that are predicted


@dataclass(frozen=True, eq=False)
class Score(Immutable):
    """How well some hyper-parameters predict a demonstration that was left out."""

    ell: float | Array
    lambda_mean: float
    lambda_covariance: float | None
    """None where only the mean was tried."""
    error: float
    """[unit of the outputs] root mean square over all demonstrations of the distance to the mean; rates do not count."""
    surprise: float | None
    """[nat] mean negative log-likelihood of a point, None where only the mean was tried."""


@dataclass(frozen=True, eq=False)
class Learned(Immutable):
    """A primitive, the mixture that its reference is from, and the scores of all that was tried, the best first."""

    primitive: KMP
    mixture: GaussianMixture
    scores: tuple[Score, ...]
    regression_error: float
    """[unit of the outputs] what mixture regression alone (the reference without kernel) scores, nan if none was tried."""

    def report(self, count: int = 10) -> str:
        """The best of the scores as a table."""
        lines = [f"{'ell':>40} {'lambda':>10} {'lambda_c':>10} {'error':>10} {'surprise':>10}"]
        for one in self.scores[:count]:
            ell = " ".join(f"{value:.3g}" for value in np.atleast_1d(one.ell))
            other = "" if one.lambda_covariance is None else f"{one.lambda_covariance:.3g}"
            surprise = "" if one.surprise is None else f"{one.surprise:.3f}"
            lines.append(f"{ell:>40} {one.lambda_mean:>10.3g} {other:>10} {one.error:>10.4g} {surprise:>10}")
        return "\n".join([*lines, f"{'mixture regression alone':>40} {'':>10} {'':>10} {self.regression_error:>10.4g}"])


@dataclass(frozen=True)
class _Recipe:
    components: int
    seed: int
    count: int
    regularization: float
    channels: int


@dataclass(frozen=True)
class _Fold:
    inputs: Array
    reference: Gaussians
    prior_mean: Array
    held_inputs: Array
    held_outputs: Array
    regression_error: float


def learn(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    components: int,
    seed: int,
    count: int = 200,
    velocity: bool = False,
    kernel: Kernel | None = None,
    lambda_mean: float | None = None,
    lambda_covariance: float | None = None,
    regularization: float = 1e-6,
) -> Learned:
    """The primitive of H demonstrations, each inputs (T, I) and outputs (T, O), and how its parameters were chosen.

    The paper, sections II-A, II-B: a mixture of `components`, its regression at `count` inputs (evenly spaced over
    time, where I is 1; drawn from the marginal else), and the primitive, whose mean returns to the reference's.

    A kernel (one length for each input) and lambda that are not given are those with the least error on the
    demonstration that is left out, over all of them; then a lambda of the covariance that is not given is the one with
    the least surprise. `velocity`: the outputs are values and then their rates over time, the kernel a VelocityKernel.
    The numbers that are tried follow the units of the data.
    """
    data = _checked(demonstrations)
    recipe = _Recipe(components, seed, count, regularization, 2 if velocity else 1)
    full, mixture = _reference(data, recipe)
    scores: list[Score] = []
    folds: list[_Fold] = []
    if kernel is None or lambda_mean is None or lambda_covariance is None:
        if len(data) < 2:
            raise ValueError(
                f"{len(data)} demonstration given: at least 2 needed to choose parameters by leaving one out. "
                "Give kernel, lambda_mean and lambda_covariance, or another demonstration."
            )
        folds = [_fold(data, h, recipe) for h in range(len(data))]
        outputs = data[0][1].shape[1] // recipe.channels
        kernel, lambda_mean = _search(folds, recipe.channels, kernel, lambda_mean, scores)
        if lambda_covariance is None:
            tried = [_surprise(folds, outputs, kernel, lambda_mean, f * lambda_mean) for f in _OF_MEAN]
            scores += tried
            lambda_covariance = min(tried, key=lambda one: one.surprise or 0.0).lambda_covariance
    primitive = KMP.fit(
        full.inputs,
        full.reference,
        kernel=kernel,
        lambda_mean=lambda_mean,
        lambda_covariance=lambda_covariance,
        prior_mean=full.prior_mean,
    )
    order = sorted(scores, key=lambda one: (one.error, np.inf if one.surprise is None else one.surprise))
    plain = np.sqrt(np.mean([fold.regression_error**2 for fold in folds])) if folds else np.nan
    return Learned(primitive, mixture, tuple(order), float(plain))


def _search(folds: Sequence[_Fold], channels: int, kernel: Kernel | None, lambda_mean: float | None, scores: list[Score]) -> tuple[Kernel, float]:
    """The kernel and lambda of the least error: a grid, then steps along each length and lambda. Notes the scores."""
    dimensions, outputs = folds[0].inputs.shape[1], folds[0].reference.outputs // channels
    spread = np.var(np.concatenate([fold.held_inputs for fold in folds]), axis=0)
    spread = np.where(spread > 0, spread, spread.max() or 1.0)  # an input that never changed says nothing of its length
    variance = float(np.mean([np.trace(fold.reference.covariance, axis1=1, axis2=2).mean() for fold in folds]))
    variance /= folds[0].reference.outputs

    def kernel_of(parameters: tuple[float, ...]) -> Kernel:
        ell = np.exp(np.array(parameters[:-1]))
        return kernel or (VelocityKernel(float(ell[0])) if channels == 2 else GaussianKernel(ell))

    def error(parameters: tuple[float, ...]) -> float:
        k = kernel_of(parameters)
        penalty = lambda_mean or float(np.exp(parameters[-1]))
        found = _error(folds, outputs, k, penalty)
        scores.append(Score(k.ell, penalty, None, found, None))
        return found

    lengths = [0.0] if kernel else np.log(_ELLS)
    penalties = [0.0] if lambda_mean else np.log(_LAMBDAS) - np.log(variance)
    start = np.log(0.5 / spread)
    grid = [(*(start + length), penalty) for length in lengths for penalty in penalties]
    best = min((error(one), one) for one in grid)
    free = ([] if kernel else list(range(dimensions))) + ([] if lambda_mean else [dimensions])
    for _ in range(_SWEEPS):
        for i in free:
            for step in (np.log(_STEP), -np.log(_STEP)):
                other = tuple(value + step * (i == n) for n, value in enumerate(best[1]))
                best = min(best, (error(other), other))
    found = best[1]
    return kernel_of(found), lambda_mean or float(np.exp(found[-1]))


def _error(folds: Sequence[_Fold], outputs: int, kernel: Kernel, penalty: float) -> float:
    squares = []
    for fold in folds:
        try:
            mean = _fitted(fold, kernel, penalty, penalty).mean(fold.held_inputs)
        except ValueError:  # not solvable to working precision: no candidate
            return np.inf
        squares.append((((mean - fold.held_outputs)[:, :outputs]) ** 2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def _surprise(folds: Sequence[_Fold], outputs: int, kernel: Kernel, penalty: float, other: float) -> Score:
    found = []
    for fold in folds:
        try:
            prediction = _fitted(fold, kernel, penalty, other).predict(fold.held_inputs)
        except ValueError:
            return Score(kernel.ell, penalty, other, np.inf, np.inf)
        covariance = prediction.covariance[:, :outputs, :outputs]
        miss = (fold.held_outputs - prediction.mean)[:, :outputs]
        root = np.linalg.cholesky(covariance)
        white = np.linalg.solve(root, miss[:, :, None])[:, :, 0]
        log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        found.append(0.5 * (log_det + (white**2).sum(axis=1) + outputs * np.log(2 * np.pi)).mean())
    return Score(kernel.ell, penalty, other, _error(folds, outputs, kernel, penalty), float(np.mean(found)))


def _fitted(fold: _Fold, kernel: Kernel, penalty: float, other: float) -> KMP:
    return KMP.fit(
        fold.inputs,
        fold.reference,
        kernel=kernel,
        lambda_mean=penalty,
        lambda_covariance=other,
        prior_mean=fold.prior_mean,
    )


def _reference(data: Sequence[tuple[Array, Array]], recipe: _Recipe) -> tuple[_Fold, GaussianMixture]:
    """The reference of demonstrations, with nothing held out."""
    samples = np.concatenate([np.hstack(one) for one in data])
    dimensions = data[0][0].shape[1]
    mixture = GaussianMixture.fit(samples, components=recipe.components, seed=recipe.seed, regularization=recipe.regularization)
    if dimensions == 1:
        inputs = np.linspace(samples[:, 0].min(), samples[:, 0].max(), recipe.count)[:, None]
    else:
        inputs = mixture.sample_inputs(recipe.count, dimensions=dimensions, seed=recipe.seed)
    reference = mixture.regress(inputs)
    prior = reference.mean.mean(axis=0)
    prior[len(prior) // recipe.channels :] = 0
    nothing = np.empty((0, 0))
    return _Fold(frozen(inputs), reference, frozen(prior), nothing, nothing, np.nan), mixture


def _fold(data: Sequence[tuple[Array, Array]], h: int, recipe: _Recipe) -> _Fold:
    rest, mixture = _reference([*data[:h], *data[h + 1 :]], recipe)
    inputs, outputs = data[h]
    some = np.linspace(0, len(inputs) - 1, min(len(inputs), _HELD_OUT)).astype(int)
    values = outputs.shape[1] // recipe.channels
    miss = (mixture.regress(inputs[some]).mean - outputs[some])[:, :values]
    return _Fold(rest.inputs, rest.reference, rest.prior_mean, inputs[some], outputs[some], float(np.sqrt((miss**2).sum(axis=1).mean())))


def _checked(demonstrations: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[Array, Array]]:
    if len(demonstrations) == 0:
        raise ValueError("demonstrations: none given, at least 1 needed.")
    data: list[tuple[Array, Array]] = []
    for h, (inputs, outputs) in enumerate(demonstrations):
        i, o = (data[0][0].shape[1], data[0][1].shape[1]) if data else ("I", "O")
        s = numbers(f"demonstrations[{h}] inputs", inputs, "T", i)
        data.append((s, numbers(f"demonstrations[{h}] outputs", outputs, len(s), o)))
        if len(s) == 0:
            raise ValueError(f"demonstrations[{h}]: no sample given, at least 1 needed.")
    return data
