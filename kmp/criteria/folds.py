"""Leave-one-out folds: errors on a demonstration, of a primitive learned from the others.

Each fold evaluates many hyper-parameters. The lambdas of one kernel share an eigendecomposition
Sigma^-1/2 K Sigma^-1/2 = V diag(v) V^T, so that (K + lambda Sigma)^-1 = Sigma^-1/2 V diag(1 / (v +
lambda)) V^T Sigma^-1/2; over one input that of the kernel's features, which are fewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.linear_algebra import kron_identity, nearest_positive_semidefinite
from kmp.criteria.errors import rms
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.kernel import Kernel, between
from kmp.low_rank import Features
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import check_resolved

_MOST_FEATURES = 0.25  # more features than this share of the points cost more than they save
_RESIDUAL = 1e-13  # largest residual of the features, as a share of k(s, s): rounding


@dataclass(frozen=True)
class Fold:
    """The reference of all demonstrations but one, and the samples of the one held out."""

    inputs: Array
    reference: Gaussians
    prior_mean: Array
    held_inputs: Array
    held_outputs: Array
    regression_rmse: float

    @cached_property
    def database(self) -> Database:
        """The reference points."""
        return Database(Functionals(self.inputs), self.reference)

    @cached_property
    def inverse_roots(self) -> Array:
        """Sigma^-1/2, the inverse Cholesky factors (N, O, O) of the covariances."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.reference.covariance)))

    @cached_property
    def whitened_target(self) -> Array:
        """Sigma^-1/2 (mu - m): (N O,)."""
        target = (self.reference.mean - self.prior_mean)[:, :, None]
        return np.asarray(self.inverse_roots @ target).ravel()

    def rmses(self, kernel: Kernel, penalties: Sequence[float], outputs: int) -> list[float]:
        """RMSE of the mean on the held-out samples, per penalty; infinite if not solvable.

        Of the first `outputs` only [unit of the outputs].
        """
        rmses = []
        system = _System(self, kernel)
        for penalty in penalties:
            try:
                miss = (system.mean(penalty) - self.held_outputs)[:, :outputs]
                rmses.append(rms(miss))
            except ValueError:  # not solvable to working precision: no candidate
                rmses.append(np.inf)
        return rmses

    def negative_log_likelihoods(
        self, kernel: Kernel, lambda_mean: float, penalties: Sequence[float], outputs: int
    ) -> list[float]:
        """Mean negative log likelihood [nat] of the held-out samples, per lambda_c.

        Of the first `outputs` only; infinite if not solvable.
        """
        system = _System(self, kernel)
        try:
            residual = (self.held_outputs - system.mean(lambda_mean))[:, :outputs]
        except ValueError:
            return [np.inf] * len(penalties)
        losses_nat = []
        for penalty in penalties:
            try:
                covariance = system.covariance(penalty)[:, :outputs, :outputs]
                losses_nat.append(_negative_log_likelihood(residual, covariance))
            except ValueError:
                losses_nat.append(np.inf)
        return losses_nat


