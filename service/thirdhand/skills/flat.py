"""Constant orientations and undecided grippers as primitives, which via-points adapt."""

from __future__ import annotations

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians
from kmp.kernel import Kernel
from thirdhand.core.frame import Vector
from thirdhand.core.skill.pose import LearnedGripper, LearnedOrientation

UNDECIDED = 0.5  # closure far from all data, where a gripper stays as it is
POINT_NOISE = 0.1  # variance of a point / variance of the kernel
DEVIATION = 0.2  # standard deviation far from all data, of zeta [rad] or of the closure


def flat_orientation(
    skill_inputs: Vector, kernel: Kernel, orientation: Vector
) -> LearnedOrientation:
    """The constant orientation (4,) as a primitive over inputs (N, I), for via-points."""
    inputs = skill_inputs[:: max(1, len(skill_inputs) // 200)]
    zeta = np.zeros((len(inputs), 3))
    return LearnedOrientation(
        even(inputs, zeta, kernel, np.zeros(3)), np.asarray(orientation, np.float64)
    )


def flat_gripper(skill_inputs: Vector, *, ell: float) -> LearnedGripper:
    """A gripper that is undecided everywhere, for via-points."""
    prior = np.array([UNDECIDED])
    return LearnedGripper(even(skill_inputs[:1], prior[None], GaussianKernel(ell), prior))


def is_flat(primitive: KMP) -> bool:
    """True if the primitive is constant, but for its via-points."""
    prior = primitive.inner.solution.hyperparameters.prior_offset
    return bool((primitive.base.reference.mean == prior).all())


def even(inputs: Vector, outputs: Vector, kernel: Kernel, prior: Vector) -> KMP:
    """A primitive of equally exact points: N / lambda_c = DEVIATION² and
    lambda_c Sigma = POINT_NOISE I.
    """
    width = outputs.shape[1]
    scale = len(inputs) / DEVIATION**2
    covariance = np.tile(POINT_NOISE / scale * np.eye(width), (len(inputs), 1, 1))
    return KMP.fit(
        inputs,
        Gaussians(outputs, covariance),
        kernel=kernel,
        lambda_mean=scale,
        lambda_covariance=scale,
        prior_mean=prior,
    )
