"""Cross-validation in closed form: each group of points predicted from all points but its own.

For a kernel matrix K (N, N) and noise of variance r, one eigendecomposition K = V diag(v) V^T gives
the inverse Q = (K + r I)^-1 = V diag(1 / (v + r)) V^T for all r. With Q_gg its block of a group g
(Rasmussen and Williams 2006, section 5.4.2, for groups):

    residuals     y_g - m_g = Q_gg^-1 (Q y)_g
    covariances   C_g = Q_gg^-1, the noise included
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array


def squared_distances(points: Array) -> Array:
    """The squared distances (N, N) between points (N, I), symmetric and not negative."""
    norms = (points**2).sum(axis=1)
    squares = norms[:, None] + norms - 2.0 * points @ points.T
    return np.asarray(np.maximum(0.5 * (squares + squares.T), 0.0))


def held_out_residuals(
    kernel: Array, ratios: Array, group: NDArray[np.intp], targets: Callable[[int], Array]
) -> Array:
    """The residuals (J, N, D) of kernel ridge regression without each point's group.

    `ratios` (J,) are the variances of the noise over the kernel's, `group` (N,) the numbers of the
    groups. `targets` gives the values (N, D) to predict when a group is held out, because the mean
    that was subtracted from them may depend on the group.
    """
    values, vectors = np.linalg.eigh(kernel)
    numbers = np.unique(group).tolist()
    out = np.empty((len(ratios), *targets(numbers[0]).shape))
    for number in numbers:
        mine = group == number
        rows = vectors[mine] / (values + ratios[:, None])[:, None]
        out[:, mine] = np.linalg.solve(rows @ vectors[mine].T, rows @ (vectors.T @ targets(number)))
    return out


def held_out_covariances(
    kernel: Array, scatter: Array, ratios: Array, group: NDArray[np.intp]
) -> Array:
    """The covariances (J, N, O, O) of each point without its group, in units of the kernel.

    The noise of a point is a ratio (J,) times its scatter S_n (N, O, O). With S_n = L_n L_n^T, the
    equations of this module hold for the whitened kernel (L^-1) K (L^-1)^T, and a point's
    covariance without its noise is L_n (C_n - r I) L_n^T.
    """
    roots = np.linalg.cholesky(scatter)
    white = np.linalg.inv(roots)
    count, width, _ = roots.shape
    total = np.einsum("nm,nik,mjk->nimj", kernel, white, white, optimize=True).reshape(
        2 * [count * width]
    )
    values, vectors = np.linalg.eigh(total)
    out = np.empty((len(ratios), count, width, width))
    for number in np.unique(group):
        mine = np.flatnonzero(group == number)
        rows = vectors[(width * mine[:, None] + np.arange(width)).ravel()]
        diagonal = np.arange(len(mine))
        blocks = np.linalg.inv(rows / (values + ratios[:, None])[:, None] @ rows.T)
        diagonal_blocks = blocks.reshape(-1, len(mine), width, len(mine), width)[
            :, diagonal, :, diagonal
        ].swapaxes(0, 1)
        out[:, mine] = (
            roots[mine]
            @ (diagonal_blocks - ratios[:, None, None, None] * np.eye(width))
            @ roots[mine].mT
        )
    return np.asarray(0.5 * (out + out.mT))


def mahalanobis(errors: Array, covariance: Array) -> Array:
    """The squared Mahalanobis distances (M,) of errors (M, O) under covariances (M, O, O)."""
    white = np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("ni,ni->n", errors, white))
