"""The solution for any number of points: the paper's cost (4) solved in its primal form, on features of the kernel.

With r features z(s) (kmp/features.py), xi(s) = z(s) W, and W (r, D) minimises (4): an (r D x r D) system, however many
points there are. What the features leave of the kernel is kept where it counts: in the covariance, and at via-points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack

from kmp.checks import Array
from kmp.features import Features
from kmp.gaussians import Gaussians
from kmp.immutable import Immutable, frozen
from kmp.inverse_cholesky import InverseCholeskyFactor
from kmp.kernel import Kernel, spread
from kmp.problem import Problem

_BLOCK = 8192  # rows at once, which bounds the memory
_KEPT = 50_000_000  # numbers of features that are kept during a fit: 400 MB; more are made again for each pass
_REFINEMENTS = 2  # of W, against the rounding of the normal equations


@dataclass(frozen=True, eq=False)
class LowRank(Immutable):
    """The solution on r features. Immutable; the factors are made when first asked for."""

    _not_pickled = frozenset({"_factors"})

    problem: Problem
    features: Features
    information: Array
    """(r D, r D) sum_n z_n^T z_n (x) Sigma_n^-1: what the points say, whatever lambda is."""
    w: Array
    """(r, D) the features' weights."""

    @classmethod
    def fit(
        cls,
        features: Features,
        problem: Problem,
        inputs: Array,
        reference: Gaussians,
    ) -> LowRank:
        """The solution for inputs (N, I) and N normals."""
        r, c, o = len(features.pivots), features.kernel.channels, reference.outputs
        d = o // c
        blocks = [slice(i, i + _BLOCK) for i in range(0, len(inputs), _BLOCK)]

        def lifted() -> Iterator[Array]:
            return (features(inputs[block]).T.reshape(-1, c, r) for block in blocks)

        kept = list(lifted()) if len(inputs) * c * r <= _KEPT else None
        precision = [np.asarray(np.linalg.inv(reference.covariance[block]), dtype=np.float64) for block in blocks]
        y = [reference.mean[block] - problem.prior_mean for block in blocks]
        total = np.zeros((r, d, r, d))
        for zb, sb in zip(kept or lifted(), precision, strict=True):
            _add_information(total, zb, sb)
        information = frozen(total.reshape(r * d, r * d))
        self = cls(problem, features, information, frozen(np.zeros((r, d))))
        w, factor = np.zeros((r, d)), self.factor(problem.lambda_mean)
        for _ in range(1 + _REFINEMENTS):
            pull = -problem.lambda_mean * w
            for zb, sb, yb in zip(kept or lifted(), precision, y, strict=True):
                miss = yb - (zb @ w).reshape(-1, o)
                pull += np.tensordot(zb, (sb @ miss[:, :, None]).reshape(-1, c, d), axes=([0, 1], [0, 1]))
            w = w + lapack.dpotrs(factor, pull.ravel(), lower=1)[0].reshape(r, d)
        self.__dict__["w"] = frozen(w)
        return self

    @property
    def kernel(self) -> Kernel:
        """The kernel."""
        return self.features.kernel

    @property
    def centres(self) -> Array:
        """(r, I) the pivots, where the mean's expansion has its kernels."""
        return self.features.pivots

    @cached_property
    def weights(self) -> Array:
        """(r, O) the weights of that expansion."""
        return frozen(self.features.weights(self.w))

    def solved(self) -> LowRank:
        """The same, with all that can fail done."""
        self.weights  # noqa: B018
        self.factor(self.problem.lambda_covariance)
        return self

    def factor(self, penalty: float) -> Array:
        """The lower Cholesky factor of P = information + lambda I, the matrix of (4)'s normal equations."""
        if penalty not in self._factors:
            p = self.information + penalty * np.eye(len(self.information))
            factor, info = lapack.dpotrf(p, lower=1, clean=1)
            if info:
                raise ValueError(
                    f"The normal equations are not positive definite to working precision with lambda {penalty:g}. "
                    "Raise lambda, the smallest variances, or the tolerance of the rank."
                )
            self._factors[penalty] = frozen(np.asfortranarray(factor))
        return self._factors[penalty]

    @cached_property
    def _factors(self) -> dict[float, Array]:
        return {}

    @cached_property
    def inverse_factor(self) -> InverseCholeskyFactor:
        """The inverse of the factor for the covariance."""
        return InverseCholeskyFactor.of(self.factor(self.problem.lambda_covariance), self.w.shape[1])

    def unexplained_one(self, row: Array) -> Array:
        """k(s, s) - k (K + lambda_c Sigma)^-1 k^T of one query, whose kernel row is (r,) or (C, r C): (O, O)."""
        z, root = self.roots_one(row)
        return self.remainder(z.T @ z) + self.problem.lambda_covariance * blas.dgemm(1.0, root, root, trans_b=1)

    def unexplained(self, rows: Array) -> Array:
        """The same of M queries, whose kernel rows are (M C, r C): (M, O, O)."""
        z, roots = self.roots(rows)
        return self.remainder(z.transpose(0, 2, 1) @ z) + self.problem.lambda_covariance * (roots.transpose(0, 2, 1) @ roots)

    def roots_one(self, row: Array) -> tuple[Array, Array]:
        """The features (r, C) of one query, and what P leaves of them: (O, r D)."""
        c = self.kernel.channels
        z = self.features.whitened(row[..., : len(self.centres) * c : c].T)
        return z.reshape(-1, c), self.inverse_factor.times_one(z)

    def roots(self, rows: Array) -> tuple[Array, Array]:
        """The features (M, r, C) of M queries, and what P leaves of them: (M, r D, O)."""
        c = self.kernel.channels
        z = self.features.whitened(rows[:, : len(self.centres) * c : c].T)
        return z.reshape(len(z), -1, c).transpose(1, 0, 2), self.inverse_factor.times_many(z, c)

    def remainder(self, explained: Array) -> Array:
        """k(s, s) less what the features explain of it (..., C, C), for each output: (..., O, O)."""
        return spread(self.kernel.own - explained, self.w.shape[1])


