"""The exact solution of equation (9), by a Cholesky factor of K + lambda Sigma.

alpha = (K (x) I + lambda Sigma)^-1 (mu - m), of N O rows with O = C D. If every Sigma_n is S_n (x)
I with S_n (C, C) and I of size D, the matrix is the same for each of the D outputs: one factor of
N C rows then serves them all (`distinct` = 1, else D).

A primitive with changed points shares its base's factor L (p, p). Points added are a border
(Golub and Van Loan, section 4.2): [[L, 0], [B^T, M]] with B = L^-1 A and M M^T = C - B^T B. Points
removed, with unit columns E, leave the inverse L^-T (I - Q Q^T) L^-1 with L^-1 E = Q R.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import frozen
from kmp.arrays.inverse_cholesky import InverseCholeskyFactor
from kmp.arrays.linear_algebra import kron_identity
from kmp.functionals import Functionals
from kmp.kernel import between
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import Expansion, check_resolved

SINGLE = 450  # N O up to which a fit takes less than a millisecond, and less than a change of one
# a border is faster than a fit if at least this share of points precedes the first change
_LEAST_SHARED = 0.75
_MOST_REMOVED = 0.125  # removing points is faster than a fit up to this share of them
# least lambda_c Sigma / k(s, s) from which a product with the inverse is exact to 1e-9
_PRECISE = 1e-2


class _Removed(NamedTuple):
    """Rows removed from a matrix L L^T of which L is known.

    With the unit columns E of these rows and L^-1 E = Q R, the inverse of the remaining matrix is
    that part of L^-T (I - Q Q^T) L^-1.
    """

    rows: NDArray[np.intp]  # (q,)
    kept: NDArray[np.intp]  # (p - q,)
    span: Array  # Q (p, q)
    root: Array  # R (q, q)

    @classmethod
    def out_of(cls, base: Array, rows: NDArray[np.intp]) -> _Removed:
        """These rows (q,), removed from L L^T (p, p)."""
        unit = np.zeros((len(base), len(rows)), order="F")
        unit[rows, np.arange(len(rows))] = 1.0
        span, root = np.linalg.qr(lapack.dtrtrs(base, unit, lower=1)[0])
        return cls(
            frozen(rows), frozen(np.delete(np.arange(len(base)), rows)), frozen(span), frozen(root)
        )

    def projected(self, base: Array, right: Array, removed: Array | None = None) -> Array:
        """(I - Q Q^T) L^-1 x (p, J), for the remaining rows of x (p - q, J).

        The result does not depend on the other rows of x, `removed` (q, J), but its
        rounding does. None chooses them so that Q^T L^-1 x is 0 before rounding.
        """
        padded = np.zeros((len(base), right.shape[1]), order="F")
        padded[self.kept] = right
        if removed is None:
            forward, _ = lapack.dtrtrs(base, padded, lower=1)
            removed = -lapack.dtrtrs(self.root, self.span.T @ forward)[0]
        padded[self.rows] = removed
        forward, _ = lapack.dtrtrs(base, padded, lower=1)
        return np.asarray(forward - self.span @ (self.span.T @ forward))


class _Bordered(NamedTuple):
    """A Cholesky factor [[L, 0], [B^T, M]], whose L is shared with the base.

    If rows are removed from L L^T, B is `_Removed.projected` of the border.
    """

    base: Array  # L (p, p)
    border: Array  # B (p, m)
    corner: Array  # M (m, m)
    removed: _Removed | None

    def solve(self, right: Array) -> Array:
        """The inverse of the factorised matrix times (p - q + m, J)."""
        shared = len(right) - len(self.corner)
        if self.removed is None:
            forward, _ = lapack.dtrtrs(self.base, right[:shared], lower=1)
        else:
            forward = self.removed.projected(self.base, right[:shared])
        last, _ = lapack.dpotrs(self.corner, right[shared:] - self.border.T @ forward, lower=1)
        first, _ = lapack.dtrtrs(self.base, forward - self.border @ last, lower=1, trans=1)
        return np.concatenate([first if self.removed is None else first[self.removed.kept], last])

    def whole(self) -> Array:
        """The factor as one array (p + m, p + m)."""
        above = np.zeros(self.border.shape)
        factor = np.block([[self.base, above], [self.border.T, self.corner]])
        return frozen(np.asfortranarray(factor))


@dataclass(frozen=True, eq=False, repr=False)
class Dense(Expansion):
    """The solution for N points, whose factors are computed when first used.

    The members are those of `Solution`.
    """

    # A copy in another process predicts without the factors; only `adapted` computes them again.
    _not_pickled = frozenset(
        {"mean_factor", "covariance_factor", "_mean_solver", "_covariance_solver", "_precision"}
    )

    hyperparameters: Hyperparameters
    database: Database
    base: Dense | None = None
    """The solution whose factors this one shares: of the first `same` points."""
    same: int = 0
    gone: NDArray[np.intp] | None = None
    """The base's points that were removed; None: all from index `same` on."""

    representation: ClassVar[Literal["dense"]] = "dense"

    @property
    def functionals(self) -> Functionals:
        """The N reference points."""
        return self.database.functionals

    @cached_property
    def weights(self) -> Array:
        """alpha (N, O) = (K + lambda Sigma)^-1 (mu - prior mean). Equation (9)."""
        prior = self.hyperparameters.prior_at(self.database.functionals)
        return frozen(self.times_inverse(self.database.reference.mean - prior))

    def times_inverse(self, right: Array) -> Array:
        """(K + lambda Sigma)^-1 times (N, O), or (N, O, J)."""
        columns = right.reshape(
            len(self.database) * self.hyperparameters.kernel.channels * self.distinct, -1
        )
        solver = self._mean_solver
        solution = (
            lapack.dpotrs(solver, columns, lower=1)[0]
            if isinstance(solver, np.ndarray)
            else solver.solve(columns)
        )
        return np.ascontiguousarray(solution).reshape(right.shape)

    def solved(self) -> Self:
        self.weights  # noqa: B018
        self._covariance_solver  # noqa: B018
        return self

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        prior_covariance = kron_identity(prior, self.distinct)
        if len(prior) == 1 and self._precision is not None:
            covariance = np.tile(prior_covariance, (len(rows), 1, 1))
            for i in range(self.distinct):
                for j in range(i + 1):
                    explained = np.vecdot(rows @ self._precision[i, j], rows)
                    covariance[:, i, j] -= explained
                    if i != j:
                        covariance[:, j, i] -= explained
            return self._for_all_outputs(covariance)
        roots = self.inverse_factor.times(rows.T, len(prior))
        return self._for_all_outputs(np.asarray(prior_covariance - roots.mT @ roots))

    def adapted(self, changes: Changes) -> Dense:
        """The solution with these changes; it shares this one's factor if that is faster."""
        count = len(self.database)
        replaced = changes.replaced
        database = self.database.changed(changes)
        first = int(replaced[0]) if len(replaced) else count
        if len(replaced) and self.database.reference.mean.size <= SINGLE:
            return Dense(self.hyperparameters, database)  # a fit takes less than a change
        if count - first > 2 * len(replaced) and len(replaced) <= _MOST_REMOVED * count:
            solution = Dense(self.hyperparameters, database, self, count - len(replaced), replaced)
            if solution.distinct >= self.distinct:
                return solution
        if first >= _LEAST_SHARED * count:
            return Dense(self.hyperparameters, database, self, first)
        return Dense(self.hyperparameters, database)

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Dense:
        return Dense(hyperparameters, self.database)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        return {}

    @cached_property
    def distinct(self) -> int:
        """The number of outputs of a channel in the factors: D, or 1 if one factor serves all."""
        c = self.hyperparameters.kernel.channels
        d = self.hyperparameters.channel_outputs
        covariance = self.database.reference.covariance
        if covariance[0, 0, 1:d].any():
            return d
        first = covariance.reshape(-1, c, d, c, d)[:, :, 0, :, 0]
        return 1 if np.array_equal(covariance, kron_identity(first, d)) else d

    def _for_all_outputs(self, covariance: Array) -> Array:
        """Covariances (..., O, O), of (..., C distinct, C distinct) in the factors."""
        alike = self.hyperparameters.channel_outputs // self.distinct
        return kron_identity(covariance, alike) if alike > 1 else covariance

    @cached_property
    def inverse_factor(self) -> InverseCholeskyFactor:
        return InverseCholeskyFactor.of(self.covariance_factor, self.distinct)

    @cached_property
    def _precision(self) -> Array | None:
        """The blocks (D, D, N, N) of (K + lambda_c Sigma)^-1, whose products with one query's row
        are half of those of L^-1; None over several channels, or where rounding would show.
        """
        parameters = self.hyperparameters
        kernel = parameters.kernel
        precise = _PRECISE / parameters.lambda_covariance
        if kernel.channels > 1 or not self.database.exceeds(kernel, precise):
            return None
        lower, _ = lapack.dpotri(self.covariance_factor, lower=1)
        inverse = np.tril(lower) + np.tril(lower, -1).T
        n = len(self.database)
        blocks: Array = inverse.reshape(n, -1, n, self.distinct).transpose(1, 3, 0, 2).copy()
        return frozen(blocks)

    @cached_property
    def mean_factor(self) -> Array:
        """The lower Cholesky factor of K (x) I + lambda Sigma: N C distinct rows and columns."""
        return self._whole("mean_factor", self._mean_solver)

    @cached_property
    def covariance_factor(self) -> Array:
        """The lower Cholesky factor of K (x) I + lambda_c Sigma: N C distinct rows and columns."""
        solver = self._covariance_solver
        if solver is self._mean_solver:
            return self.mean_factor
        return self._whole("covariance_factor", solver)

    def _whole(self, name: str, solver: Array | _Bordered) -> Array:
        if isinstance(solver, np.ndarray):
            return solver
        if solver.removed is None:
            return solver.whole()
        fitted: Array = getattr(Dense(self.hyperparameters, self.database), name)
        return fitted

    @cached_property
    def _mean_solver(self) -> Array | _Bordered:
        return self._factorised(
            self.hyperparameters.lambda_mean, self.base.mean_factor if self.base else None
        )

    @cached_property
    def _covariance_solver(self) -> Array | _Bordered:
        parameters = self.hyperparameters
        check_resolved(parameters, self._added, first=self.same)
        if parameters.lambda_covariance == parameters.lambda_mean:
            return self._mean_solver
        return self._factorised(
            parameters.lambda_covariance, self.base.covariance_factor if self.base else None
        )

    @property
    def _added(self) -> Database:
        """The points whose factor the base does not share."""
        return self.database.take(slice(self.same, None)) if self.same else self.database

    def _factorised(self, penalty: float, base_factor: Array | None) -> Array | _Bordered:
        """The Cholesky factor with this lambda, bordering the base's if that is shared."""
        rows = self._rows(penalty)
        if (
            base_factor is not None
            and self.base is not None
            and self.base.distinct != self.distinct
        ):
            d = self.hyperparameters.channel_outputs
            base_factor = (
                kron_identity(base_factor, d) if self.distinct == d else base_factor[::d, ::d]
            )
        if base_factor is None:
            # In place: the matrix is symmetric, and its transpose has LAPACK's order.
            factor, info = lapack.dpotrf(rows.T, lower=1, clean=1, overwrite_a=1)
            solver: Array | _Bordered = frozen(factor)
        else:
            solver, info = self._bordered(rows, base_factor)
        if info:
            point = self.same + (info - 1) // (self.hyperparameters.kernel.channels * self.distinct)
            raise ValueError(
                f"K + lambda Sigma is not positive definite to working precision at point {point}, "
                f"with lambda {penalty:g}. A point this near to others needs more variance, or a "
                "larger lambda or ell."
            )
        return solver

    def _bordered(self, rows: Array, base_factor: Array) -> tuple[_Bordered, int]:
        """The base's factor bordered by these rows, without removed points; LAPACK's info."""
        p = rows.shape[1] - len(rows)
        removed = None
        columns = rows[:, :p].T
        if self.gone is None or self.base is None:
            shared = np.asfortranarray(base_factor[:p, :p])
            border, _ = lapack.dtrtrs(shared, columns, lower=1)
        else:
            shared = np.asfortranarray(base_factor)
            kernel = self.hyperparameters.kernel
            o = kernel.channels * self.distinct
            removed_points = self.base.database.functionals.take(self.gone)
            removed = _Removed.out_of(shared, (self.gone[:, None] * o + np.arange(o)).ravel())
            across = between(kernel, removed_points, self._added.functionals)
            border = removed.projected(shared, columns, kron_identity(across, self.distinct))
        corner, info = lapack.dpotrf(rows[:, p:] - border.T @ border, lower=1, clean=1)
        return _Bordered(frozen(shared), frozen(border), frozen(corner), removed), info

    def _rows(self, penalty: float) -> Array:
        """The rows of K (x) I + lambda Sigma that the base does not share, with all columns."""
        kernel = self.hyperparameters.kernel
        first = self.same
        c = kernel.channels
        d = self.distinct
        outputs = self.hyperparameters.channel_outputs
        o = c * d
        points = self.database.functionals
        count = len(self.database)
        changed = count - first
        rows = np.zeros((changed, c, d, count, c, d))
        k = between(kernel, self._added.functionals, points).reshape(changed, c, count, c)
        for i in range(d):
            rows[:, :, i, :, :, i] = k
        blocks = rows.reshape(changed, o, count, o)[:, :, first:]
        covariance = self.database.reference.covariance[first:].reshape(
            changed, c, outputs, c, outputs
        )[:, :, :d, :, :d]
        diagonal = np.einsum("ninj->nij", blocks)  # a view
        diagonal += penalty * covariance.reshape(changed, o, o)
        return rows.reshape(changed * o, count * o)
