"""Many alternative goals at once: the mean is affine in the means of via-points.

With the posterior covariance P = k - k (K + lambda Sigma)^-1 k^T of the mean's cost and the U
points that change, added with S = Sigma and removed with S = -Sigma,

    mean'(s) = mean(s) + P(s, U) (P(U, U) + lambda S)^-1 (mu - mean(U))

Rasmussen and Williams 2006, section A.2. P(a, b) is a residual plus or minus R_a^T R_b, with the
roots R = L^-1 k of a dense solution, or lambda^1/2 L^-1 z of a low rank one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.linear_algebra import kron_identity
from kmp.dense import Dense
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.kernel import between
from kmp.low_rank import LowRank
from kmp.outputs import Decoupled, Mapped, inside, of_group
from kmp.problem.database import Changes, Database
from kmp.solution import Solution, check_resolved, mean_of


def moved_means(solution: Solution, changes: Sequence[Changes], queries: Functionals) -> Array:
    """The moves (G, M, O) of a base's mean at M queries with each of G changes, of V points each.

    Raises ValueError if rounding would hide a covariance.
    """
    added = Database(
        Functionals.concatenated([change.functionals for change in changes]),
        Gaussians.concatenated([change.points for change in changes]),
    )
    return _moved(solution, added, [change.replaced for change in changes], queries)


def _moved(
    solution: Any, added: Database, replaced: list[NDArray[np.intp]], queries: Functionals
) -> Array:
    """The moves (G, M, O), for the V points of each goal, one goal after the other; `replaced` are
    the indices of the solution's points that each goal replaces.
    """
    points = added.functionals
    if isinstance(solution, Mapped):
        normals = inside(solution.inner.hyperparameters, points, solution.t, added.reference)
        inner = _moved(solution.inner, Database(points, normals), replaced, queries)
        return np.asarray(inner @ solution.t.T)
    if not isinstance(solution, Decoupled):
        return _of_system(solution, added, replaced, queries)
    if not solution.is_decoupled(added.reference):
        return _of_system(solution.together, added, replaced, queries)
    moves = np.empty((len(replaced), len(queries), added.reference.outputs))
    for part, group in zip(solution.parts, solution.groups, strict=True):
        mine = Database(points, of_group(added.reference, group))
        moves[:, :, group] = _of_system(part, mine, replaced, queries)
    return moves


def _of_system(
    solution: Dense | LowRank,
    added: Database,
    replaced: list[NDArray[np.intp]],
    queries: Functionals,
) -> Array:
    """The moves (G, M, O), by one triangular solve."""
    parameters = solution.hyperparameters
    goals = len(replaced)
    count = len(added) // goals
    moves = np.zeros((goals, len(queries), parameters.outputs))
    if not count:
        return moves
    is_low_rank = solution.representation == "low_rank"
    check_resolved(parameters, added, first=len(solution.database), both=is_low_rank)
    if is_low_rank:
        check_resolved(
            parameters, added, first=len(solution.database), name="lambda_mean", both=True
        )
    means = added.reference.mean.reshape(goals, count, -1)
    is_shared = _are_alike(added, replaced)
    if is_shared:  # one system for all goals
        added = added.take(slice(0, count))
    removed = np.unique(np.concatenate(replaced))
    points = added.joined(solution.database.take(removed))
    before = mean_of(solution, points.functionals)
    noise = parameters.lambda_mean * points.reference.covariance
    noise[len(added) :] *= -1.0
    posterior = _Posterior(solution, points.functionals, queries)
    for mine in [np.arange(goals)] if is_shared else _of_one_count(replaced):
        systems = mine[:1] if is_shared else mine
        added_rows = np.arange(len(added)).reshape(-1, count)[systems]
        removed_rows = np.searchsorted(removed, np.array([replaced[g] for g in systems]))
        rows = np.hstack([added_rows, len(added) + removed_rows.reshape(len(systems), -1)])
        errors = points.reference.mean[rows] - before[rows]
        errors = np.tile(errors, (len(mine) // len(systems), 1, 1))
        errors[:, :count] = means[mine] - before[added_rows]
        moves[mine] = posterior.moves(rows, noise[rows], errors)
    return moves


def _are_alike(added: Database, replaced: list[NDArray[np.intp]]) -> bool:
    """True if the goals differ in their means only."""
    goals = len(replaced)
    arrays = (added.inputs, added.functionals.along, added.reference.covariance)
    blocks = (array.reshape(goals, -1) for array in arrays)
    return all((block == block[0]).all() for block in blocks) and all(
        np.array_equal(rows, replaced[0]) for rows in replaced
    )


def _of_one_count(replaced: list[NDArray[np.intp]]) -> list[NDArray[np.intp]]:
    """The goals that replace the same number of points, for each number."""
    counts = np.array([len(rows) for rows in replaced])
    return [np.flatnonzero(counts == count) for count in np.unique(counts)]


class _Posterior:
    """P within U points, and between these and M queries. C channels, O = C D outputs."""

    def __init__(
        self, solution: Dense | LowRank, points: Functionals, queries: Functionals
    ) -> None:
        kernel = solution.hyperparameters.kernel
        self._d = solution.hyperparameters.channel_outputs
        self._c = kernel.channels
        self._residual = between(kernel, points, points)
        self._across = between(kernel, queries, points)
        if isinstance(solution, LowRank):
            features, z = (solution.features(f) for f in (points, queries))
            self._residual -= features.T @ features
            self._across -= z.T @ features
            scale = np.sqrt(solution.hyperparameters.lambda_mean)
            rows = [scale * features, scale * z]
            copies = self._d
            self._sign = 1.0
        else:
            rows = [between(kernel, solution.functionals, f) for f in (points, queries)]
            copies = solution.distinct
            self._sign = -1.0
        self._own, self._of_queries = (
            lapack.dtrtrs(solution.mean_factor, kron_identity(row, copies), lower=1)[0]
            for row in rows
        )
        self._copies = copies

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

    def moves(self, rows: NDArray[np.intp], noise: Array, errors: Array) -> Array:
        """The moves (G, M, O) for errors (G, U, O), of points (G, U) or of the same (1, U)."""
        roots = self.roots(rows)
        system = self.within(rows, roots)
        diagonal = np.arange(rows.shape[1])
        system[:, diagonal, :, diagonal] += noise.transpose(1, 0, 2, 3)
        size = system.shape[1] * system.shape[2]
        right = errors.reshape(len(rows), -1, size).mT
        solved = np.linalg.solve(system.reshape(len(rows), size, size), right)
        pulls = np.ascontiguousarray(solved.mT, dtype=np.float64)
        return self.across(rows, roots, pulls.reshape(errors.shape))

    def across(self, rows: NDArray[np.intp], roots: Array, pulls: Array) -> Array:
        """P between the queries and the points of each goal (G, U), with their `roots`, times pulls
        (G, U, O): (G, M, O).
        """
        goals = len(pulls)
        near = self._across[:, _columns(rows, self._c)].transpose(1, 0, 2)  # (G, M C, U C)
        near = near @ pulls.reshape(goals, near.shape[2], -1)  # (G, M C, D)
        inner = roots.mT @ pulls.reshape(goals, roots.shape[1], -1)  # (G, p, D')
        explained = self._of_queries.T @ inner.transpose(1, 0, 2).reshape(inner.shape[1], -1)
        far = explained.reshape(len(explained), goals, -1).transpose(1, 0, 2)
        return np.asarray(near.reshape(goals, -1) + self._sign * far.reshape(goals, -1)).reshape(
            goals, -1, pulls.shape[2]
        )

    def roots(self, rows: NDArray[np.intp]) -> Array:
        """The transposed roots (G, U C D', p) of the points of each goal."""
        return np.asarray(self._own.T[_columns(rows, self._c * self._copies)])


def _columns(rows: NDArray[np.intp], width: int) -> NDArray[np.intp]:
    """The columns (G, U width) of points (G, U) with this number of columns each."""
    return (width * rows[:, :, None] + np.arange(width)).reshape(len(rows), -1)
