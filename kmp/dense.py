"""The exact solution of equation (9): one Cholesky factor of K + lambda Sigma, as many rows as there are numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack

from kmp.checks import Array
from kmp.gaussians import Gaussians
from kmp.immutable import Immutable, frozen
from kmp.inverse_cholesky import InverseCholeskyFactor
from kmp.kernel import Kernel, spread
from kmp.problem import Problem

_COLUMNS = 64  # of a factor, copied at once


@dataclass(frozen=True, eq=False)
class Dense(Immutable):
    """The solution for N points with N O x N O numbers. Immutable; the factors are made when first asked for."""

    # A copy in another process predicts at once; the factors, which only `adapted` needs, are made again there.
    _not_pickled = frozenset({"_factor", "_covariance_factor"})

    kernel: Kernel
    problem: Problem
    inputs: Array
    reference: Gaussians
    base: Dense | None = None
    """The solution that shares the first `same` points, and so as many rows of the factors."""
    same: int = 0

    @property
    def centres(self) -> Array:
        """(N, I) where the mean's expansion has its kernels: equation (8)."""
        return self.inputs

    @cached_property
    def weights(self) -> Array:
        """alpha (N, O) = (K + lambda Sigma)^-1 (mu - prior mean). Equation (9)."""
        solution, _ = lapack.dpotrs(self._factor, (self.reference.mean - self.problem.prior_mean).ravel(), lower=1)
        return frozen(np.ascontiguousarray(solution).reshape(self.reference.mean.shape))

    def solved(self) -> Dense:
        """The same, with all that can fail done."""
        self.weights  # noqa: B018
        self._covariance_factor  # noqa: B018
        return self

    def unexplained_one(self, row: Array) -> Array:
        """k(s, s) - k (K + lambda_c Sigma)^-1 k^T of one query, whose kernel row is (N,) or (C, N C): (O, O)."""
        root = self._inverse_factor.times_one(row.T)
        return np.asarray(self._own - blas.dgemm(1.0, root, root, trans_b=1))

    def unexplained(self, rows: Array) -> Array:
        """The same of M queries, whose kernel rows are (M C, N C): (M, O, O)."""
        roots = self._inverse_factor.times_many(rows.T, self.kernel.channels)
        return np.asarray(self._own - roots.transpose(0, 2, 1) @ roots)

    def adapted(self, same: int, inputs: Array, reference: Gaussians) -> Dense:
        """The solution of a changed database, whose first `same` points are this one's."""
        return Dense(self.kernel, self.problem, inputs, reference, self, same)

    @cached_property
    def _copies(self) -> int:
        return self.reference.outputs // self.kernel.channels

    @cached_property
    def _own(self) -> Array:
        return frozen(spread(self.kernel.own, self._copies))

    @cached_property
    def _inverse_factor(self) -> InverseCholeskyFactor:
        return InverseCholeskyFactor.of(self._covariance_factor, self._copies)

    @cached_property
    def _factor(self) -> Array:
        return self._factorised(self.problem.lambda_mean, self.base._factor if self.base else None)

    @cached_property
    def _covariance_factor(self) -> Array:
        if self.problem.lambda_covariance == self.problem.lambda_mean:
            return self._factor
        return self._factorised(self.problem.lambda_covariance, self.base._covariance_factor if self.base else None)

    def _factorised(self, penalty: float, base_factor: Array | None) -> Array:
        """The lower Cholesky factor (N O, N O) of K (x) I + lambda Sigma: the base's, down to the first changed row."""
        o, c, d, same = self.reference.outputs, self.kernel.channels, self._copies, self.same
        count, changed = len(self.inputs), len(self.inputs) - same
        n, p = count * o, same * o
        new = np.zeros((changed, c, d, count, c, d))
        k = self.kernel(self.inputs[same:], self.inputs).reshape(changed, c, count, c)
        for i in range(d):
            new[:, :, i, :, :, i] = k
        points = np.arange(changed)
        blocks = new.reshape(changed, o, count, o)
        blocks[points, :, points + same, :] += penalty * self.reference.covariance[same:]
        rows = blocks.reshape(n - p, n)
        if base_factor is None or p == 0:  # in place: symmetric, so that the transpose is as LAPACK reads it
            factor, info = lapack.dpotrf(rows.T, lower=1, clean=1, overwrite_a=1)
        else:
            factor = np.zeros((n, n), order="F")  # as LAPACK reads it, or each use would copy it
            for a in range(0, p, _COLUMNS):  # what lies above the diagonal stays untouched, and costs no memory
                factor[a:p, a : min(a + _COLUMNS, p)] = base_factor[a:p, a : min(a + _COLUMNS, p)]
            left, _ = lapack.dtrtrs(factor[:p, :p], rows[:, :p].T, lower=1)
            factor[p:, :p] = left.T
            factor[p:, p:], info = lapack.dpotrf(rows[:, p:] - left.T @ left, lower=1, clean=1)
        if info:
            raise ValueError(
                f"K + lambda Sigma is not positive definite to working precision at point {same + (info - 1) // o}, "
                f"with lambda {penalty:g}. A point this near to others needs more variance, or a larger lambda or ell."
            )
        return frozen(factor)
