"""The low rank solution of a database, by the normal equations of the cost (4).

P vec(W) = sum_n (z_n^T (x) I) Sigma_n^-1 (mu_n - m_n) with P = sum_n z_n^T z_n (x) Sigma_n^-1 +
lambda I (r D, r D), z_n a row. Covariance: N / lambda_c (k(s, s) - |z|^2 + lambda_c z P_c^-1 z^T),
with lambda_c in P_c. Rasmussen and Williams 2006, sections 8.3.1 and 8.3.4.

After an adaptation, the solution is conditioned on the points that changed. The base's W has a
normal distribution of covariance lambda P^-1. Conditioning it on U changes with features z and
covariances S = Sigma (added) or -Sigma (removed) gives the system G = lambda z P^-1 z^T + residual
+ lambda S (U O, U O) and W + lambda P^-1 z^T G^-1 (mu - m - z W). Rasmussen and Williams 2006,
section A.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array, brief, numbers
from kmp.arrays.immutable import frozen
from kmp.arrays.inverse_cholesky import InverseCholeskyFactor
from kmp.arrays.linear_algebra import kron_identity
from kmp.functionals import Functionals
from kmp.kernel import between
from kmp.low_rank.features import BLOCK, KEPT, Features
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import Expansion, check_resolved

RANK = 400  # default of the largest number of features
TOLERANCE = 4e-12  # default of the largest residual at a reference point, as a share of k(s, s)
_REFINEMENTS = 2  # iterative refinements of W, against the rounding of the normal equations


@dataclass(frozen=True, eq=False, repr=False)
class LowRank(Expansion):
    """The solution on r features; factors are computed when first used.

    The members are those of `Solution`.
    """

    _not_pickled = frozenset({"mean_factor", "covariance_factor"})

    hyperparameters: Hyperparameters
    database: Database
    features: Features
    information: Array
    """(r D, r D) sum_n z_n^T z_n (x) Sigma_n^-1, which does not depend on lambda."""
    w: Array  # W (r, D), the weights of the features

    representation: ClassVar[Literal["low_rank"]] = "low_rank"

    @classmethod
    def fit(
        cls,
        hyperparameters: Hyperparameters,
        database: Database,
        features: Features,
        *,
        values: Sequence[Array] = (),
    ) -> LowRank:
        """The solution. `values` are the features of the points in blocks, if they are known.

        Raises ValueError if the normal equations cannot be solved, or rounding hides lambda Sigma
        beside k(s, s), of which the features leave a residual.
        """
        check_resolved(hyperparameters, database, name="lambda_mean", both=True)
        r = len(features.pivots)
        c = features.kernel.channels
        d = hyperparameters.channel_outputs
        points = database.functionals
        precision = np.asarray(np.linalg.inv(database.reference.covariance), dtype=np.float64)
        target = database.reference.mean - hyperparameters.prior_at(points)
        blocks = [slice(i, i + BLOCK) for i in range(0, len(points), BLOCK)]

        def lifted(start: int) -> Array:
            if values:
                return values[start // BLOCK].T.reshape(-1, c, r)
            return features(points.take(slice(start, start + BLOCK))).T.reshape(-1, c, r)

        z = cache(lifted) if len(points) * c * r <= KEPT else lifted
        total = np.zeros((r, d, r, d))
        for block in blocks:
            _add_information(total, z(block.start), precision[block])
        information = frozen(total.reshape(r * d, r * d))
        factor = _factorised(information, hyperparameters.lambda_mean)
        w = np.zeros((r, d))
        for _ in range(1 + _REFINEMENTS):
            pull = -hyperparameters.lambda_mean * w
            for block in blocks:
                residual = target[block] - (z(block.start) @ w).reshape(-1, c * d)
                pulls = (precision[block] @ residual[:, :, None]).reshape(-1, c, d)
                pull += np.tensordot(z(block.start), pulls, axes=([0, 1], [0, 1]))
            w = w + lapack.dpotrs(factor, pull.ravel(), lower=1)[0].reshape(r, d)
        fitted = cls(hyperparameters, database, features, information, frozen(w))
        return fitted._with_cached(mean_factor=factor)

    @classmethod
    def of_arrays(
        cls,
        hyperparameters: Hyperparameters,
        database: Database,
        arrays: Mapping[str, NDArray[Any]],
    ) -> LowRank:
        """The solution of stored arrays. Raises ValueError if they do not belong together."""
        pivots = numbers("pivots", arrays["pivots"], "r", database.inputs.shape[1])
        r = len(pivots)
        d = hyperparameters.channel_outputs
        information = numbers("information", arrays["information"], r * d, r * d)
        w = numbers("features", arrays["features"], r, d)
        directions = arrays.get("pivot_directions")
        c = hyperparameters.kernel.channels
        channels = numbers("pivot_channels", arrays.get("pivot_channels", np.zeros(r)), r)
        if not np.isin(channels, np.arange(c)).all():
            raise ValueError(
                f"pivot_channels: {brief(channels)} given, whole numbers below {c} needed."
            )
        features = Features.at(
            hyperparameters.kernel,
            Functionals.checked(pivots, directions),
            channels.astype(np.intp),
        )
        if (usable := len(features.pivots)) < r:
            raise ValueError(
                f"pivots: {r} given, and rounding tells only {usable} apart here. Fit the "
                "primitive anew."
            )
        return cls(hyperparameters, database, features, information, w)

    @property
    def functionals(self) -> Functionals:
        """The r pivots."""
        return self.features.pivots

    @cached_property
    def weights(self) -> Array:
        """(r, O) the weights of the pivots' kernels."""
        return frozen(self.features.kernel_weights(self.w))

    def solved(self) -> Self:
        self.weights  # noqa: B018
        self.covariance_factor  # noqa: B018
        return self

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        z, roots = self.whitened(rows, len(prior))
        return self.covariance_of(z, roots, prior)

    def adapted(self, changes: Changes) -> LowRank | Conditioned:
        """The solution conditioned on these changes, or a new fit if they are many."""
        kernel = self.features.kernel
        changed = len(changes.replaced) + len(changes.inputs)
        if changed * kernel.channels <= len(self.centres):
            return Conditioned(self, changes)
        # Conditioning on more changes than features costs more, and loses more digits, than a fit.
        database = self.database.changed(changes)
        rank = max(RANK, len(self.centres) + len(changes.inputs) * kernel.channels)
        features, _ = Features.of(kernel, database.functionals, rank=rank, tolerance=TOLERANCE)
        return LowRank.fit(self.hyperparameters, database, features)

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> LowRank:
        return LowRank(hyperparameters, self.database, self.features, self.information, self.w)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """The pivots, the information matrix and W."""
        arrays = {"pivots": self.centres, "information": self.information, "features": self.w}
        if self.functionals.directions is not None:
            arrays["pivot_directions"] = self.functionals.directions
        if self.features.kernel.channels > 1:
            arrays["pivot_channels"] = self.features.channels.astype(np.float64)
        return arrays

    def whitened(self, rows: Array, channels: int) -> tuple[Array, Array]:
        """The features (M, r, C) of M queries' kernel rows, and L^-1 times these (M, r D, O)."""
        z = self.features.of_kernel(rows[:, : len(self.centres) * self.features.kernel.channels])
        features = z.reshape(len(z), -1, channels).transpose(1, 0, 2)
        return features, self.inverse_factor.times(z, channels)

    def covariance_of(self, z: Array, roots: Array, prior: Array) -> Array:
        """The posterior covariances (M, O, O) of what is `whitened`, with the prior k(s, s)."""
        residual = kron_identity(prior - z.mT @ z, self.w.shape[1])
        return residual + self.hyperparameters.lambda_covariance * (roots.mT @ roots)

    @cached_property
    def mean_factor(self) -> Array:
        """The lower Cholesky factor L of P = information + lambda I."""
        return _factorised(self.information, self.hyperparameters.lambda_mean)

    @cached_property
    def covariance_factor(self) -> Array:
        """The lower Cholesky factor of information + lambda_c I."""
        parameters = self.hyperparameters
        check_resolved(parameters, self.database, both=True)
        if parameters.lambda_covariance == parameters.lambda_mean:
            return self.mean_factor
        return _factorised(self.information, parameters.lambda_covariance)

    @cached_property
    def inverse_factor(self) -> InverseCholeskyFactor:
        return InverseCholeskyFactor.of(self.covariance_factor, self.w.shape[1])


