"""The reference by Gaussian process regression: where inputs have many dimensions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import Array, check_finite, check_some, checked_demonstrations, numbers, positive, whole
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, covariances

_SIGNAL = 1e-3, 1e3  # variance of the function, over the outputs'
_LENGTH = 1e-2, 1e3  # along an input, over the inputs' deviation
_NOISE = 1e-6, 1e1  # variance of the noise, over the outputs'
_LONGER = 1.0, 1.5, 2.5, 4.0  # than the likeliest lengths, tried on what is left out
_NOISES = 1e-6, 1e-4, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0  # tried on it as well


def gaussian_process_reference(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
    inputs: ArrayLike,
    *,
    count: int = 400,
    regularization: float = 1e-6,
) -> Gaussians:
    """The reference at inputs (N, I) of demonstrations, each inputs (T, I), outputs (T, O).

    For inputs of many dimensions, where a mixture would need more components than the samples can
    tell. Choose `inputs` among the demonstrations' own. Each output is a Gaussian process of its
    own, with a squared exponential kernel of one length an input, and noise, of the greatest
    likelihood on `count` samples at most, evenly taken.

    Samples of one demonstration are off together, and not each by itself as that likelihood has it.
    So longer lengths and other noises are tried: those count under which each demonstration is
    likeliest given the others. The mean square of these errors, in their deviations, scales the
    covariance, and tells how outputs go together. One demonstration alone tells neither.
    `regularization` [unit^2] is added to the covariance's diagonal.

    Raises ValueError if shapes do not agree, a number is not finite, there is no sample, or a
    parameter is out of its range.
    """
    data = checked_demonstrations(demonstrations)
    where = numbers("inputs", inputs, "N", data[0][0].shape[1])
    check_some("inputs", where)
    most = max(1, whole("count", count) // len(data))
    added = positive("regularization", regularization)
    chosen = [np.linspace(0, len(s) - 1, min(most, len(s))).astype(int) for s, _ in data]
    of = np.repeat(np.arange(len(data)), [len(one) for one in chosen])
    s, y = (np.concatenate([one[i][some] for one, some in zip(data, chosen, strict=True)]) for i in (0, 1))
    scale, size, centre = _deviations(s), _deviations(y), y.mean(axis=0)
    s, asked = s / scale, where / scale
    check_finite("inputs", asked, "over the demonstrations' deviation:")
    found = [_process(s, one, of, asked) for one in ((y - centre) / size).T]
    mean, deviation, errors = (np.stack(parts, axis=1) for parts in zip(*found, strict=True))
    apart = deviation * size
    together = errors.T @ errors / len(errors) if len(data) > 1 else np.eye(len(centre))
    covariance = apart[:, :, None] * together * apart[:, None, :] + added * np.eye(len(centre))
    return Gaussians(
        mean * size + centre, covariances("regularization: covariance", symmetric(covariance), *mean.shape)
    )


def _deviations(values: Array) -> Array:
    """Of each column; 1 of one that never changes."""
    found = values.std(axis=0)
    check_finite("demonstrations", found, "too large for their deviation:")
    return np.where(found > 0, found, 1.0)


def _process(s: Array, y: Array, of: NDArray[np.intp], asked: Array) -> tuple[Array, Array, Array]:
    """The mean and the deviation (N,) at inputs (N, I), from samples (M, I), (M,) of these
    demonstrations (M,); and the errors (M,) of each as the others predict it, in their deviations.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from threadpoolctl import threadpool_limits

    count = s.shape[1]
    kernel = ConstantKernel(1.0, _SIGNAL) * RBF(np.full(count, np.sqrt(count)), _LENGTH) + WhiteKernel(0.01, _NOISE)
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)  # an input that does not matter has no length
        likeliest = GaussianProcessRegressor(kernel).fit(s, y).kernel_
        tried = [likeliest]
        if of[-1] > 0:
            tried += [_with(likeliest, longer, noise) for longer in _LONGER for noise in _NOISES]
        each = [_left_out(one(s), y, of) for one in tried]
        best = min(range(len(tried)), key=lambda i: np.sum(np.log(each[i][1]) + 0.5 * (each[i][0]) ** 2))
        fitted = GaussianProcessRegressor(tried[best], optimizer=None).fit(s, y)
        mean, deviation = fitted.predict(asked, return_std=True)
    return mean, deviation, each[best][0]


def _with(kernel: Any, longer: float, noise: float) -> Any:
    """The same kernel, its lengths so many times longer, with another noise."""
    theta = kernel.theta.copy()
    theta[1:-1] += np.log(longer)
    theta[-1] = np.log(noise)
    return kernel.clone_with_theta(theta)


def _left_out(gram: Array, y: Array, of: NDArray[np.intp]) -> tuple[Array, Array]:
    """The errors (M,) of each demonstration as the others predict it, and the deviations (M,)."""
    precision = np.linalg.inv(gram)
    pull, errors, deviations = precision @ y, np.empty_like(y), np.empty_like(y)
    for h in np.unique(of):  # of a normal, given all else: covariance P_hh^-1, error P_hh^-1 (P y)_h
        own = of == h
        covariance = np.linalg.inv(precision[np.ix_(own, own)])
        deviations[own] = np.sqrt(np.diag(covariance))
        errors[own] = covariance @ pull[own] / deviations[own]
    return errors, deviations
