"""What is chosen when a primitive is fitted: the kernel, the penalties, the prior mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.checks import Array, numbers, positive
from kmp.immutable import Immutable
from kmp.kernel import Kernel


@dataclass(frozen=True, eq=False, repr=False)
class Hyperparameters(Immutable):
    """The parameters of the costs: equation (4) for the mean, IJRR 2019 for the covariance."""

    kernel: Kernel
    lambda_mean: float
    lambda_covariance: float
    prior_mean: Array  # (O,) [unit of the outputs]

    @classmethod
    def checked(
        cls,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None,
        prior_mean: ArrayLike | None,
        *,
        inputs: int,
        outputs: int,
    ) -> Hyperparameters:
        """The parameters, or their defaults. Raises ValueError if they do not go with I and O."""
        checked_kernel(kernel).check(inputs, outputs)
        penalty = positive("lambda_mean", lambda_mean)
        other = penalty if lambda_covariance is None else positive("lambda_covariance", lambda_covariance)
        prior = numbers("prior_mean", np.zeros(outputs) if prior_mean is None else prior_mean, outputs)
        if kernel.channels > 1 and (rates := prior[outputs // kernel.channels :]).any():
            raise ValueError(f"prior_mean: rates of {rates} given; the rate of a constant is 0.")
        return cls(kernel, penalty, other, prior)

    @property
    def outputs(self) -> int:
        """O."""
        return len(self.prior_mean)

    @property
    def channel_outputs(self) -> int:
        """D, the outputs of each of the kernel's C channels: O = C D."""
        return len(self.prior_mean) // self.kernel.channels


def checked_kernel(kernel: Kernel) -> Kernel:
    """The kernel. Raises ValueError unless it is one."""
    if isinstance(kernel, type) or not hasattr(kernel, "prior_variance"):
        raise ValueError(f"kernel: {kernel!r} given, a kernel needed: GaussianKernel(ell=8.0), for one.")
    return kernel
