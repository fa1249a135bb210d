"""What is learned from all demonstrations but one, and how well it predicts that one.

A fold is asked for many hyper-parameters. All lambdas of one kernel share what does not depend on
them: for the mean of one input the features of the kernel, which are few; for the covariance one
eigendecomposition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from kmp.checks import Array
from kmp.cross_validation import rms
from kmp.database import Database
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.hyperparameters import Hyperparameters
from kmp.kernel import Kernel, between
from kmp.linear_algebra import kron_identity, nearest_positive_semidefinite
from kmp.low_rank import Features
from kmp.primitive import KMP
from kmp.solution import check_resolved

_FEW = 0.25  # of the points: more features than that cost more than they save
_LEFT = 1e-13  # of k(s, s), that the features may leave: rounding


@dataclass(frozen=True)
class Fold:
    """What is learned from all demonstrations but one, and the points of that one."""

    inputs: Array
    reference: Gaussians
    prior_mean: Array
    held_inputs: Array
    held_outputs: Array
    regression_rmse: float

    def fitted(self, kernel: Kernel, lambda_mean: float, lambda_covariance: float | None) -> KMP:
        """The primitive."""
        return KMP.fit(
            self.inputs,
            self.reference,
            kernel=kernel,
            lambda_mean=lambda_mean,
            lambda_covariance=lambda_covariance,
            prior_mean=self.prior_mean,
        )

    def rmses(self, kernel: Kernel, penalties: Sequence[float], outputs: int) -> list[float]:
        """Of the mean at what is held out, the first outputs alone; infinite where unsolvable."""
        found = []
        system = _System(self, kernel)
        for penalty in penalties:
            try:
                miss = (system.mean(penalty) - self.held_outputs)[:, :outputs]
                found.append(rms(miss))
            except ValueError:  # not solvable to working precision: no candidate
                found.append(np.inf)
        return found

    def negative_log_likelihoods(
        self, kernel: Kernel, lambda_mean: float, penalties: Sequence[float], outputs: int
    ) -> list[float]:
        """Of what is held out, with these lambdas of the covariance; infinite where unsolvable."""
        system = _System(self, kernel)
        try:
            residual = (self.held_outputs - system.mean(lambda_mean))[:, :outputs]
        except ValueError:
            return [np.inf] * len(penalties)
        found = []
        for penalty in penalties:
            try:
                covariance = system.covariance(penalty)[:, :outputs, :outputs]
                found.append(_negative_log_likelihood(residual, covariance))
            except ValueError:
                found.append(np.inf)
        return found


@dataclass(frozen=True, eq=False)
class _System:
    """What all lambdas of one kernel share. N points, M held out, O = C D outputs, r features."""

    fold: Fold
    kernel: Kernel

    def mean(self, penalty: float) -> Array:
        """(M, O). Raises ValueError where rounding hides lambda Sigma, or there is no solution."""
        self._check(penalty)
        target = self.fold.reference.mean - self.fold.prior_mean
        if self._features is not None:
            values, vectors = self._modes
            pulls = self._whitened(target.reshape(-1, 1))[:, 0] @ self._rows @ vectors
            return np.asarray((self._asked_modes @ (pulls / (values + penalty))).reshape(self._shape)) + (
                self.fold.prior_mean
            )
        total, count = self._gram.copy(), len(target)
        points = np.arange(count)
        total.reshape(count, -1, count, target.shape[1])[points, :, points, :] += (
            penalty * self.fold.reference.covariance
        )
        factor, info = lapack.dpotrf(total.T, lower=1, overwrite_a=1)
        if info:
            raise ValueError(f"not positive definite to working precision with lambda {penalty:g}")
        weights, _ = lapack.dpotrs(factor, target.reshape(-1, 1), lower=1)
        d = target.shape[1] // self.kernel.channels
        return np.asarray((self._across @ weights.reshape(-1, d)).reshape(self._shape)) + self.fold.prior_mean

    def covariance(self, penalty: float) -> Array:
        """(M, O, O) N / lambda_c (k - k (K + lambda_c Sigma)^-1 k^T). Raises as `mean` does."""
        self._check(penalty)
        values, _ = self._modes
        modes = self._asked_modes.reshape(*self._shape, -1)
        shrunk = 1 / (np.maximum(values, 0.0) + penalty)
        if self._features is None:
            left, sign = self._own, -1.0
        else:
            left, sign = self._residual, penalty
        posterior = left + sign * (modes * shrunk) @ modes.transpose(0, 2, 1)
        return nearest_positive_semidefinite(posterior) * (len(self.fold.inputs) / penalty)

    def _check(self, penalty: float) -> None:
        parameters = Hyperparameters(self.kernel, penalty, penalty, self.fold.prior_mean)
        check_resolved(parameters, Database(Functionals(self.fold.inputs), self.fold.reference))

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self.fold.held_inputs), self.fold.reference.outputs

    @property
    def _own(self) -> Array:
        return kron_identity(self.kernel.prior_variance, self.fold.reference.outputs // self.kernel.channels)

    def _whitened(self, rows: Array) -> Array:
        """Rows (N O, J) times the inverse roots of the points' covariances."""
        stacked = rows.reshape(*self.fold.reference.mean.shape, -1)
        return np.asarray(self._inverse_roots @ stacked).reshape(rows.shape)

    @cached_property
    def _inverse_roots(self) -> Array:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.fold.reference.covariance)))

    @cached_property
    def _features(self) -> Features | None:
        rank, points = int(_FEW * len(self.fold.inputs)), Functionals(self.fold.inputs)
        if rank == 0 or self.fold.inputs.shape[1] > 1:  # in more dimensions there are too many
            return None
        found, left = Features.of(self.kernel, points, rank=rank, tolerance=_LEFT)
        return found if left <= _LEFT else None

    @cached_property
    def _rows(self) -> Array:
        """The features of the points, for each output, whitened: (N O, r D)."""
        assert self._features is not None
        return self._whitened(self._wide(self._features(Functionals(self.fold.inputs)).T))

    @cached_property
    def _gram(self) -> Array:
        """K (x) I (N O, N O)."""
        points = Functionals(self.fold.inputs)
        return self._wide(between(self.kernel, points, points))

    @cached_property
    def _across(self) -> Array:
        """k of what is held out and the points: (M C, N C)."""
        return between(self.kernel, Functionals(self.fold.held_inputs), Functionals(self.fold.inputs))

    @cached_property
    def _modes(self) -> tuple[Array, Array]:
        """Eigenvalues and vectors of the whitened K (N O, N O), or of the features' (r D, r D)."""
        if self._features is not None:
            values, vectors, _ = lapack.dsyevd(self._rows.T @ self._rows)
        else:
            half = self._whitened(self._gram)
            values, vectors, _ = lapack.dsyevd(self._whitened(np.ascontiguousarray(half.T)))
        return values, vectors

    @cached_property
    def _asked_modes(self) -> Array:
        """What is held out, along the modes: (M O, N O) or (M O, r D)."""
        if self._features is not None:
            return np.asarray(self._wide(self._features(Functionals(self.fold.held_inputs)).T) @ self._modes[1])
        across = self._whitened(np.ascontiguousarray(self._wide(self._across).T))
        return np.asarray(across.T @ self._modes[1])

    @cached_property
    def _residual(self) -> Array:
        """What the features leave of k(s, s) at what is held out: (M, O, O)."""
        assert self._features is not None
        z = self._features(Functionals(self.fold.held_inputs)).T.reshape(len(self.fold.held_inputs), -1, self._rank)
        d = self.fold.reference.outputs // self.kernel.channels
        return kron_identity(self.kernel.prior_variance - z @ z.transpose(0, 2, 1), d)

    @property
    def _rank(self) -> int:
        assert self._features is not None
        return len(self._features.pivots)

    def _wide(self, matrix: Array) -> Array:
        """x (x) I of size D, of the rows and columns of channels."""
        d = self.fold.reference.outputs // self.kernel.channels
        wide = np.zeros((len(matrix), d, matrix.shape[1], d))
        for i in range(d):
            wide[:, i, :, i] = matrix
        return wide.reshape(len(matrix) * d, -1)


def _negative_log_likelihood(residual: Array, covariance: Array) -> float:
    """The mean over T points [nat]: residuals (T, O), covariances (T, O, O)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, residual[:, :, None])[:, :, 0]
    log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return float(0.5 * (log_det + (white**2).sum(axis=1) + residual.shape[1] * np.log(2 * np.pi)).mean())
