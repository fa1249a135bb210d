"""What a solution of the costs is: all that a primitive asks of one, whichever way it was found."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, unchecked
from kmp.kernel import between, variances
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters

BLOCK = 256  # queries at once
_RESOLVED = 1e-11  # lambda Sigma as a share of k(s, s), at which the covariance has 3 digits still


_ROUND_UP = 1.01  # what two digits in a message may lack


class ErrorBounds(NamedTuple):
    """Upper bounds of the distance between a mean and equation (9)'s [unit of the outputs]."""

    at_points: float
    """At the reference points."""
    anywhere: float
    """At any query. Of a kernel with rates, the largest of the two channels' units counts."""


class Solution(Protocol):
    """A database solved for its mean and its covariance; immutable. O outputs, C channels.

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
        """How the costs are solved."""

    @property
    def functionals(self) -> Functionals:
        """The R values, and derivatives, that the kernels stand for."""

    @property
    def centres(self) -> Array:
        """s_r (R, I) where they are."""

    @property
    def weights(self) -> Array:
        """w_r (R, O)."""

    @property
    def error_bounds(self) -> ErrorBounds:
        """Upper bounds of the distance between the mean and equation (9)'s."""

    def solved(self) -> Self:
        """This solution, its weights and factors made. Raises ValueError if that fails."""

    def posterior_covariance_one(self, row: Array, prior: Array | None = None) -> Array:
        """k(s, s) - k (K + lambda_c Sigma)^-1 k^T (O, O) of one query, with k (R,) or (C, R C).

        Of M queries together (M O, M O), with k (M C, R C) and `prior` k(s, s) (M C, M C).
        """

    def posterior_covariance(self, rows: Array) -> Array:
        """Those (M, O, O) of the kernel rows (M C, R C) of M queries."""

    def adapted(self, changes: Changes) -> Solution:
        """The solution of the database as it was before any adaptation, with these changes."""

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Solution:
        """The solution of this database with other parameters: of a base, and not yet solved."""

    def with_weights(self, weights: Array) -> Self:
        """This solution with weights (R, O) that were stored, so that they need not be made."""

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """What a file must hold of the base's solution besides its database and its weights."""


def mean_at(solution: Solution, queries: Array) -> Array:
    """Equation (8) at queries (M, I): (M, O)."""
    return mean_of(solution, Functionals(queries))


def mean_of(solution: Solution, queries: Functionals) -> Array:
    """Equation (8) for M queries, derived where a query is a derivative: (M, O).

    In blocks of queries, whose kernel rows stay in the processor's cache.
    """
    parameters = solution.hyperparameters
    weights = solution.weights.reshape(-1, parameters.channel_outputs)
    found = np.empty((len(queries) * parameters.kernel.channels, parameters.channel_outputs))
    for a in range(0, len(queries), BLOCK):
        some = queries.take(slice(a, a + BLOCK)) if len(queries) > BLOCK else queries
        rows = between(parameters.kernel, some, solution.functionals)
        found[a * parameters.kernel.channels :][: len(rows)] = rows @ weights
    return np.asarray(found.reshape(-1, parameters.outputs) + parameters.prior_at(queries))


def check_resolved(
    parameters: Hyperparameters,
    points: Database,
    *,
    first: int = 0,
    name: Literal["lambda_mean", "lambda_covariance"] = "lambda_covariance",
    both: bool = False,
) -> None:
    """Raises ValueError where rounding would hide what lambda Sigma adds to k(s, s).

    The points are numbered from the `first` on; `name` says which lambda. The least variance that
    the message names is for that lambda, or for `both`.
    """
    penalty = parameters.lambda_mean if name == "lambda_mean" else parameters.lambda_covariance
    least = penalty * points.least_shares(parameters.kernel)
    for n in np.flatnonzero(least < _RESOLVED)[:1]:
        enough = penalty * _RESOLVED / max(least[n], 1e-300)
        smaller = min(parameters.lambda_mean, parameters.lambda_covariance) if both else penalty
        accepted = least_variances(parameters, points.functionals.take(slice(n, n + 1)), smaller)[0]
        of = ("",) if len(accepted) == 1 else (" of the values", " of their rates")
        named = " and ".join(f"{one:.2g}{what}" for one, what in zip(accepted, of, strict=True))
        raise ValueError(
            f"The covariance at point {first + n} would be lost in rounding: lambda Sigma is {least[n]:.3g} of "
            f"k(s, s) there, at least {_RESOLVED:g} needed. Give the point a variance of at least {named} "
            f"(Gaussians.of(mean, deviation=0) takes the least), or the primitive a {name} of at least {enough:.3g}."
        )


def is_resolved(parameters: Hyperparameters, points: Database) -> bool:
    """True if both lambda Sigma are above the rounding of k(s, s)."""
    penalty = min(parameters.lambda_mean, parameters.lambda_covariance)
    return bool((penalty * points.least_shares(parameters.kernel) >= _RESOLVED).all())


def least_variances(parameters: Hyperparameters, points: Functionals, penalty: float) -> Array:
    """The least variances (N, C) of each channel at N points that rounding does not hide."""
    return np.asarray(variances(parameters.kernel, points) * (_RESOLVED / penalty) * _ROUND_UP)


def resolved(parameters: Hyperparameters, points: Functionals, normals: Gaussians) -> Gaussians:
    """The normals of N points, with the least variances in place of those that are exact."""
    exact = normals.exact
    if not exact.any():
        return normals
    penalty = min(parameters.lambda_mean, parameters.lambda_covariance)
    least = least_variances(parameters, points, penalty).repeat(parameters.channel_outputs, axis=1)
    covariance = normals.covariance.copy()
    n, o = np.nonzero(exact)
    covariance[n, o, :] = covariance[n, :, o] = 0.0
    covariance[n, o, o] = least[n, o]
    return unchecked(normals.mean, covariance)
