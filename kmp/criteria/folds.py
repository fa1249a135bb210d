"""Leave-one-out folds: errors on a demonstration, of a primitive learned from the others.

Each fold evaluates many hyper-parameters; over one input, by the features of the kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kmp.arrays.checks import Array
from kmp.arrays.linear_algebra import nearest_positive_semidefinite
from kmp.criteria.errors import rms
from kmp.dense import Dense
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.kernel import Kernel, between
from kmp.low_rank import Features, LowRank
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import mean_at

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
    """The solutions with one kernel. N points, M held out, O outputs."""

    fold: Fold
    kernel: Kernel

    def mean(self, penalty: float) -> Array:
        """The mean (M, O). Raises ValueError if not solvable, or rounding hides lambda Sigma."""
        return mean_at(self._solution(penalty), self.fold.held_inputs)

    def covariance(self, penalty: float) -> Array:
        """N / lambda_c (k - k (K + lambda_c Sigma)^-1 k^T) (M, O, O). Raises as `mean` does."""
        solution = self._solution(penalty)
        held = Functionals(self.fold.held_inputs)
        rows = between(self.kernel, held, solution.functionals)
        posterior = solution.posterior_covariance(rows, self.kernel.prior_variance)
        deviations = solution.hyperparameters.prior_deviations
        scale = len(self.fold.inputs) / penalty
        return nearest_positive_semidefinite(posterior, deviations) * scale

    def _solution(self, penalty: float) -> Dense | LowRank:
        database = self.fold.database
        parameters = Hyperparameters.checked(
            self.kernel,
            penalty,
            None,
            self.fold.prior_mean,
            inputs=database.inputs.shape[1],
            outputs=database.reference.outputs,
        )
        if self._features is None:
            return Dense(parameters, database).solved()
        return LowRank.fit(parameters, database, self._features)

    @cached_property
    def _features(self) -> Features | None:
        """The features of the points, where they are few."""
        rank = int(_MOST_FEATURES * len(self.fold.inputs))
        points = self.fold.database.functionals
        if rank == 0 or self.fold.inputs.shape[1] > 1:  # with more inputs the rank is too high
            return None
        features, left = Features.of(self.kernel, points, rank=rank, tolerance=_RESIDUAL)
        return features if left <= _RESIDUAL else None


def _negative_log_likelihood(residual: Array, covariance: Array) -> float:
    """Mean of -log N(r_t; 0, Sigma_t) [nat], of residuals r (T, O), covariances (T, O, O)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, residual[:, :, None])[:, :, 0]
    log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return float(
        0.5 * (log_det + (white**2).sum(axis=1) + residual.shape[1] * np.log(2 * np.pi)).mean()
    )
