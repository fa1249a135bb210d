"""The low rank solution after an adaptation, by conditioning on the points that changed.

The base's W has a normal distribution of covariance lambda P^-1. Conditioning it on U changes with
features z and covariances S = Sigma (added) or -Sigma (removed) gives the system G = lambda z P^-1
z^T + residual + lambda S (U O, U O) and W + lambda P^-1 z^T G^-1 (mu - m - z W). Rasmussen and
Williams 2006, section A.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import frozen
from kmp.arrays.linear_algebra import kron_identity
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.kernel import between
from kmp.low_rank.error_bound import error_bounds
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import ErrorBounds, Expansion, check_resolved

if TYPE_CHECKING:
    from kmp.low_rank.solution import LowRank


class _System(NamedTuple):
    """The factorised system G of the U changes."""

    cross: Array
    """L^-1 z (r D, U O), with the features z and the factor L of the base's normal equations."""
    lu: Array
    """(U O, U O) the LU factors of G."""
    pivots: NDArray[np.intc]

    def solve(self, right: Array) -> Array:
        # SciPy adds 1 to the pivots while it solves, which other threads would see.
        return np.asarray(lapack.dgetrs(self.lu, self.pivots.copy(), right)[0])


@dataclass(frozen=True, eq=False, repr=False)
class Conditioned(Expansion):
    """The low rank solution with V points added and R removed: U = V + R changes.

    A point is removed by adding it again with minus its covariance. The kernel's residual between
    added points is included, so that the mean meets them anywhere; between them and the base's
    points it is neglected, as it is below the square root of the tolerance. The members are those
    of `Solution`.
    """

    _not_pickled = frozenset({"database", "_added_points", "_neglected"})

    base: LowRank
    changes: Changes

    representation: ClassVar[Literal["low_rank"]] = "low_rank"

    @property
    def hyperparameters(self) -> Hyperparameters:
        return self.base.hyperparameters

    @cached_property
    def database(self) -> Database:
        return self.base.database.changed(self.changes)

    @cached_property
    def functionals(self) -> Functionals:
        """The r pivots, then the V via-points."""
        return Functionals.concatenated([self.base.functionals, self.changes.functionals])

    @cached_property
    def weights(self) -> Array:
        """(r + V, O) the weights of their kernels."""
        base, penalty, d = self.base, self.hyperparameters.lambda_mean, self.base.w.shape[1]
        shared = penalty == self.hyperparameters.lambda_covariance
        system = self._covariance_system if shared else self._system("lambda_mean", base.mean_factor)
        mean = (self._z.T @ base.w).reshape(len(self._points), -1)
        wanted = self._points.reference.mean - self.hyperparameters.prior_at(self._points.functionals)
        pull = system.solve((wanted - mean).ravel())
        back, _ = lapack.dtrtrs(base.mean_factor, system.cross @ pull, lower=1, trans=1)
        columns = self._added_columns
        w = base.w + penalty * back.reshape(-1, d) - self._z[:, :columns] @ pull.reshape(-1, d)[:columns]
        added = pull.reshape(len(self._points), -1)[: self._added]
        return frozen(np.concatenate([base.features.kernel_weights(w), added]))

    @cached_property
    def error_bounds(self) -> ErrorBounds:
        return error_bounds(self, self.base.features, added=self._added)

    def solved(self) -> Self:
        self.weights  # noqa: B018
        self._covariance_system  # noqa: B018
        return self

    def posterior_covariance_one(self, row: Array, prior: Array | None = None) -> Array:
        z, root = self.base.whitened_one(row)
        return np.asarray(self._posterior_covariance(np.atleast_2d(row)[None], z[None], root.T[None], prior)[0])

    def posterior_covariance(self, rows: Array) -> Array:
        z, roots = self.base.whitened(rows)
        return self._posterior_covariance(rows.reshape(len(z), z.shape[2], -1), z, roots)

    def adapted(self, changes: Changes) -> LowRank | Conditioned:
        return self.base.adapted(changes)

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Conditioned:
        return Conditioned(self.base.with_hyperparameters(hyperparameters), self.changes)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        return self.base.to_arrays()

    @property
    def _added(self) -> int:
        return len(self.changes.inputs)

    @property
    def _added_columns(self) -> int:
        return self._added * self.base.features.kernel.channels

    @cached_property
    def _points(self) -> Database:
        """The U changed points, those added first."""
        database, replaced = self.base.database, self.changes.replaced
        functionals = Functionals.concatenated([self.changes.functionals, database.functionals.take(replaced)])
        normals = Gaussians.concatenated([self.changes.points, database.reference.take(replaced)])
        return Database(functionals, normals)

    @cached_property
    def _z(self) -> Array:
        """The features (r, U C) of the U points."""
        return frozen(self.base.features(self._points.functionals))

    @cached_property
    def _covariance_system(self) -> _System:
        return self._system("lambda_covariance", self.base.covariance_factor)

    @cached_property
    def _added_points(self) -> Database:
        return Database(self.changes.functionals, self.changes.points)

    @cached_property
    def _neglected(self) -> Array:
        """The kernel's residual between the V added points: k - z^T z (V C, V C)."""
        points, z = self.changes.functionals, self._z[:, : self._added_columns]
        return frozen(between(self.hyperparameters.kernel, points, points) - z.T @ z)

    def _posterior_covariance(self, rows: Array, z: Array, roots: Array, prior: Array | None = None) -> Array:
        """(M, O, O), of rows (M, C, (r + V) C), features z (M, r, C) and L^-1 z (M, r D, O)."""
        m, c, d, penalty = len(z), z.shape[2], self.base.w.shape[1], self.hyperparameters.lambda_covariance
        columns, system = self._added_columns, self._covariance_system
        residual = (
            rows[:, :, z.shape[1] * self.base.features.kernel.channels :] - z.transpose(0, 2, 1) @ self._z[:, :columns]
        )  # (M, C, V C)
        cross = penalty * (roots.transpose(0, 2, 1) @ system.cross)  # (M, O, U O)
        split = cross.reshape(m, c, d, -1, d)
        for i in range(d):
            split[:, :, i, :columns, i] += residual
        cross = split.reshape(m * c * d, -1)
        gain = system.solve(cross.T).T.reshape(m, c * d, -1)
        within = penalty * (roots.transpose(0, 2, 1) @ roots)
        before = self.base.residual_covariance(z.transpose(0, 2, 1) @ z, prior) + within
        return np.asarray(before - gain @ cross.reshape(gain.shape).transpose(0, 2, 1))

    def _system(self, name: Literal["lambda_mean", "lambda_covariance"], base_factor: Array) -> _System:
        parameters, count = self.hyperparameters, len(self._points)
        first = len(self.base.database) - len(self.changes.replaced)
        check_resolved(parameters, self._added_points, first=first, name=name, both=True)
        penalty = parameters.lambda_mean if name == "lambda_mean" else parameters.lambda_covariance
        d = self.base.w.shape[1]
        cross, _ = lapack.dtrtrs(base_factor, kron_identity(self._z, d), lower=1)
        matrix = penalty * (cross.T @ cross)
        neglected = kron_identity(self._neglected, d)
        matrix[: len(neglected), : len(neglected)] += neglected
        blocks = matrix.reshape(count, -1, count, len(matrix) // count)
        points = np.arange(count)
        sign = np.where(points < self._added, penalty, -penalty)
        blocks[points, :, points, :] += sign[:, None, None] * self._points.reference.covariance
        lu, pivots, info = lapack.dgetrf(matrix)
        if info or not np.isfinite(lu).all():
            raise ValueError(
                f"The via-points contradict each other to working precision, with lambda {penalty:g}. "
                "Give those that are near to others more variance."
            )
        return _System(frozen(cross), frozen(lu), frozen(pivots))
