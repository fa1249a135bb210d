"""Hyper-parameters of the greatest marginal likelihood of a reference, with one ell per input.

mu ~ N(m, s^2 G) with G = K + lambda Sigma: -log p = (log det G + n (1 + log 2 pi s^2)) / 2 for the
likeliest s^2 = (mu - m)^T G^-1 (mu - m) / n, n = N O. Rasmussen and Williams 2006, section
5.1 (automatic relevance determination).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from kmp.arrays.checks import Array
from kmp.dense import Dense
from kmp.kernel import Kernel
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.radial import GaussianKernel
from kmp.time_kernels import VelocityKernel

_STARTS = (0.1, 1.0, 10.0)  # factors on the initial ell, as the likelihood has several maxima
_LAMBDA = 1e-2  # initial lambda times the mean variance of the reference
# log ell / initial ell: the input has no effect, or every effect
_ELL_BOUNDS = (np.log(1e-6), np.log(1e4))
_LAMBDA_BOUNDS = np.log(1e-7), np.log(1e3)  # log lambda / initial lambda: rounding limits it
_UNLIKELY = 1e12  # [nat] value without a Cholesky factor, from which the search turns back


class MostLikely(NamedTuple):
    """The hyper-parameters of the greatest likelihood."""

    kernel: Kernel
    lambda_mean: float
    signal_variance: float
    """s^2 [unit of the outputs^2]."""


def most_likely(
    points: Database,
    prior_mean: Array,
    kernel: Kernel,
    lambda_mean: float | None,
    *,
    free: Literal["each", "one", "none"],
) -> MostLikely:
    """The hyper-parameters of the greatest marginal likelihood; `kernel` has the initial ell.

    `free`: "each" ell of the kernel, "one" common factor of all, or "none". A given lambda is kept.
    Raises ValueError if no parameters can be solved for.
    """
    from scipy.optimize import minimize  # its import takes a quarter of a second

    first = np.log(np.atleast_1d(np.asarray(kernel.ell, dtype=np.float64)))
    variance = (
        np.trace(points.reference.covariance, axis1=1, axis2=2).mean() / points.reference.outputs
    )
    penalty = np.log(lambda_mean or _LAMBDA / variance)
    lengths = {"each": len(first), "one": 1, "none": 0}[free]

    def parameters(x: Array) -> tuple[Kernel, float]:
        scaled = with_ell(kernel, np.exp(first + x[:lengths])) if lengths else kernel
        return scaled, lambda_mean or float(np.exp(penalty + x[lengths]))

    def target(x: Array) -> float:
        likelihood = negative_log_likelihood(points, prior_mean, *parameters(x))
        return _UNLIKELY if likelihood is None else likelihood[0]

    bounds = [_ELL_BOUNDS] * lengths + ([_LAMBDA_BOUNDS] if lambda_mean is None else [])
    best = np.zeros(len(bounds))
    least = np.inf
    for start in _STARTS if lengths else _STARTS[1:2]:
        x = np.zeros(len(bounds))
        x[:lengths] = np.log(start)
        if bounds:
            x = minimize(target, x, jac="3-point", method="L-BFGS-B", bounds=bounds).x
        value = target(x)
        best, least = (x, value) if value < least else (best, least)
    likeliest, other = parameters(best)
    likelihood = negative_log_likelihood(points, prior_mean, likeliest, other)
    if likelihood is None:
        raise ValueError(
            "criterion: no likelihood to working precision. Give kernel and lambda_mean, or more "
            "regularization."
        )
    return MostLikely(likeliest, other, likelihood[1])


def negative_log_likelihood(
    points: Database, prior_mean: Array, kernel: Kernel, lambda_mean: float
) -> tuple[float, float] | None:
    """-log p [nat] of the reference's means, and the likeliest s^2.

    None if K + lambda Sigma is not positive definite.
    """
    inputs = points.inputs.shape[1]
    parameters = Hyperparameters.checked(
        kernel, lambda_mean, None, prior_mean, inputs=inputs, outputs=len(prior_mean)
    )
    solution = Dense(parameters, points)
    try:
        factor = solution.mean_factor
    except ValueError:
        return None
    residual = (points.reference.mean - prior_mean).ravel()
    signal = float(residual @ solution.weights.ravel()) / len(residual)
    if not signal > 0:
        return None
    log_det = 2 * np.log(np.diagonal(factor)).sum() * (len(residual) / len(factor))
    return float(0.5 * (log_det + len(residual) * (1 + np.log(2 * np.pi * signal)))), signal


def with_ell(kernel: Kernel, ell: Array) -> Kernel:
    """A kernel of the same class with other ell (I,), or (1,)."""
    return VelocityKernel(float(ell[0])) if type(kernel) is VelocityKernel else GaussianKernel(ell)
