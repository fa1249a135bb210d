"""Features of the kernel: k(s, s') = z(s) z(s')^T + a residual, by pivoted Cholesky.

The Gaussian kernel of smooth data has a small numerical rank: r features, each made at one of the
inputs (its pivot), leave at each input a share of k(s, s) below a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.checks import Array
from kmp.immutable import Immutable, frozen
from kmp.kernel import Kernel

BLOCK = 8192  # inputs at once, which bounds the memory
_CANDIDATES = 4096  # inputs among which pivots are sought at once
_ROUNDS = 6
_MARGIN = 0.25  # of the tolerance, for the inputs that are no candidates
_FLOOR = 1e-14  # of k(s, s): a smaller residual is rounding


@dataclass(frozen=True, eq=False)
class Features(Immutable):
    """z(s) = L^-1 k(S_p, s), with pivots S_p and the Cholesky factor L of their kernel matrix."""

    kernel: Kernel
    pivots: Array  # (r, I)
    root: Array  # L (r, r)

    @classmethod
    def at(cls, kernel: Kernel, pivots: Array) -> Features:
        """The features of these pivots (r, I), without the last if rounding hides what they add."""
        k = kernel(pivots, pivots)[:: kernel.channels, :: kernel.channels]
        root, info = lapack.dpotrf(k, lower=1, clean=1)
        if info:
            return cls.at(kernel, pivots[: info - 1].copy())
        return cls(kernel, frozen(pivots), frozen(np.asfortranarray(root)))

    @classmethod
    def of(cls, kernel: Kernel, inputs: Array, *, rank: int, tolerance: float) -> tuple[Features, float]:
        """The features of inputs (N, I), at most `rank`, and their largest residual at an input.

        That is a share of k(s, s), and no more than `tolerance` unless the rank does not reach so
        far.
        """
        count = len(inputs)
        index = np.linspace(0, count - 1, min(count, _CANDIDATES)).astype(np.intp)
        for _ in range(_ROUNDS):
            chosen = _pivots(kernel, inputs[index], rank, _MARGIN * tolerance)
            found = cls.at(kernel, inputs[index[chosen]])
            blocks = [inputs[i : i + BLOCK] for i in range(0, count, BLOCK)]
            residual = np.concatenate([found.residual(block)[:, 0] for block in blocks])
            worst = np.argsort(-residual, kind="stable")[: _CANDIDATES // 2]
            worst = np.setdiff1d(worst[residual[worst] > tolerance], index)
            if len(worst) == 0 or len(found.pivots) >= rank:
                break
            index = np.union1d(index, worst)
        return found, float(residual.max())

    def __call__(self, inputs: Array) -> Array:
        """z at inputs (n, I), for each channel: (r, n C)."""
        return self.of_kernel(self.kernel(inputs, self.pivots)[:, :: self.kernel.channels].T)

    def of_kernel(self, columns: Array) -> Array:
        """L^-1 times columns (r, n) of the pivots' kernels: the features there."""
        return np.asarray(lapack.dtrtrs(self.root, columns, lower=1)[0])

    def kernel_weights(self, w: Array) -> Array:
        """The weights (r, O) of the pivots' kernels that stand for w (r, D) of the features."""
        values = lapack.dtrtrs(self.root, w, lower=1, trans=1)[0]
        weights = np.zeros((len(w), self.kernel.channels, w.shape[1]))
        weights[:, 0] = values
        return weights.reshape(len(w), -1)

    def residual(self, inputs: Array) -> Array:
        """k(s, s) - |z(s)|^2 at inputs (n, I), for each channel, as a share of k(s, s): (n, C)."""
        z = self(inputs)
        variance = np.diagonal(self.kernel.prior_variance)
        shares = 1 - (z * z).sum(axis=0).reshape(len(inputs), -1) / variance
        return np.asarray(np.maximum(shares, _FLOOR))


def _pivots(kernel: Kernel, inputs: Array, rank: int, tolerance: float) -> NDArray[np.intp]:
    """Which inputs make the best pivots, greedily: where the residual is largest."""
    c = kernel.channels
    residual = np.ones(len(inputs))
    columns = np.empty((min(rank, len(inputs)), len(inputs)))
    chosen: list[int] = []
    for j in range(len(columns)):
        n = int(residual.argmax())
        if residual[n] <= tolerance:
            break
        column = kernel(inputs[n : n + 1], inputs)[0, ::c] - columns[:j, n] @ columns[:j]
        columns[j] = column / np.sqrt(residual[n])
        residual -= columns[j] ** 2
        residual[n] = 0
        chosen.append(n)
    return np.array(chosen, dtype=np.intp)