@dataclass(frozen=True, eq=False)
class Conditioned(Immutable):
    """The low rank solution after V points were added and R taken out: a normal conditioned on a few more normals.

    Adding is a term of rank O for each point. A point is taken out by adding it again with minus its covariance.
    What the features leave of the kernel between added points is kept, so that they are met wherever they are; between
    them and the base's points it is neglected: it is below the square root of the tolerance.
    """

    base: LowRank
    inputs: Array
    """(V + R, I), the added first."""
    changes: Gaussians
    """The V + R normals."""
    added: int
    """V."""

    @property
    def kernel(self) -> Kernel:
        """The kernel."""
        return self.base.kernel

    @cached_property
    def centres(self) -> Array:
        """(r + V, I) where the mean's expansion has its kernels."""
        return frozen(np.concatenate([self.base.centres, self.inputs[: self.added]]))

    @cached_property
    def weights(self) -> Array:
        """(r + V, O) the weights of that expansion."""
        base, penalty = self.base, self.base.problem.lambda_mean
        cross, system = self._system(penalty)
        d = base.w.shape[1]
        miss = self.changes.mean - base.problem.prior_mean - (self._z.T @ base.w).reshape(len(self.inputs), -1)
        pull = self._solve(system, miss.ravel())
        back, _ = lapack.dtrtrs(base.factor(penalty), cross @ pull, lower=1, trans=1)
        own = self.added * self.kernel.channels
        w = base.w + penalty * back.reshape(-1, d) - self._z[:, :own] @ pull.reshape(-1, d)[:own]
        added = pull.reshape(len(self.inputs), -1)[: self.added]
        return frozen(np.concatenate([base.features.weights(w), added]))

    def solved(self) -> Conditioned:
        """The same, with all that can fail done."""
        self.weights  # noqa: B018
        self._covariance_system  # noqa: B018
        return self

    def unexplained_one(self, row: Array) -> Array:
        """As in the base; the row is over r + V centres."""
        z, root = self.base.roots_one(row)
        return np.asarray(self._unexplained(np.atleast_2d(row)[None], z[None], root.T[None])[0])

    def unexplained(self, rows: Array) -> Array:
        """As in the base; the rows are over r + V centres."""
        z, roots = self.base.roots(rows)
        return self._unexplained(rows.reshape(len(z), self.kernel.channels, -1), z, roots)

    def _unexplained(self, rows: Array, z: Array, roots: Array) -> Array:
        base, c = self.base, self.kernel.channels
        d = base.w.shape[1]
        penalty = base.problem.lambda_covariance
        cross, system = self._covariance_system
        own = self.added * c
        share = penalty * (roots.transpose(0, 2, 1) @ cross)  # (M, O, U O)
        left = rows[:, :, len(base.centres) * c :] - z.transpose(0, 2, 1) @ self._z[:, :own]  # (M, C, V C)
        split = share.reshape(len(rows), c, d, -1, d)
        for i in range(d):
            split[:, :, i, :own, i] += left
        share = split.reshape(len(rows) * c * d, -1)
        gain = self._solve(system, share.T).T.reshape(len(rows), c * d, -1)
        share = share.reshape(gain.shape)
        before = base.remainder(z.transpose(0, 2, 1) @ z) + penalty * (roots.transpose(0, 2, 1) @ roots)
        return np.asarray(before - gain @ share.transpose(0, 2, 1))

    @cached_property
    def _z(self) -> Array:
        return frozen(self.base.features(self.inputs))  # (r, U C)

    @cached_property
    def _covariance_system(self) -> tuple[Array, tuple[Array, Array]]:
        return self._system(self.base.problem.lambda_covariance)

    def _system(self, penalty: float) -> tuple[Array, tuple[Array, Array]]:
        """What the base's points leave of the changed points' features, and the factors of their own system."""
        d, o = self.base.w.shape[1], self.changes.outputs
        count, own = len(self.inputs), self.added * self.kernel.channels
        spread = np.zeros((len(self._z), d, self._z.shape[1], d))
        left = np.zeros((self._z.shape[1], d, self._z.shape[1], d))
        added = self.inputs[: self.added]
        rest = self.kernel(added, added) - self._z[:, :own].T @ self._z[:, :own]
        for i in range(d):
            spread[:, i, :, i] = self._z
            left[:own, i, :own, i] = rest
        cross, _ = lapack.dtrtrs(self.base.factor(penalty), spread.reshape(len(self._z) * d, -1), lower=1)
        system = penalty * (cross.T @ cross) + left.reshape(count * o, count * o)
        blocks = system.reshape(count, o, count, o)
        sign = np.where(np.arange(count) < self.added, penalty, -penalty)
        points = np.arange(count)
        blocks[points, :, points, :] += sign[:, None, None] * self.changes.covariance
        lu, pivots, info = lapack.dgetrf(system)
        if info or not np.isfinite(lu).all():
            raise ValueError(
                f"The via-points contradict each other to working precision, with lambda {penalty:g}. "
                "Give those that are near to others more variance."
            )
        return frozen(cross), (frozen(lu), frozen(pivots))

    @staticmethod
    def _solve(system: tuple[Array, Array], right: Array) -> Array:
        lu, pivots = system
        # SciPy counts the pivots it is given from one while it solves, which threads that share them would see.
        return np.asarray(lapack.dgetrs(lu, pivots.copy(), right)[0])


def _add_information(total: Array, z: Array, precision: Array) -> None:
    """Adds sum_n z_n^T z_n (x) Sigma_n^-1 to (r, D, r, D), with z (n, C, r) and precisions (n, O, O)."""
    n, c, _ = z.shape
    d = total.shape[1]
    blocks = precision.reshape(n, c, d, c, d)

    def along(*outputs: int) -> Array:
        # A A^T is twice as fast as A B, so off the diagonal: 2 a b = (a + b)^2 - a^2 - b^2.
        root = np.linalg.cholesky(sum(blocks[:, :, i, :, j] for i in outputs for j in outputs))  # (n, C, C)
        parts = (np.asarray(sum(z[:, b] * root[:, b, a, None] for b in range(a, c))) for a in range(c))
        return np.asarray(sum((part.T @ part for part in parts), start=np.zeros(())))

    own = [along(i) for i in range(d)]
    for i in range(d):
        total[:, i, :, i] += own[i]
        for j in range(i):
            share = (along(i, j) - own[i] - own[j]) / 2
            total[:, i, :, j] += share
            total[:, j, :, i] += share.T
