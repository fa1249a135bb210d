"""The reference by Gaussian process regression, for inputs of many dimensions.

Each output o is a process of kernel c exp(-sum_i (s_i - s'_i)^2 / (2 l_i^2)) + noise, with
mu = k (K + noise I)^-1 y (Rasmussen and Williams 2006, algorithm 2.1). With the inverse P of its
matrix, the error of samples h held out is P_hh^-1 (P y)_h, of covariance P_hh^-1 (section 5.4.2).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import (
    Array,
    check_finite,
    check_some,
    checked_demonstrations,
    numbers,
    positive,
    whole,
)
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, covariances
from kmp.mixture import deviations, one_thread

_SIGNAL = 1e-3, 1e3  # bounds of the function's variance over the variance of the output
_LENGTH = 1e-2, 1e3  # bounds of a length over the deviation of the input
_NOISE = 1e-6, 1e1  # bounds of the noise's variance over the variance of the output
# factors on the likeliest lengths, evaluated on held-out demonstrations
_LONGER = (1.0, 1.5, 2.5, 4.0)
_NOISES = 1e-6, 1e-4, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0  # noises, evaluated in the same way


def gaussian_process_reference(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
    inputs: ArrayLike,
    *,
    count: int = 400,
    regularization: float = 1e-6,
) -> Gaussians:
    """The reference at inputs (N, I) of demonstrations, each inputs (T, I), outputs (T, O).

    For inputs of many dimensions, where a mixture would need more components than the samples can
    determine. Choose `inputs` among those of the demonstrations. Each output is a Gaussian process
    of its own, with a squared exponential kernel of one length per input, and noise. They have the
    greatest likelihood on at most `count` samples, evenly spaced.

    That likelihood assumes independent errors, but the samples of one demonstration err together.
    So longer lengths and other noises are evaluated too, and those are taken under which each
    demonstration is likeliest given the others. The mean square of these errors, in their
    deviations, scales the covariance and gives the correlations between outputs; one demonstration
    alone gives neither. `regularization` [unit^2] is added to the covariance's diagonal.

    Raises ValueError if shapes do not agree, a number is not finite, there is no sample, or a
    parameter is out of its range.
    """
    data = checked_demonstrations(demonstrations)
    where = numbers("inputs", inputs, "N", data[0][0].shape[1])
    check_some("inputs", where)
    most = max(1, whole("count", count) // len(data))
    added = positive("regularization", regularization)
    chosen = [np.linspace(0, len(s) - 1, min(most, len(s))).astype(int) for s, _ in data]
    of = np.repeat(np.arange(len(data)), [len(rows) for rows in chosen])
    s, y = (
        np.concatenate([part[i][rows] for part, rows in zip(data, chosen, strict=True)])
        for i in (0, 1)
    )
    check_finite("demonstrations", s.std(axis=0), "too large for their deviation:")
    check_finite("demonstrations", y.std(axis=0), "too large for their deviation:")
    scale = deviations(s)
    size = deviations(y)
    centre = y.mean(axis=0)
    s = s / scale
    queries = where / scale
    check_finite("inputs", queries, "over the demonstrations' deviation:")
    processes = [_process(s, column, of, queries) for column in ((y - centre) / size).T]
    mean, deviation, errors = (np.stack(parts, axis=1) for parts in zip(*processes, strict=True))
    scaled = deviation * size
    correlation = errors.T @ errors / len(errors) if len(data) > 1 else np.eye(len(centre))
    covariance = scaled[:, :, None] * correlation * scaled[:, None, :] + added * np.eye(len(centre))
    return Gaussians(
        mean * size + centre,
        covariances("regularization: covariance", symmetric(covariance), *mean.shape),
    )


def _process(
    s: Array, y: Array, of: NDArray[np.intp], queries: Array
) -> tuple[Array, Array, Array]:
    """Mean and deviation (N,) at inputs `queries` (N, I); left-out errors (M,) in their deviations.

    From samples s (M, I) and y (M,) of the demonstrations with the numbers `of` (M,).
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    count = s.shape[1]
    kernel = ConstantKernel(1.0, _SIGNAL) * RBF(
        np.full(count, np.sqrt(count)), _LENGTH
    ) + WhiteKernel(0.01, _NOISE)
    with warnings.catch_warnings(), one_thread():
        # an input without effect has no finite length
        warnings.simplefilter("ignore", ConvergenceWarning)
        likeliest = GaussianProcessRegressor(kernel).fit(s, y).kernel_
        tried = [likeliest]
        if of[-1] > 0:
            tried += [_with(likeliest, longer, noise) for longer in _LONGER for noise in _NOISES]
        left_out = [_left_out(candidate(s), y, of) for candidate in tried]
        best = min(
            range(len(tried)),
            key=lambda i: np.sum(np.log(left_out[i][1]) + 0.5 * (left_out[i][0]) ** 2),
        )
        fitted = GaussianProcessRegressor(tried[best], optimizer=None).fit(s, y)
        mean, deviation = fitted.predict(queries, return_std=True)
    return mean, deviation, left_out[best][0]


def _with(kernel: Any, longer: float, noise: float) -> Any:
    """The kernel with lengths multiplied by `longer`, and another noise."""
    theta = kernel.theta.copy()
    theta[1:-1] += np.log(longer)
    theta[-1] = np.log(noise)
    return kernel.clone_with_theta(theta)


def _left_out(gram: Array, y: Array, of: NDArray[np.intp]) -> tuple[Array, Array]:
    """Errors (M,), in deviations, of each demonstration given the others; deviations (M,)."""
    precision = np.linalg.inv(gram)
    pull = precision @ y
    errors = np.empty_like(y)
    deviations = np.empty_like(y)
    # covariance P_hh^-1 and error P_hh^-1 (P y)_h of a normal, conditioned on all other samples
    for h in np.unique(of):
        rows = of == h
        covariance = np.linalg.inv(precision[np.ix_(rows, rows)])
        deviations[rows] = np.sqrt(np.diag(covariance))
        errors[rows] = covariance @ pull[rows] / deviations[rows]
    return errors, deviations
