"""What a solution of the costs is: all that a primitive asks of one, whichever way it was found."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kmp.checks import Array
from kmp.database import Changes, Database
from kmp.functionals import Functionals
from kmp.hyperparameters import Hyperparameters
from kmp.kernel import between, variances

_RESOLVED = 1e-11  # lambda Sigma as a share of k(s, s), at which the covariance has 3 digits still


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

    def with_weights(self, weights: Array) -> Self:
        """This solution with weights (R, O) that were stored, so that they need not be made."""

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """What a file must hold of the base's solution besides its database and its weights."""


def mean_at(solution: Solution, queries: Array) -> Array:
    """Equation (8) at queries (M, I): (M, O)."""
    return mean_of(solution, Functionals(queries))


def mean_of(solution: Solution, queries: Functionals) -> Array:
    """Equation (8) for M queries, derived where a query is a derivative: (M, O)."""
    parameters = solution.hyperparameters
    weights = solution.weights.reshape(-1, parameters.channel_outputs)
    expansion = (between(parameters.kernel, queries, solution.functionals) @ weights).reshape(-1, parameters.outputs)
    return np.asarray(expansion + parameters.prior_at(queries))


def check_resolved(
    parameters: Hyperparameters,
    points: Database,
    *,
    first: int = 0,
    name: Literal["lambda_mean", "lambda_covariance"] = "lambda_covariance",
) -> None:
    """Raises ValueError where rounding would hide what lambda Sigma adds to k(s, s).

    The points are numbered from the `first` on; `name` says which lambda.
    """
    penalty = parameters.lambda_mean if name == "lambda_mean" else parameters.lambda_covariance
    scale = np.sqrt(variances(parameters.kernel, points.functionals)).repeat(parameters.channel_outputs, axis=1)
    covariance = points.reference.covariance / (scale[:, :, None] * scale[:, None, :])
    least = penalty * np.linalg.eigvalsh(covariance)[:, 0]
    for n in np.flatnonzero(least < _RESOLVED)[:1]:
        enough = penalty * _RESOLVED / max(least[n], 1e-300)
        raise ValueError(
            f"The covariance at point {first + n} would be lost in rounding: lambda Sigma is {least[n]:.3g} of "
            f"k(s, s) there, at least {_RESOLVED:g} needed. Give the point a greater variance, or the primitive a "
            f"{name} of at least {enough:.3g}."
        )
