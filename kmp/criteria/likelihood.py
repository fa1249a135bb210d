"""Hyper-parameters of the greatest marginal likelihood of a reference, with one ell per input.

mu ~ N(m, s^2 G) with G = K + lambda Sigma: -log p = (log det G + n (1 + log 2 pi s^2)) / 2 for the
likeliest s^2 = (mu - m)^T G^-1 (mu - m) / n, n = N O. Rasmussen and Williams 2006, sections 5.1
(automatic relevance determination) and 5.4.1 (gradient).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.linear_algebra import kron_identity
from kmp.kernel import Kernel, between
from kmp.problem.database import Database
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
        ell = np.exp(first + x[:lengths]) if lengths else np.exp(first)
        return with_ell(kernel, ell) if lengths else kernel, lambda_mean or float(
            np.exp(penalty + x[lengths])
        )

    def target(x: Array) -> tuple[float, Array]:
        likelihood = negative_log_likelihood(points, prior_mean, *parameters(x))
        if likelihood is None:
            return _UNLIKELY, np.zeros(len(x))
        value, gradient, _ = likelihood
        of_lengths = gradient[:-1] if free == "each" else gradient[:-1].sum(keepdims=True)
        return value, np.concatenate(
            [of_lengths[:lengths], gradient[-1:] if lambda_mean is None else []]
        )

    bounds = [_ELL_BOUNDS] * lengths + ([_LAMBDA_BOUNDS] if lambda_mean is None else [])
    best = np.zeros(len(bounds))
    least = np.inf
    for start in _STARTS if lengths else _STARTS[1:2]:
        x = np.zeros(len(bounds))
        x[:lengths] = np.log(start)
        if bounds:
            x = minimize(target, x, jac=True, method="L-BFGS-B", bounds=bounds).x
        value, _ = target(x)
        best, least = (x, value) if value < least else (best, least)
    likeliest, other = parameters(best)
    likelihood = negative_log_likelihood(points, prior_mean, likeliest, other)
    if likelihood is None:
        raise ValueError(
            "criterion: no likelihood to working precision. Give kernel and lambda_mean, or more "
            "regularization."
        )
    return MostLikely(likeliest, other, likelihood[2])


def negative_log_likelihood(
    points: Database, prior_mean: Array, kernel: Kernel, lambda_mean: float
) -> tuple[float, Array, float] | None:
    """-log p [nat] of the reference's means, its gradient, and the likeliest s^2.

    The gradient (I + 1,) is by the log of each ell and by log lambda; (2,) with one ell for all
    inputs. None if K + lambda Sigma is not positive definite.
    """
    reference = points.reference
    c = kernel.channels
    count, outputs = reference.mean.shape
    d = outputs // c
    every = np.arange(count)
    k = between(kernel, points.functionals, points.functionals)
    total = kron_identity(k, d)
    total.reshape(count, outputs, count, outputs)[every, :, every, :] += (
        lambda_mean * reference.covariance
    )
    factor, info = lapack.dpotrf(total.T, lower=1, clean=1, overwrite_a=1)
    residual = (reference.mean - prior_mean).ravel()
    weights = lapack.dpotrs(factor, residual, lower=1)[0]
    signal = float(residual @ weights) / len(residual)
    if info or not signal > 0:
        return None
    log_det = 2 * np.log(np.diagonal(factor)).sum()
    value = 0.5 * (log_det + len(residual) * (1 + np.log(2 * np.pi * signal)))
    lower = lapack.dpotri(factor, lower=1)[0]
    inverse = np.tril(lower) + np.tril(lower, -1).T
    pull = (inverse - np.outer(weights, weights) / signal).reshape(count * c, d, count * c, d)
    shared = np.einsum("idjd->ij", pull)  # twice the derivative of -log p by each entry of K
    by_lengths = [
        0.5 * float((shared * derivative).sum())
        for derivative in _by_log_ell(kernel, points.inputs, k)
    ]
    diagonal_blocks = pull.reshape(count, outputs, count, outputs)[every, :, every, :]
    by_lambda = 0.5 * lambda_mean * float((diagonal_blocks * reference.covariance).sum())
    return float(value), np.array([*by_lengths, by_lambda]), signal


def with_ell(kernel: Kernel, ell: Array) -> Kernel:
    """A kernel of the same class with other ell (I,), or (1,)."""
    return VelocityKernel(float(ell[0])) if type(kernel) is VelocityKernel else GaussianKernel(ell)


def _by_log_ell(kernel: Kernel, inputs: Array, k: Array) -> Iterator[Array]:
    """dK / d log ell (N C, N C) for each ell."""
    ell = np.atleast_1d(np.asarray(kernel.ell, dtype=np.float64))
    if type(kernel) is GaussianKernel:
        columns = inputs.T[:, :, None] if len(ell) > 1 or inputs.shape[1] == 1 else inputs[None]
        for value, column in zip(ell, columns, strict=True):
            yield -value * ((column[:, None] - column[None]) ** 2).sum(axis=2) * k
    elif type(kernel) is VelocityKernel:
        r = inputs - inputs.T
        squares = ell[0] * r * r
        blocks = k.reshape(len(r), 2, len(r), 2).copy()
        value = blocks[:, 0, :, 0].copy()
        blocks[:, 0, :, 0] *= -squares
        blocks[:, 0, :, 1] *= 1 - squares
        blocks[:, 1, :, 0] *= 1 - squares
        # The rates' block is (2 ell - 4 ell^2 r^2) k.
        blocks[:, 1, :, 1] = ell[0] * (2 - 8 * squares) * value - squares * blocks[:, 1, :, 1]
        yield blocks.reshape(k.shape)
