"""The exact solution of equation (9), by one Cholesky factor of K + lambda Sigma.

It has N O rows; or N C, where no covariance tells the D outputs of a channel apart: what is
factorised is then the same matrix D times over.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.inverse_cholesky import InverseCholeskyFactor
from kmp.arrays.linear_algebra import kron_identity
from kmp.functionals import Functionals
from kmp.kernel import between
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import ErrorBounds, check_resolved

_SHARED = 0.75  # of the points: where fewer come before the first change, a border costs more than a fit
_TAKEN = 0.125  # of the points: where more are taken out of the factor, that costs more than a fit
_COLUMNS = 64  # of a factor, copied at once


class _Taken(NamedTuple):
    """The rows that are taken out of what a Cholesky factor L is of: with E the unit columns of
    these, the inverse of the rest is that of L L^T with I - Q Q^T between L^-T and L^-1, where
    L^-1 E = Q R.
    """

    rows: NDArray[np.intp]  # (q,)
    kept: NDArray[np.intp]  # (p - q,)
    span: Array  # Q (p, q)
    root: Array  # R (q, q)

    @classmethod
    def out_of(cls, base: Array, rows: NDArray[np.intp]) -> _Taken:
        """These rows out of L (p, p)."""
        unit = np.zeros((len(base), len(rows)), order="F")
        unit[rows, np.arange(len(rows))] = 1.0
        span, root = np.linalg.qr(lapack.dtrtrs(base, unit, lower=1)[0])
        return cls(frozen(rows), frozen(np.delete(np.arange(len(base)), rows)), frozen(span), frozen(root))

    def forth(self, base: Array, right: Array, there: Array | None = None) -> Array:
        """(I - Q Q^T) L^-1 times (p - q, J), whatever would be `there` (q, J), in the rows taken.

        Best is what the others let expect, None: little is left to project, and few digits lost.
        """
        every = np.zeros((len(base), right.shape[1]), order="F")
        every[self.kept] = right
        if there is None:
            found, _ = lapack.dtrtrs(base, every, lower=1)
            there = -lapack.dtrtrs(self.root, self.span.T @ found)[0]
        every[self.rows] = there
        found, _ = lapack.dtrtrs(base, every, lower=1)
        return np.asarray(found - self.span @ (self.span.T @ found))


class _Bordered(NamedTuple):
    """A Cholesky factor [[L, 0], [B^T, M]], whose L is that of another and not copied; where rows
    are taken out of that, B is `_Taken.forth` of the border.
    """

    base: Array  # L (p, p)
    border: Array  # B (p, m)
    corner: Array  # M (m, m)
    taken: _Taken | None

    def solve(self, right: Array) -> Array:
        """The inverse of what is factorised times (p - q + m, J)."""
        shared = len(right) - len(self.corner)
        if self.taken is None:
            forth, _ = lapack.dtrtrs(self.base, right[:shared], lower=1)
        else:
            forth = self.taken.forth(self.base, right[:shared])
        last, _ = lapack.dpotrs(self.corner, right[shared:] - self.border.T @ forth, lower=1)
        first, _ = lapack.dtrtrs(self.base, forth - self.border @ last, lower=1, trans=1)
        return np.concatenate([first if self.taken is None else first[self.taken.kept], last])

    def whole(self) -> Array:
        """The factor as one (p + m, p + m)."""
        p, n = len(self.base), sum(self.border.shape)
        factor = np.zeros((n, n), order="F")  # as LAPACK reads it, or each use would copy it
        for a in range(0, p, _COLUMNS):  # what lies above the diagonal stays untouched, and costs no memory
            factor[a:p, a : min(a + _COLUMNS, p)] = self.base[a:, a : min(a + _COLUMNS, p)]
        factor[p:, :p], factor[p:, p:] = self.border.T, self.corner
        return frozen(factor)


@dataclass(frozen=True, eq=False, repr=False)
class Dense(Immutable):
    """The solution for N points; the factors are made when first asked for.

    The members are those of `Solution`.
    """

    # A copy in another process predicts at once; only `adapted` would need the factors again.
    _not_pickled = frozenset({"mean_factor", "covariance_factor", "_mean_solver", "_covariance_solver"})

    hyperparameters: Hyperparameters
    database: Database
    base: Dense | None = None
    """The solution that shares the first `same` points, and so rows of the factors."""
    same: int = 0
    gone: NDArray[np.intp] | None = None
    """The base's points that are not among these; None: those from the `same` on."""

    representation: ClassVar[Literal["dense"]] = "dense"
    error_bounds: ClassVar[ErrorBounds] = ErrorBounds(0.0, 0.0)

    @property
    def functionals(self) -> Functionals:
        """The N reference points."""
        return self.database.functionals

    @property
    def centres(self) -> Array:
        """(N, I) where they are."""
        return self.database.inputs

    @cached_property
    def weights(self) -> Array:
        """alpha (N, O) = (K + lambda Sigma)^-1 (mu - prior mean). Equation (9)."""
        prior = self.hyperparameters.prior_at(self.database.functionals)
        return frozen(self.times_inverse(self.database.reference.mean - prior))

    def times_inverse(self, right: Array) -> Array:
        """(K + lambda Sigma)^-1 times (N, O), or (N, O, J)."""
        columns, solver = (
            right.reshape(len(self.database) * self.hyperparameters.kernel.channels * self.apart, -1),
            self._mean_solver,
        )
        solution = (
            lapack.dpotrs(solver, columns, lower=1)[0] if isinstance(solver, np.ndarray) else solver.solve(columns)
        )
        return np.ascontiguousarray(solution).reshape(right.shape)

    def solved(self) -> Self:
        self.weights  # noqa: B018
        self._covariance_solver  # noqa: B018
        return self

    def posterior_covariance_one(self, row: Array, prior: Array | None = None) -> Array:
        root = self.inverse_factor.times_one(row.T)
        own = self._prior_covariance if prior is None else kron_identity(prior, self.apart)
        return self._of_all(np.asarray(own - blas.dgemm(1.0, root, root, trans_b=1)))

    def posterior_covariance(self, rows: Array) -> Array:
        roots = self.inverse_factor.times_many(rows.T, self.hyperparameters.kernel.channels)
        return self._of_all(np.asarray(self._prior_covariance - roots.transpose(0, 2, 1) @ roots))

    def adapted(self, changes: Changes) -> Dense:
        """The base's solution with these changes; they share the points before the first change."""
        base = self.base or self
        count, gone = len(base.database), changes.replaced
        database, first = base.database.changed(changes), int(gone[0]) if len(gone) else count
        if count - first > 2 * len(gone) and len(gone) <= _TAKEN * count:
            found = Dense(self.hyperparameters, database, base, count - len(gone), gone)
            if found.apart >= base.apart:
                return found
        return Dense(self.hyperparameters, database, base, first if first >= _SHARED * count else 0)

    def extended(self, database: Database) -> Dense:
        """The solution of a database that begins with this one's: the factors grow by a border."""
        bordered = Dense(self.hyperparameters, database, self, len(self.database))
        factors = {"_mean_solver": bordered.mean_factor, "_covariance_solver": bordered.covariance_factor}
        return Dense(self.hyperparameters, database)._with_cached(**factors).solved()  # noqa: SLF001 (of its own kind)

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Dense:
        return Dense(hyperparameters, self.database)

    def with_weights(self, weights: Array) -> Self:
        return self._with_cached(weights=weights)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        return {}

    @cached_property
    def apart(self) -> int:
        """Outputs of a channel that the factors hold each for itself: all D, or 1 for all."""
        c, d = self.hyperparameters.kernel.channels, self.hyperparameters.channel_outputs
        covariance = self.database.reference.covariance
        first = covariance.reshape(-1, c, d, c, d)[:, :, 0, :, 0]
        return 1 if np.array_equal(covariance, kron_identity(first, d)) else d

    def _of_all(self, covariance: Array) -> Array:
        """Covariances (..., O, O) of those (..., C apart, C apart) of the outputs held apart."""
        alike = self.hyperparameters.channel_outputs // self.apart
        return kron_identity(covariance, alike) if alike > 1 else covariance

    @cached_property
    def _prior_covariance(self) -> Array:
        return frozen(kron_identity(self.hyperparameters.kernel.prior_variance, self.apart))

    @cached_property
    def inverse_factor(self) -> InverseCholeskyFactor:
        return InverseCholeskyFactor.of(self.covariance_factor, self.apart)

    @cached_property
    def mean_factor(self) -> Array:
        """The lower Cholesky factor (N C apart, N C apart) of K (x) I + lambda Sigma."""
        return self._whole("mean_factor", self._mean_solver)

    @cached_property
    def covariance_factor(self) -> Array:
        """The same with the lambda of the covariance."""
        solver = self._covariance_solver
        if solver is self._mean_solver:
            return self.mean_factor
        return self._whole("covariance_factor", solver)

    def _whole(self, name: str, solver: Array | _Bordered) -> Array:
        if isinstance(solver, np.ndarray):
            return solver
        if solver.taken is None:
            return solver.whole()
        anew: Array = getattr(Dense(self.hyperparameters, self.database), name)
        return anew

    @cached_property
    def _mean_solver(self) -> Array | _Bordered:
        return self._factorised(self.hyperparameters.lambda_mean, self.base.mean_factor if self.base else None)

    @cached_property
    def _covariance_solver(self) -> Array | _Bordered:
        parameters = self.hyperparameters
        check_resolved(parameters, self.database.since(self.same), first=self.same)
        if parameters.lambda_covariance == parameters.lambda_mean:
            return self._mean_solver
        return self._factorised(parameters.lambda_covariance, self.base.covariance_factor if self.base else None)

    def _factorised(self, penalty: float, base_factor: Array | None) -> Array | _Bordered:
        """The factor; with the base's in it, and not copied, where no point was taken out."""
        rows = self._rows(penalty)
        if base_factor is not None and self.base is not None and self.base.apart != self.apart:
            d = self.hyperparameters.channel_outputs
            base_factor = kron_identity(base_factor, d) if self.apart == d else base_factor[::d, ::d]
        if base_factor is None or self.same == 0:
            # In place: the rows are symmetric, so that their transpose is as LAPACK reads it.
            factor, info = lapack.dpotrf(rows.T, lower=1, clean=1, overwrite_a=1)
            found: Array | _Bordered = frozen(factor)
        else:
            found, info = self._bordered(rows, base_factor)
        if info:
            point = self.same + (info - 1) // (self.hyperparameters.kernel.channels * self.apart)
            raise ValueError(
                f"K + lambda Sigma is not positive definite to working precision at point {point}, with lambda "
                f"{penalty:g}. A point this near to others needs more variance, or a larger lambda or ell."
            )
        return found

    def _bordered(self, rows: Array, base_factor: Array) -> tuple[_Bordered, int]:
        """The base's factor with these rows, less those of points that are gone; LAPACK's info."""
        p, taken = rows.shape[1] - len(rows), None
        columns = rows[:, :p].T
        if self.gone is None or self.base is None:
            shared = np.asfortranarray(base_factor[:p, :p])
            border, _ = lapack.dtrtrs(shared, columns, lower=1)
        else:
            shared, kernel = np.asfortranarray(base_factor), self.hyperparameters.kernel
            o, gone = kernel.channels * self.apart, self.base.database.functionals.take(self.gone)
            taken = _Taken.out_of(shared, (self.gone[:, None] * o + np.arange(o)).ravel())
            there = between(kernel, gone, self.database.functionals.take(slice(self.same, None)))
            border = taken.forth(shared, columns, kron_identity(there, self.apart))
        corner, info = lapack.dpotrf(rows[:, p:] - border.T @ border, lower=1, clean=1)
        return _Bordered(frozen(shared), frozen(border), frozen(corner), taken), info

    def _rows(self, penalty: float) -> Array:
        """The rows of K (x) I + lambda Sigma that the base does not share: all columns."""
        kernel, same = self.hyperparameters.kernel, self.same
        c, d, every = kernel.channels, self.apart, self.hyperparameters.channel_outputs
        o = c * d
        points, count, changed = self.database.functionals, len(self.database), len(self.database) - same
        rows = np.zeros((changed, c, d, count, c, d))
        k = between(kernel, points.take(slice(same, None)), points).reshape(changed, c, count, c)
        for i in range(d):
            rows[:, :, i, :, :, i] = k
        diagonal = np.arange(changed)
        blocks = rows.reshape(changed, o, count, o)
        covariance = self.database.reference.covariance[same:].reshape(changed, c, every, c, every)[:, :, :d, :, :d]
        blocks[diagonal, :, diagonal + same, :] += penalty * covariance.reshape(changed, o, o)
        return rows.reshape(changed * o, count * o)