def _factorised(information: Array, penalty: float) -> Array:
    factor, info = lapack.dpotrf(information + penalty * np.eye(len(information)), lower=1, clean=1)
    if info:
        raise ValueError(
            "The normal equations are not positive definite to working precision with lambda "
            f"{penalty:g}. Raise lambda, the smallest variances, or the tolerance of the rank."
        )
    return frozen(np.asfortranarray(factor))


def _add_information(total: Array, z: Array, precision: Array) -> None:
    """Add sum_n z_n^T z_n (x) Sigma_n^-1 (r, D, r, D), of z (n, C, r) and precisions (n, O, O)."""
    n, c, r = z.shape
    d = total.shape[1]
    blocks = precision.reshape(n, c, d, c, d)

    def along(*outputs: int) -> Array:
        # BLAS computes A^T A twice as fast as A^T B: 2 a b = (a + b)^2 - a^2 - b^2.
        square = np.asarray(sum(blocks[:, 0, i, 0, j] for i in outputs for j in outputs))
        part = z[:, 0] * np.sqrt(np.maximum(square, 0.0))[:, None]  # negative by rounding only
        return np.asarray(part.T @ part)

    diagonal = [along(i) for i in range(d)] if c == 1 else []
    for i in range(d):
        for j in range(i + 1):
            if c == 1:
                share = diagonal[i] if i == j else (along(i, j) - diagonal[i] - diagonal[j]) / 2
            else:  # between two channels, the block of two outputs is not symmetric
                share = z.reshape(-1, r).T @ (blocks[:, :, i, :, j] @ z).reshape(-1, r)
            total[:, i, :, j] += share
            if i != j:
                total[:, j, :, i] += share.T


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

    _not_pickled = frozenset({"database", "_neglected"})

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
        base = self.base
        penalty = self.hyperparameters.lambda_mean
        d = self.base.w.shape[1]
        shared = penalty == self.hyperparameters.lambda_covariance
        system = (
            self._covariance_system if shared else self._system("lambda_mean", base.mean_factor)
        )
        mean = (self._z.T @ base.w).reshape(len(self._points), -1)
        target = self._points.reference.mean - self.hyperparameters.prior_at(
            self._points.functionals
        )
        pull = system.solve((target - mean).ravel())
        back, _ = lapack.dtrtrs(base.mean_factor, system.cross @ pull, lower=1, trans=1)
        columns = self._added_columns
        w = (
            base.w
            + penalty * back.reshape(-1, d)
            - self._z[:, :columns] @ pull.reshape(-1, d)[:columns]
        )
        added = pull.reshape(len(self._points), -1)[: self._added]
        return frozen(np.concatenate([base.features.kernel_weights(w), added]))

    def solved(self) -> Self:
        self.weights  # noqa: B018
        self._covariance_system  # noqa: B018
        return self

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        z, roots = self.base.whitened(rows, len(prior))
        m, _, c = z.shape
        d = self.base.w.shape[1]
        columns = self._added_columns
        system = self._covariance_system
        added = rows.reshape(m, c, -1)[:, :, rows.shape[1] - columns :]  # (M, C, V C)
        residual = added - z.mT @ self._z[:, :columns]
        cross = self.hyperparameters.lambda_covariance * (roots.mT @ system.cross)  # (M, O, U O)
        split = cross.reshape(m, c, d, -1, d)
        for i in range(d):
            split[:, :, i, :columns, i] += residual
        gain = system.solve(cross.reshape(m * c * d, -1).T).T.reshape(cross.shape)
        return np.asarray(self.base.covariance_of(z, roots, prior) - gain @ cross.mT)

    @property
    def _added(self) -> int:
        return len(self.changes.inputs)

    @property
    def _added_columns(self) -> int:
        return self._added * self.base.features.kernel.channels

    @cached_property
    def _points(self) -> Database:
        """The U changed points, those added first."""
        return self.changes.added.joined(self.base.database.take(self.changes.replaced))

    @cached_property
    def _z(self) -> Array:
        """The features (r, U C) of the U points."""
        return frozen(self.base.features(self._points.functionals))

    @cached_property
    def _covariance_system(self) -> _System:
        return self._system("lambda_covariance", self.base.covariance_factor)

    @cached_property
    def _neglected(self) -> Array:
        """The kernel's residual between the V added points: k - z^T z (V C, V C)."""
        points = self.changes.functionals
        z = self._z[:, : self._added_columns]
        return frozen(between(self.hyperparameters.kernel, points, points) - z.T @ z)

    def _system(
        self, name: Literal["lambda_mean", "lambda_covariance"], base_factor: Array
    ) -> _System:
        parameters = self.hyperparameters
        count = len(self._points)
        first = len(self.base.database) - len(self.changes.replaced)
        check_resolved(parameters, self.changes.added, first=first, name=name, both=True)
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
                "The via-points contradict each other to working precision, with lambda "
                f"{penalty:g}. Give those that are near to others more variance."
            )
        return _System(frozen(cross), frozen(lu), frozen(pivots))
