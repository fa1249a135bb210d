"""Hyper-parameters of a primitive: kernel, lambda, lambda_c, prior mean and covariance.

The prior mean m(s) = A s + b is subtracted before fitting and added to predictions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, brief, check_shape, numbers, positive, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import kron_identity
from kmp.functionals import Functionals
from kmp.gaussians import covariances
from kmp.kernel import Kernel, checked_kernel


@dataclass(frozen=True, eq=False, repr=False)
class AffineMean(Immutable):
    """The prior mean A s + b at an input s (I,): a linear regression, or a line over time.

    matrix A (O, I) [unit of the outputs / unit of the inputs], offset b (O,) [unit of the outputs].
    Read-only. Far from the data the primitive's mean extrapolates along it. Raises ValueError if
    shapes do not agree or a number is not finite.
    """

    matrix: Array
    offset: Array

    def __post_init__(self) -> None:
        matrix = numbers("prior_mean.matrix", self.matrix, "O", "I")
        offset = numbers("prior_mean.offset", self.offset, "O")
        if len(matrix) != len(offset):
            raise ValueError(
                f"prior_mean: matrix of shape {matrix.shape} and offset of shape {offset.shape} "
                "given, (O, I) and (O,) needed."
            )
        self.__dict__.update(matrix=matrix, offset=offset)


@dataclass(frozen=True, eq=False, repr=False)
class Hyperparameters(Immutable):
    """Parameters of the costs: equation (4) for the mean, IJRR 2019 for the covariance."""

    kernel: Kernel
    lambda_mean: float
    lambda_covariance: float
    prior_offset: Array  # (O,) [unit of the outputs]
    prior_matrix: Array  # (O, I), zero unless the prior mean is affine
    # B (D, D) [unit of the outputs^2] of the outputs of a channel; None: the identity
    prior_covariance: Array | None = None

    @classmethod
    def checked(
        cls,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None,
        prior_mean: ArrayLike | AffineMean | None,
        prior_covariance: ArrayLike | None = None,
        *,
        inputs: int,
        outputs: int,
    ) -> Hyperparameters:
        """The parameters with defaults filled in. Raises ValueError if they do not fit I and O."""
        checked_kernel(kernel).check(inputs, outputs)
        penalty = positive("lambda_mean", lambda_mean)
        other = (
            penalty
            if lambda_covariance is None
            else positive("lambda_covariance", lambda_covariance)
        )
        if isinstance(prior_mean, AffineMean):
            check_shape("prior_mean.matrix", prior_mean.matrix, outputs, inputs)
            matrix = prior_mean.matrix
            offset = prior_mean.offset
            if kernel.period is not None and matrix.any():
                raise ValueError(
                    "prior_mean: a slope given, which no periodic motion has. Give an offset (O,) "
                    "alone."
                )
        else:
            matrix = frozen(np.zeros((outputs, inputs)))
            offset = frozen(np.zeros(outputs))
            if prior_mean is not None:
                offset = numbers("prior_mean", prior_mean, outputs)
        values = outputs // kernel.channels
        if kernel.channels > 1:
            slopes = matrix[:values, 0]
            if not np.array_equal(rates := offset[values:], slopes) or matrix[values:].any():
                raise ValueError(
                    f"prior_mean: rates of {brief(rates)} given, {brief(slopes)} needed: those of "
                    "the values' prior mean."
                )
        return cls(kernel, penalty, other, offset, matrix, _covariance(prior_covariance, values))

    @cached_property
    def prior_variances(self) -> Array:
        """(D,) [unit of the outputs^2] by which a variance counts as lost in rounding, which that
        of an output's prior is times the largest eigenvalue of their correlations.
        """
        if self.prior_covariance is None:
            return np.ones(self.channel_outputs)
        variances = np.diagonal(self.prior_covariance)
        correlation = self.prior_covariance / np.sqrt(np.outer(variances, variances))
        return np.asarray(variances * np.linalg.eigvalsh(correlation)[-1])

    @cached_property
    def prior_deviations(self) -> Array:
        """(O,) [unit of the outputs] the roots of k(s, s) (x) B's diagonal."""
        variances = np.diagonal(self.over_outputs(self.kernel.prior_variance))
        return frozen(np.sqrt(variances))

    def over_outputs(self, blocks: Array) -> Array:
        """x (x) B of blocks (..., C, C): (..., O, O)."""
        wide = kron_identity(blocks, self.channel_outputs)
        if self.prior_covariance is None:
            return wide
        return np.asarray(wide @ np.kron(np.eye(self.kernel.channels), self.prior_covariance))

    @property
    def prior_mean(self) -> Array | AffineMean:
        """(O,) [unit of the outputs], or an `AffineMean` that depends on the input."""
        if not self.prior_matrix.any():
            return self.prior_offset
        return AffineMean(self.prior_matrix, self.prior_offset)

    @cached_property
    def prior_columns(self) -> Array:
        """The offset and the matrix side by side (O, 1 + I)."""
        return frozen(np.hstack([self.prior_offset[:, None], self.prior_matrix]))

    def prior_at(self, points: Functionals) -> Array:
        """The prior mean (N, O) of N functionals. A derivative along v has A v."""
        if points.directions is None:
            return np.asarray(points.inputs @ self.prior_matrix.T + self.prior_offset)
        values = points.values[:, None]
        moved = np.where(values, points.inputs, points.along)
        return np.asarray(moved @ self.prior_matrix.T + values * self.prior_offset)

    @property
    def outputs(self) -> int:
        """O."""
        return len(self.prior_offset)

    @property
    def channel_outputs(self) -> int:
        """D, the outputs of each of the kernel's C channels: O = C D."""
        return len(self.prior_offset) // self.kernel.channels


def _covariance(value: ArrayLike | None, outputs: int) -> Array | None:
    """B (D, D) of variances (D,) or of a covariance; None if it is the identity."""
    if value is None:
        return None
    array = real("prior_covariance", value)
    matrix = np.diag(numbers("prior_covariance", array, outputs)) if array.ndim == 1 else array
    covariance = covariances("prior_covariance", np.asarray(matrix)[None], 1, outputs)[0]
    return None if np.array_equal(covariance, np.eye(outputs)) else covariance
