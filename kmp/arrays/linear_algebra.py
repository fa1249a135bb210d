"""Operations on stacks of small matrices: symmetric part, Kronecker product, projection."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from kmp.arrays.checks import Array

_MACHINE = float(np.finfo(np.float64).eps)


def symmetric(matrices: Array) -> Array:
    """The symmetric parts (A + A^T) / 2 (..., n, n). A symmetric matrix keeps its bits."""
    return np.asarray((matrices + matrices.swapaxes(-1, -2)) / 2)


def kron_identity(blocks: Array, copies: int) -> Array:
    """The Kronecker products x (x) I (..., A D, B D) of x (..., A, B), I of size D = `copies`."""
    *stacked, rows, columns = blocks.shape
    wide = blocks[..., :, None, :, None] * np.eye(copies)[:, None, :]
    return np.asarray(wide.reshape(*stacked, rows * copies, columns * copies))


def nearest_positive_semidefinite(covariance: Array, deviations: Array) -> Array:
    """The nearest positive semi-definite matrices (M, n, n), against eigenvalues rounded below 0.

    V max(diag(lambda), eps) V^T of the symmetric part V diag(lambda) V^T, with the machine's
    precision eps, so that the result has a Cholesky factor (Higham 1988). `deviations` (n,) are the
    units in which rounding errors have the size eps.
    """
    covariance = symmetric(covariance)
    if len(covariance) == 1 and lapack.dpotrf(covariance[0])[1] == 0:
        return covariance  # the same answer as below, without NumPy's overhead
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        unit = np.outer(deviations, deviations)
        values, vectors = np.linalg.eigh(covariance / unit)
        raised = (vectors * np.maximum(values, _MACHINE)[:, None, :]) @ vectors.swapaxes(1, 2)
        below = (values[:, 0] < _MACHINE)[:, None, None]
        covariance = np.where(below, symmetric(raised) * unit, covariance)
    return covariance
