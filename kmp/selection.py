"""From demonstrations to a primitive, with the hyper-parameters chosen where none are given.

Chosen by leaving one demonstration out: what is learned from the others must predict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from kmp.checks import Array, check_kind, checked_demonstrations, positive, whole
from kmp.gaussians import Gaussians
from kmp.gmm import GaussianMixture
from kmp.hyperparameters import checked_kernel
from kmp.immutable import Immutable, frozen
from kmp.kernel import GaussianKernel, Kernel
from kmp.primitive import KMP
from kmp.time_kernels import VelocityKernel

_ELLS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # over twice the variance of the inputs
_LAMBDAS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # over the mean variance of the reference
_OF_MEAN = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5)  # lambda_c over lambda
_STEP = 4.0  # of the search around the best
_SWEEPS = 2
_HELD_OUT = 200  # points of a demonstration that are predicted


@dataclass(frozen=True, eq=False, repr=False)
class Score(Immutable):
    """How well some hyper-parameters predict a demonstration that was left out."""

    ell: float | Array
    lambda_mean: float
    lambda_covariance: float | None
    """None where only the mean was tried."""
    rmse: float
    """[unit of the outputs] of the mean, over all demonstrations; rates do not count."""
    negative_log_likelihood: float | None
    """[nat] the mean of a point's, None where only the mean was tried."""


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Immutable):
    """A primitive, the mixture of its reference, and the scores of all that was tried."""

    primitive: KMP
    mixture: GaussianMixture
    scores: tuple[Score, ...]
    """The best first."""
    regression_rmse: float
    """[unit of the outputs] of mixture regression without a kernel; nan if none was tried."""

    def report(self, count: int = 10) -> str:
        """The best `count` of the scores as a table."""
        lines = [f"{'ell':>40} {'lambda':>10} {'lambda_c':>10} {'RMSE':>10} {'-log lik.':>10}"]
        for one in self.scores[: whole("count", count)]:
            ell = " ".join(f"{value:.3g}" for value in np.atleast_1d(one.ell))
            other = "" if one.lambda_covariance is None else f"{one.lambda_covariance:.3g}"
            likelihood = "" if one.negative_log_likelihood is None else f"{one.negative_log_likelihood:.3f}"
            lines.append(f"{ell:>40} {one.lambda_mean:>10.3g} {other:>10} {one.rmse:>10.4g} {likelihood:>10}")
        return "\n".join([*lines, f"{'mixture regression alone':>40} {'':>10} {'':>10} {self.regression_rmse:>10.4g}"])


@dataclass(frozen=True)
class _Fold:
    """What is learned from all demonstrations but one, and the points of that one."""

    inputs: Array
    reference: Gaussians
    prior_mean: Array
    held_inputs: Array
    held_outputs: Array
    regression_rmse: float

    def fitted(self, kernel: Kernel, lambda_mean: float, lambda_covariance: float | None) -> KMP:
        return KMP.fit(
            self.inputs,
            self.reference,
            kernel=kernel,
            lambda_mean=lambda_mean,
            lambda_covariance=lambda_covariance,
            prior_mean=self.prior_mean,
        )


