"""Features of the kernel: k(s, s') = z(s) z(s')^T + a residual, by pivoted Cholesky.

The Gaussian kernel of smooth data has a small numerical rank: r features, each made of one of the
points (its pivot), leave at each point a share of k(s, s) below a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.checks import Array
from kmp.functionals import Functionals
from kmp.immutable import Immutable, frozen
from kmp.kernel import Kernel, between, variances

BLOCK = 8192  # inputs at once, which bounds the memory
_CANDIDATES = 4096  # inputs among which pivots are sought at once
_ROUNDS = 6
_MARGIN = 0.25  # of the tolerance, for the inputs that are no candidates
_FLOOR = 1e-14  # of k(s, s): a smaller residual is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Features(Immutable):
    """z(s) = L^-1 k(S_p, s), with pivots S_p and the Cholesky factor L of their kernel matrix."""

    kernel: Kernel
    pivots: Functionals  # r
    root: Array  # L (r, r)

    @classmethod
    def at(cls, kernel: Kernel, pivots: Functionals) -> Features:
        """The features of these r pivots, without the last if rounding hides what they add."""
        k = between(kernel, pivots, pivots)[:: kernel.channels, :: kernel.channels]
        root, info = lapack.dpotrf(k, lower=1, clean=1)
        if info:
            return cls.at(kernel, pivots.take(slice(info - 1)))
        return cls(kernel, pivots, frozen(np.asfortranarray(root)))

    @classmethod
    def of(cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float) -> tuple[Features, float]:
        """The features of N points, at most `rank`, and their largest residual at one of them.

        That is a share of k(s, s), and no more than `tolerance` unless the rank does not reach so
        far. Where the kernel has rates too, the rates at the points may be pivots, as derivatives.
        """
        if kernel.channels > 1:
            values = points.inputs[points.values]
            points = Functionals.concatenated([points, Functionals(values, frozen(np.ones(values.shape)))])
        count = len(points)
        index = np.linspace(0, count - 1, min(count, _CANDIDATES)).astype(np.intp)
        for _ in range(_ROUNDS):
            chosen = _pivots(kernel, points.take(index), rank, _MARGIN * tolerance)
            found = cls.at(kernel, points.take(index[chosen]))
            blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
            residual = np.concatenate([found.residual(block)[:, 0] for block in blocks])
            worst = np.argsort(-residual, kind="stable")[: _CANDIDATES // 2]
            worst = np.setdiff1d(worst[residual[worst] > tolerance], index)
            if len(worst) == 0 or len(found.pivots) >= rank:
                break
            index = np.union1d(index, worst)
        return found, float(residual.max())

    def __call__(self, points: Functionals) -> Array:
        """z of n points, for each channel: (r, n C)."""
        return self.of_kernel(between(self.kernel, points, self.pivots)[:, :: self.kernel.channels].T)

    def of_kernel(self, columns: Array) -> Array:
        """L^-1 times columns (r, n) of the pivots' kernels: the features there."""
        return np.asarray(lapack.dtrtrs(self.root, columns, lower=1)[0])

    def kernel_weights(self, w: Array) -> Array:
        """The weights (r, O) of the pivots' kernels that stand for w (r, D) of the features."""
        values = lapack.dtrtrs(self.root, w, lower=1, trans=1)[0]
        weights = np.zeros((len(w), self.kernel.channels, w.shape[1]))
        weights[:, 0] = values
        return weights.reshape(len(w), -1)

    def residual(self, points: Functionals) -> Array:
        """k(s, s) - |z(s)|^2 of n points, for each channel, as a share of k(s, s): (n, C)."""
        z = self(points)
        shares = 1 - (z * z).sum(axis=0).reshape(len(points), -1) / variances(self.kernel, points)
        return np.asarray(np.maximum(shares, _FLOOR))


def _pivots(kernel: Kernel, points: Functionals, rank: int, tolerance: float) -> NDArray[np.intp]:
    """Which points make the best pivots, greedily: where the share of the residual is largest."""
    c, deviation = kernel.channels, np.sqrt(variances(kernel, points)[:, 0])
    residual = np.ones(len(points))
    columns = np.empty((min(rank, len(points)), len(points)))
    chosen: list[int] = []
    for j in range(len(columns)):
        n = int(residual.argmax())
        if residual[n] <= tolerance:
            break
        column = between(kernel, points.take(slice(n, n + 1)), points)[0, ::c]
        column = column / (deviation[n] * deviation) - columns[:j, n] @ columns[:j]
        columns[j] = column / np.sqrt(residual[n])
        residual -= columns[j] ** 2
        residual[n] = 0
        chosen.append(n)
    return np.array(chosen, dtype=np.intp)
