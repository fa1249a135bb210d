"""What is asked of a solution besides the database: the penalties, and what the mean returns to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.checks import Array, numbers, positive
from kmp.gaussians import Gaussians, check_pairs
from kmp.immutable import Immutable
from kmp.kernel import Kernel


@dataclass(frozen=True, eq=False)
class Problem(Immutable):
    """The parameters of the costs: equation (4) for the mean, IJRR 2019 for the covariance."""

    lambda_mean: float
    lambda_covariance: float
    prior_mean: Array
    """(O,) [unit of the outputs]"""

    @classmethod
    def of(
        cls,
        inputs: Array,
        reference: Gaussians,
        kernel: Kernel,
        *,
        lambda_mean: float,
        lambda_covariance: float | None,
        prior_mean: ArrayLike | None,
    ) -> Problem:
        """The parameters, checked against the database and the kernel that they go with."""
        outputs = reference.outputs
        check_pairs(inputs, reference, outputs)
        kernel.check(inputs.shape[1], outputs)
        penalty = positive("lambda_mean", lambda_mean)
        other = penalty if lambda_covariance is None else positive("lambda_covariance", lambda_covariance)
        prior = numbers("prior_mean", np.zeros(outputs) if prior_mean is None else prior_mean, outputs)
        if kernel.channels > 1 and (rates := prior[outputs // kernel.channels :]).any():
            raise ValueError(f"prior_mean: rates of {rates} given; the rate of a constant is 0.")
        return cls(penalty, other, prior)