@dataclass(frozen=True, eq=False)
class _System:
    """The part shared by all lambdas of a kernel. N points, M held out, O = C D, r features."""

    fold: Fold
    kernel: Kernel

    def mean(self, penalty: float) -> Array:
        """The mean (M, O). Raises ValueError if not solvable, or rounding hides lambda Sigma."""
        self._check(penalty)
        if self._features is not None:
            shrunk = self._pulls / (self._modes[0] + penalty)
            return (self._held_modes @ shrunk).reshape(self._shape) + self.fold.prior_mean
        target = self.fold.reference.mean - self.fold.prior_mean
        total = self._gram.copy()
        count = len(target)
        points = np.arange(count)
        total.reshape(count, -1, count, target.shape[1])[points, :, points, :] += (
            penalty * self.fold.reference.covariance
        )
        factor, info = lapack.dpotrf(total.T, lower=1, overwrite_a=1)
        if info:
            raise ValueError(f"not positive definite to working precision with lambda {penalty:g}")
        weights, _ = lapack.dpotrs(factor, target.reshape(-1, 1), lower=1)
        d = target.shape[1] // self.kernel.channels
        return (
            np.asarray((self._across @ weights.reshape(-1, d)).reshape(self._shape))
            + self.fold.prior_mean
        )

    def covariance(self, penalty: float) -> Array:
        """N / lambda_c (k - k (K + lambda_c Sigma)^-1 k^T) (M, O, O). Raises as `mean` does."""
        self._check(penalty)
        values, _ = self._modes
        modes = self._held_modes.reshape(*self._shape, -1)
        shrunk = 1 / (np.maximum(values, 0.0) + penalty)
        if self._features is None:
            left = self._own
            sign = -1.0
        else:
            left = self._residual
            sign = penalty
        posterior = left + sign * (modes * shrunk) @ modes.transpose(0, 2, 1)
        deviations = np.sqrt(np.diagonal(self._own))
        return nearest_positive_semidefinite(posterior, deviations) * (
            len(self.fold.inputs) / penalty
        )

    def _check(self, penalty: float) -> None:
        matrix = np.zeros((self.fold.reference.outputs, self.fold.inputs.shape[1]))
        parameters = Hyperparameters(self.kernel, penalty, penalty, self.fold.prior_mean, matrix)
        check_resolved(parameters, self.fold.database)

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self.fold.held_inputs), self.fold.reference.outputs

    @property
    def _own(self) -> Array:
        return self._wide(self.kernel.prior_variance)

    def _whitened(self, rows: Array) -> Array:
        """Sigma^-1/2 times rows (N O, J), with the inverse Cholesky factors of the covariances."""
        stacked = rows.reshape(*self.fold.reference.mean.shape, -1)
        return np.asarray(self.fold.inverse_roots @ stacked).reshape(rows.shape)

    @cached_property
    def _features(self) -> Features | None:
        rank = int(_MOST_FEATURES * len(self.fold.inputs))
        points = self.fold.database.functionals
        if rank == 0 or self.fold.inputs.shape[1] > 1:  # with more inputs the rank is too high
            return None
        features, left = Features.of(self.kernel, points, rank=rank, tolerance=_RESIDUAL)
        return features if left <= _RESIDUAL else None

    @cached_property
    def _rows(self) -> Array:
        """Sigma^-1/2 times the features of the points, for each output: (N O, r D)."""
        assert self._features is not None
        z = self._features(self.fold.database.functionals).T.reshape(
            len(self.fold.inputs), self.kernel.channels, -1
        )
        roots = self.fold.inverse_roots.reshape(*self.fold.reference.mean.shape, z.shape[1], -1)
        rows = np.einsum("nocd,ncr->nord", roots, z)
        return np.asarray(rows.reshape(self.fold.reference.mean.size, -1))

    @cached_property
    def _pulls(self) -> Array:
        """V^T z^T Sigma^-1/2 (mu - m) of the features z: (r D,)."""
        return np.asarray(self.fold.whitened_target @ self._rows @ self._modes[1])

    @cached_property
    def _gram(self) -> Array:
        """K (x) I (N O, N O)."""
        points = self.fold.database.functionals
        return self._wide(between(self.kernel, points, points))

    @cached_property
    def _across(self) -> Array:
        """k between the held-out inputs and the points: (M C, N C)."""
        return between(self.kernel, self._held, self.fold.database.functionals)

    @cached_property
    def _modes(self) -> tuple[Array, Array]:
        """Eigenvalues v, vectors V of Sigma^-1/2 K Sigma^-1/2, or of the features' (r D, r D)."""
        if self._features is not None:
            values, vectors, _ = lapack.dsyevd(self._rows.T @ self._rows)
        else:
            half = self._whitened(self._gram)
            values, vectors, _ = lapack.dsyevd(self._whitened(np.ascontiguousarray(half.T)))
        return values, vectors

    @cached_property
    def _held_modes(self) -> Array:
        """k Sigma^-1/2 V of the held-out inputs (M O, N O), or z V of their features (M O, r D)."""
        if self._features is not None:
            vectors = self._modes[1].reshape(self._held_features.shape[1], -1)
            return (self._held_features @ vectors).reshape(-1, len(self._modes[0]))
        across = self._whitened(np.ascontiguousarray(self._wide(self._across).T))
        return np.asarray(across.T @ self._modes[1])

    @cached_property
    def _residual(self) -> Array:
        """The residual of the features at the held-out inputs: (M, O, O)."""
        z = self._held_features.reshape(len(self._held), self.kernel.channels, -1)
        return self._wide(self.kernel.prior_variance - z @ z.mT)

    @cached_property
    def _held_features(self) -> Array:
        """z of the held-out inputs: (M C, r)."""
        assert self._features is not None
        return np.ascontiguousarray(self._features(self._held).T)

    @property
    def _held(self) -> Functionals:
        return Functionals(self.fold.held_inputs)

    def _wide(self, matrix: Array) -> Array:
        """x (x) I of a matrix over channels, with I of size D."""
        return kron_identity(matrix, self.fold.reference.outputs // self.kernel.channels)


def _negative_log_likelihood(residual: Array, covariance: Array) -> float:
    """Mean of -log N(r_t; 0, Sigma_t) [nat], of residuals r (T, O), covariances (T, O, O)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, residual[:, :, None])[:, :, 0]
    log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return float(
        0.5 * (log_det + (white**2).sum(axis=1) + residual.shape[1] * np.log(2 * np.pi)).mean()
    )
