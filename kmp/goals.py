"""Many alternative goals at once: the mean is affine in the means of via-points.

With the posterior covariance P = k - k (K + lambda Sigma)^-1 k^T of the mean's cost and the U
points that change, added with S = Sigma and removed with S = -Sigma,

    mean'(s) = mean(s) + P(s, U) (P(U, U) + lambda S)^-1 (mu - mean(U))

Rasmussen and Williams 2006, section A.2. P(a, b) is a residual plus or minus R_a^T R_b, with the
roots R = L^-1 k of a dense solution, or lambda^1/2 L^-1 z of a low rank one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.inverse_cholesky import InverseCholeskyFactor
from kmp.arrays.linear_algebra import kron_identity
from kmp.dense import Dense
from kmp.functionals import Functionals
from kmp.kernel import between
from kmp.low_rank import LowRank
from kmp.problem.database import Database
from kmp.solution import mean_of

# least singular value / k(s, s) of a goal's system: errors are 4e-16 over it
_LEAST_SINGULAR = 1e-7
# least lambda Sigma / k(s, s) from which products with the inverse factor are exact to 1e-9; with
# many goals they take down to half of the time of a triangular solve
_INVERTIBLE = 1e-5


def moved_means(
    solution: Dense | LowRank,
    added: Database,
    replaced: list[NDArray[np.intp]],
    queries: Functionals,
) -> Array:
    """The moves (G, M, O) of the mean at M queries with each of G goals, all at once; NaN for goals
    whose points are so near to each other that rounding shows.

    `added` has the V via-points of each goal, one goal after the other; `replaced` the indices of
    the solution's points that each replaces.
    """
    database = solution.database
    removed = np.unique(np.concatenate(replaced))
    points = added.joined(database.take(removed))
    outputs = points.reference.outputs
    errors = points.reference.mean - mean_of(solution, points.functionals)
    noise = solution.hyperparameters.lambda_mean * points.reference.covariance
    noise[len(added) :] *= -1.0
    posterior = _Posterior(solution, points.functionals, queries)
    goals = len(replaced)
    counts = np.array([len(rows) for rows in replaced])
    moves = np.zeros((goals, len(queries), outputs))
    for count in np.unique(counts):
        mine = np.flatnonzero(counts == count)
        added_rows = np.arange(len(added)).reshape(goals, -1)[mine]
        removed_rows = len(added) + np.searchsorted(removed, np.array([replaced[g] for g in mine]))
        rows = np.concatenate([added_rows, removed_rows.reshape(len(mine), -1)], axis=1)  # (G', U)
        roots = posterior.roots(rows)
        system = posterior.within(rows, roots)
        diagonal = np.arange(rows.shape[1])
        system[:, diagonal, :, diagonal] += noise[rows].transpose(1, 0, 2, 3)
        size = rows.shape[1] * outputs
        system = system.reshape(len(mine), size, size)
        pulls = np.linalg.solve(system, errors[rows].reshape(len(mine), size, 1))
        least = np.linalg.svdvals(system)[:, -1]
        pulls[least < _LEAST_SINGULAR * posterior.largest] = np.nan
        moves[mine] = posterior.across(rows, roots, pulls.reshape(*rows.shape, outputs))
    return moves


class _Posterior:
    """P within U points, and between these and M queries. C channels, O = C D outputs."""

    def __init__(
        self, solution: Dense | LowRank, points: Functionals, queries: Functionals
    ) -> None:
        kernel = solution.hyperparameters.kernel
        self._d = solution.hyperparameters.channel_outputs
        self._c = kernel.channels
        self._residual = between(kernel, points, points)
        self.largest = self._residual.max()
        self._across = between(kernel, queries, points)
        if isinstance(solution, LowRank):
            features, z = (solution.features(f) for f in (points, queries))
            self._residual -= features.T @ features
            self._across -= z.T @ features
            scale = np.sqrt(solution.hyperparameters.lambda_mean)
            rows = [scale * features, scale * z]
            self._copies = self._d
            self._sign = 1.0
        else:
            rows = [between(kernel, solution.functionals, f) for f in (points, queries)]
            self._copies = solution.distinct
            self._sign = -1.0
        factor = solution.mean_factor
        inverse = None
        right_sides = self._c * self._copies * (len(points) + len(queries))
        if right_sides >= len(factor) and solution.database.exceeds(
            kernel, _INVERTIBLE / solution.hyperparameters.lambda_mean
        ):
            inverse = InverseCholeskyFactor.of(factor, self._copies)

        def root_of(row: Array) -> Array:
            if inverse is not None:
                return np.ascontiguousarray(inverse.times(row, self._c).mT)
            columns, _ = lapack.dtrtrs(factor, kron_identity(row, self._copies), lower=1)
            return np.asarray(columns.T.reshape(-1, self._c * self._copies, len(factor)))

        self._own, self._of_queries = map(root_of, rows)

    def within(self, rows: NDArray[np.intp], roots: Array) -> Array:
        """P (G, U, O, U, O) of the points of each goal (G, U), with their `roots`."""
        goals, count = rows.shape
        places = _columns(rows, self._c)
        residual = kron_identity(self._residual[places[:, :, None], places[:, None, :]], self._d)
        explained = kron_identity(roots @ roots.mT, self._d // self._copies)
        outputs = self._c * self._d
        return np.asarray(residual + self._sign * explained).reshape(
            goals, count, outputs, count, outputs
        )

    def across(self, rows: NDArray[np.intp], roots: Array, pulls: Array) -> Array:
        """P between the queries and the points of each goal (G, U), with their `roots`, times pulls
        (G, U, O): (G, M, O).
        """
        goals = len(rows)
        near = self._across[:, _columns(rows, self._c)].transpose(1, 0, 2)  # (G, M C, U C)
        near = near @ pulls.reshape(goals, near.shape[2], -1)
        inner = roots.mT @ pulls.reshape(goals, roots.shape[1], -1)  # (G, p, D')
        of_queries = self._of_queries.reshape(-1, inner.shape[1])  # (M C D', p)
        explained = of_queries @ inner.transpose(1, 0, 2).reshape(inner.shape[1], -1)
        far = explained.reshape(len(explained), goals, -1).transpose(1, 0, 2)
        return np.asarray(near.reshape(goals, -1) + self._sign * far.reshape(goals, -1)).reshape(
            goals, -1, pulls.shape[2]
        )

    def roots(self, rows: NDArray[np.intp]) -> Array:
        """The transposed roots (G, U C D', p) of the points of each goal."""
        roots = self._own[rows]  # (G, U, C D', p)
        return np.asarray(roots.reshape(len(rows), -1, roots.shape[3]))


def _columns(rows: NDArray[np.intp], width: int) -> NDArray[np.intp]:
    """The columns (G, U width) of points (G, U) with this number of columns each."""
    return (width * rows[:, :, None] + np.arange(width)).reshape(len(rows), -1)
