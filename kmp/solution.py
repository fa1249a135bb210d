"""The solved problem as a protocol, its mean, and checks of its conditioning.

Mean, equation (8): xi(s) = sum_r k(s, s_r) w_r + m(s), over R centres s_r with weights w_r (O,) and
the prior mean m. Conditioning: lambda times the least eigenvalue of Sigma_n must be at least 1e-11
of k(s_n, s_n), or rounding would hide it.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, unchecked
from kmp.kernel import between, variances
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters

BLOCK = 256  # queries computed at once: their kernel rows fit into the processor's cache
_RESOLVED = 1e-11  # least lambda Sigma / k(s, s): the covariance then has 3 correct digits
_FREE = 1e-9  # k(s, s) / lambda Sigma of a free output
_ROUND_UP = 1.01  # factor on a least variance, because a message shows two digits of it


class Expansion(Immutable):
    """An expansion in the kernels of R functionals."""

    @property
    @abstractmethod
    def functionals(self) -> Functionals:
        """The R functionals."""

    @property
    def centres(self) -> Array:
        """Their inputs (R, I)."""
        return self.functionals.inputs

    def with_weights(self, weights: Array) -> Self:
        return self._with_cached(weights=weights)


class Solution(Protocol):
    """A database solved for mean and covariance; immutable. O outputs, C channels.

    The mean is an expansion in R kernels, equation (8): xi(s) = sum_r k(s, s_r) w_r + prior mean.
    """

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The kernel, the lambdas, the prior mean."""

    @property
    def database(self) -> Database:
        """The N reference points, via-points included."""

    @property
    def representation(self) -> Literal["dense", "low_rank"]:
        """The kind of solution."""

    @property
    def functionals(self) -> Functionals:
        """The R functionals of which the kernels are."""

    @property
    def centres(self) -> Array:
        """Their inputs s_r (R, I)."""

    @property
    def weights(self) -> Array:
        """w_r (R, O)."""

    def solved(self) -> Self:
        """This solution, with weights and factors computed. Raises ValueError if that fails."""

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        """k(s, s) - k (K + lambda_c Sigma)^-1 k^T (M, O, O) of M queries, each by itself, with the
        rows k (M C, R C) and the prior k(s, s) (C, C). Q queries that are one have Q C channels and
        Q O outputs.
        """

    def with_weights(self, weights: Array) -> Self:
        """This solution with stored weights (R, O), which are then not computed."""


class BaseSolution(Solution, Protocol):
    """The solution of a database before any adaptation."""

    def adapted(self, changes: Changes) -> Solution:
        """The solution of the database with these changes."""

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Self:
        """The solution of the database with other parameters, not solved yet."""

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """Arrays that a file holds besides database and weights."""


def mean_at(solution: Solution, queries: Array) -> Array:
    """Equation (8) at queries (M, I): (M, O)."""
    return mean_of(solution, Functionals(queries))


def mean_of(solution: Solution, queries: Functionals) -> Array:
    """Equation (8) for M functionals: (M, O).

    Computed in blocks of queries, whose kernel rows stay in the processor's cache.
    """
    parameters = solution.hyperparameters
    means = np.empty((len(queries), parameters.outputs))
    for a in range(0, len(queries), BLOCK):
        block = queries.take(slice(a, a + BLOCK)) if len(queries) > BLOCK else queries
        rows = between(parameters.kernel, block, solution.functionals)
        means[a : a + BLOCK] = mean_of_rows(solution, block, rows)
    return means


def mean_of_rows(solution: Solution, queries: Functionals, rows: Array) -> Array:
    """Equation (8) for M functionals whose kernel rows (M C, R C) are known: (M, O)."""
    parameters = solution.hyperparameters
    weights = solution.weights.reshape(-1, parameters.channel_outputs)
    means = (rows @ weights).reshape(-1, parameters.outputs)
    return np.asarray(means + parameters.prior_at(queries))


def check_resolved(
    parameters: Hyperparameters,
    points: Database,
    *,
    first: int = 0,
    name: Literal["lambda_mean", "lambda_covariance"] = "lambda_covariance",
    both: bool = False,
) -> None:
    """Raise ValueError if rounding would hide lambda Sigma beside k(s, s).

    `name` is the lambda. The message numbers the points from `first`; the least variance that it
    names is sufficient for this lambda, or for `both`.
    """
    penalty = parameters.lambda_mean if name == "lambda_mean" else parameters.lambda_covariance
    if points.exceeds(parameters.kernel, _RESOLVED / penalty):
        return
    least = penalty * points.least_shares(parameters.kernel)
    for n in np.flatnonzero(least < _RESOLVED)[:1]:
        enough = penalty * _RESOLVED / max(least[n], 1e-300)
        smaller = min(parameters.lambda_mean, parameters.lambda_covariance) if both else penalty
        accepted = least_variances(parameters, points.functionals.take(slice(n, n + 1)), smaller)[0]
        of = ("",) if len(accepted) == 1 else (" of the values", " of their rates")
        named = " and ".join(
            f"{variance:.2g}{suffix}" for variance, suffix in zip(accepted, of, strict=True)
        )
        raise ValueError(
            f"The covariance at point {first + n} would be lost in rounding: lambda Sigma is "
            f"{least[n]:.3g} of k(s, s) there, at least {_RESOLVED:g} needed. Give the point a "
            f"variance of at least {named} (Gaussians.of(mean, deviation=0) takes the least), or "
            f"the primitive a {name} of at least {enough:.3g}."
        )


def is_resolved(parameters: Hyperparameters, points: Database) -> bool:
    """True if rounding of k(s, s) hides lambda Sigma with neither lambda."""
    penalty = min(parameters.lambda_mean, parameters.lambda_covariance)
    return points.exceeds(parameters.kernel, _RESOLVED / penalty)


def least_variances(parameters: Hyperparameters, points: Functionals, penalty: float) -> Array:
    """Least variances (N, C) that rounding does not hide, at N points and for each channel."""
    return np.asarray(variances(parameters.kernel, points) * (_RESOLVED / penalty) * _ROUND_UP)


def least_of_channels(solution: Solution) -> Array:
    """(C,) least variances of the values of one output and of their rates, for a prior of 1."""
    parameters = solution.hyperparameters
    anywhere = Functionals(np.zeros((1, solution.centres.shape[1])))
    penalty = parameters.lambda_covariance
    if solution.representation == "low_rank":
        penalty = min(penalty, parameters.lambda_mean)
    least: Array = least_variances(parameters, anywhere, penalty)[0]
    return least


def resolved(parameters: Hyperparameters, points: Functionals, normals: Gaussians) -> Gaussians:
    """The normals of N points, with the least variance for exact outputs instead of 0, and for free
    ones one that hardly pulls.
    """
    exact = normals.exact
    free = normals.free
    if not (exact | free).any():
        return normals
    penalty = min(parameters.lambda_mean, parameters.lambda_covariance)
    least = least_variances(parameters, points, penalty).repeat(parameters.channel_outputs, axis=1)
    least = least * np.tile(parameters.prior_variances, parameters.kernel.channels)
    covariance = normals.covariance.copy()
    for chosen, variance in ((exact, least), (free, least / (_ROUND_UP * _RESOLVED * _FREE))):
        n, o = np.nonzero(chosen)
        covariance[n, o, :] = covariance[n, :, o] = 0.0
        covariance[n, o, o] = variance[n, o]
    return unchecked(normals.mean, covariance)