@dataclass(frozen=True)
class _Recipe:
    """How a reference is made of demonstrations."""

    components: int
    seed: int
    count: int
    regularization: float
    channels: int

    def reference(self, data: Sequence[tuple[Array, Array]]) -> tuple[_Fold, GaussianMixture]:
        """The reference of all demonstrations, nothing held out, and its mixture."""
        samples, seed = np.concatenate([np.hstack(one) for one in data]), self.seed
        dimensions = data[0][0].shape[1]
        mixture = GaussianMixture.fit(
            samples,
            components=self.components,
            seed=seed,
            regularization=self.regularization,
        )
        if dimensions == 1:
            inputs = np.linspace(samples[:, 0].min(), samples[:, 0].max(), self.count)[:, None]
        else:
            inputs = mixture.sample_inputs(self.count, dimensions=dimensions, seed=seed)
        reference = mixture.regress(inputs)
        prior = reference.mean.mean(axis=0)
        prior[len(prior) // self.channels :] = 0
        nothing = np.empty((0, 0))
        return _Fold(frozen(inputs), reference, frozen(prior), nothing, nothing, np.nan), mixture

    def fold(self, data: Sequence[tuple[Array, Array]], h: int) -> _Fold:
        """The fold that holds out demonstration h."""
        rest, mixture = self.reference([*data[:h], *data[h + 1 :]])
        some = np.linspace(0, len(data[h][0]) - 1, min(len(data[h][0]), _HELD_OUT)).astype(int)
        inputs, outputs = data[h][0][some], data[h][1][some]
        miss = (mixture.regress(inputs).mean - outputs)[:, : outputs.shape[1] // self.channels]
        rmse = float(np.sqrt((miss**2).sum(axis=1).mean()))
        return replace(rest, held_inputs=inputs, held_outputs=outputs, regression_rmse=rmse)


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
    """The primitive of demonstrations, each inputs (T, I) and outputs (T, O), and its scores.

    The paper, sections II-A, II-B: a mixture of `components`, its regression at `count` inputs
    (evenly spaced over time, where I is 1; drawn from the marginal else), and the primitive, whose
    mean returns to the reference's. `regularization` [unit^2] is that of `GaussianMixture.fit`.

    A kernel (one length for each input) and a lambda that are not given are those with the least
    RMSE on the demonstration that is left out, over all of them; then a lambda of the covariance
    that is not given is the one with the least negative log likelihood. `velocity`: the outputs are
    values and then their rates over time, the kernel a VelocityKernel. What is tried follows the
    data's units.

    Raises ValueError if shapes do not agree, a number is not finite, a parameter is out of its
    range, or there are too few samples for the components, or demonstrations for a choice.
    """
    data = checked_demonstrations(demonstrations)
    for name, value in (("lambda_mean", lambda_mean), ("lambda_covariance", lambda_covariance)):
        if value is not None:
            positive(name, value)
    whole("count", count)
    check_kind("velocity", velocity, bool, "True or False")
    if kernel is not None:
        checked_kernel(kernel).check(data[0][0].shape[1], data[0][1].shape[1])
    recipe = _Recipe(components, seed, count, regularization, 2 if velocity else 1)
    full, mixture = recipe.reference(data)
    scores: list[Score] = []
    folds: list[_Fold] = []
    if kernel is None or lambda_mean is None or lambda_covariance is None:
        if len(data) < 2:
            raise ValueError(
                f"{len(data)} demonstration given: at least 2 needed to choose parameters by leaving one out. "
                "Give kernel, lambda_mean and lambda_covariance, or another demonstration."
            )
        folds = [recipe.fold(data, h) for h in range(len(data))]
        outputs = data[0][1].shape[1] // recipe.channels
        kernel, lambda_mean = _search(folds, recipe.channels, kernel, lambda_mean, scores)
        if lambda_covariance is None:
            tried = [_score(folds, outputs, kernel, lambda_mean, f * lambda_mean) for f in _OF_MEAN]
            scores += tried
            lambda_covariance = min(tried, key=lambda one: one.negative_log_likelihood or 0.0).lambda_covariance
    order = sorted(scores, key=_best_first)
    plain = np.sqrt(np.mean([fold.regression_rmse**2 for fold in folds])) if folds else np.nan
    return Learned(full.fitted(kernel, lambda_mean, lambda_covariance), mixture, tuple(order), float(plain))


def _best_first(score: Score) -> tuple[float, float]:
    return score.rmse, np.inf if score.negative_log_likelihood is None else score.negative_log_likelihood


def _search(
    folds: Sequence[_Fold],
    channels: int,
    kernel: Kernel | None,
    lambda_mean: float | None,
    scores: list[Score],
) -> tuple[Kernel, float]:
    """The kernel and lambda of the least RMSE: a grid, then steps along each. Notes the scores."""
    dimensions, outputs = folds[0].inputs.shape[1], folds[0].reference.outputs // channels
    variances = np.var(np.concatenate([fold.held_inputs for fold in folds]), axis=0)
    variances = np.where(variances > 0, variances, variances.max() or 1.0)  # one that never changed has no length
    variance = float(np.mean([np.trace(fold.reference.covariance, axis1=1, axis2=2).mean() for fold in folds]))
    variance /= folds[0].reference.outputs

    def kernel_of(parameters: tuple[float, ...]) -> Kernel:
        ell = np.exp(np.array(parameters[:-1]))
        return kernel or (VelocityKernel(float(ell[0])) if channels == 2 else GaussianKernel(ell))

    def rmse(parameters: tuple[float, ...]) -> float:
        k = kernel_of(parameters)
        penalty = lambda_mean or float(np.exp(parameters[-1]))
        found = _rmse(folds, outputs, k, penalty)
        scores.append(Score(k.ell, penalty, None, found, None))
        return found

    lengths = [0.0] if kernel else np.log(_ELLS)
    penalties = [0.0] if lambda_mean else np.log(_LAMBDAS) - np.log(variance)
    start = np.log(0.5 / variances)
    grid = [(*(start + length), penalty) for length in lengths for penalty in penalties]
    best = min((rmse(one), one) for one in grid)
    free = ([] if kernel else list(range(dimensions))) + ([] if lambda_mean else [dimensions])
    for _ in range(_SWEEPS):
        for i in free:
            for step in (np.log(_STEP), -np.log(_STEP)):
                other = tuple(value + step * (i == n) for n, value in enumerate(best[1]))
                best = min(best, (rmse(other), other))
    found = best[1]
    return kernel_of(found), lambda_mean or float(np.exp(found[-1]))


def _rmse(folds: Sequence[_Fold], outputs: int, kernel: Kernel, penalty: float) -> float:
    squares = []
    for fold in folds:
        try:
            mean = fold.fitted(kernel, penalty, penalty).mean(fold.held_inputs)
        except ValueError:  # not solvable to working precision: no candidate
            return np.inf
        squares.append((((mean - fold.held_outputs)[:, :outputs]) ** 2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def _score(folds: Sequence[_Fold], outputs: int, kernel: Kernel, penalty: float, other: float) -> Score:
    likelihoods = []
    for fold in folds:
        try:
            prediction = fold.fitted(kernel, penalty, other).predict(fold.held_inputs)
        except ValueError:
            return Score(kernel.ell, penalty, other, np.inf, np.inf)
        residual = (fold.held_outputs - prediction.mean)[:, :outputs]
        likelihoods.append(_negative_log_likelihood(residual, prediction.covariance[:, :outputs, :outputs]))
    return Score(kernel.ell, penalty, other, _rmse(folds, outputs, kernel, penalty), float(np.mean(likelihoods)))


def _negative_log_likelihood(residual: Array, covariance: Array) -> float:
    """The mean over T points [nat]: residuals (T, O), covariances (T, O, O)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, residual[:, :, None])[:, :, 0]
    log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return float(0.5 * (log_det + (white**2).sum(axis=1) + residual.shape[1] * np.log(2 * np.pi)).mean())
