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
KEPT = 50_000_000  # numbers of features that are kept, 400 MB; more are made again for each pass
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
        """`made`, without what was kept."""
        found, residual, _ = cls.made(kernel, points, rank=rank, tolerance=tolerance)
        return found, residual

    @classmethod
    def made(
        cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float
    ) -> tuple[Features, float, list[Array]]:
        """The features of N points, at most `rank`, and their largest residual at one of them.

        That is a share of k(s, s), and no more than `tolerance` unless the rank does not reach so
        far. Last what they are in blocks of points, (r, n), if these are few enough. Where the
        kernel has rates too, these may be pivots, as derivatives, and nothing is kept.
        """
        if kernel.channels > 1:
            values = points.inputs[points.values]
            points = Functionals.concatenated([points, Functionals(values, frozen(np.ones(values.shape)))])
        count = len(points)
        index = np.linspace(0, count - 1, min(count, _CANDIDATES)).astype(np.intp)
        chosen = index[_pivots(kernel, points.take(index), rank, _MARGIN * tolerance)]
        found = cls.at(kernel, points.take(chosen))
        blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
        z = [found(block) for block in blocks] if count * kernel.channels * rank <= KEPT else []
        for n in range(_ROUNDS):
            each = zip(blocks, z, strict=True) if z else ((block, found(block)) for block in blocks)
            residual = np.concatenate([found.left(block, one)[:, 0] for block, one in each])
            worst = np.argsort(-residual, kind="stable")[: _CANDIDATES // 2]
            worst = np.sort(worst[residual[worst] > tolerance])
            if len(worst) == 0 or len(found.pivots) >= rank or n == _ROUNDS - 1:
                break
            some = points.take(worst)
            more = worst[_pivots(kernel, some, rank, tolerance, found(some)[:, :: kernel.channels])]
            grown = cls.at(kernel, Functionals.concatenated([found.pivots, points.take(more)]))
            if len(grown.pivots) <= len(found.pivots):
                break
            z = [grown._grown(block, one) for block, one in zip(blocks, z, strict=False)]  # noqa: SLF001
            found = grown
        return found, float(residual.max()), z if kernel.channels == 1 else []

    def _grown(self, points: Functionals, z: Array) -> Array:
        """The features of n points, of which the first (r', n C) are known."""
        r = len(z)
        columns = between(self.kernel, points, self.pivots.take(slice(r, None)))[:, :: self.kernel.channels].T
        found = np.empty((len(self.pivots), columns.shape[1]), order="F")
        found[:r] = z
        found[r:] = lapack.dtrtrs(self.root[r:, r:], columns - self.root[r:, :r] @ z, lower=1)[0]
        return found

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
        return self.left(points, self(points))

    def left(self, points: Functionals, z: Array) -> Array:
        """The same, of points whose features (r, n C) are known."""
        shares = 1 - (z * z).sum(axis=0).reshape(len(points), -1) / variances(self.kernel, points)
        return np.asarray(np.maximum(shares, _FLOOR))


def _pivots(
    kernel: Kernel, points: Functionals, rank: int, tolerance: float, known: Array | None = None
) -> NDArray[np.intp]:
    """Which points make the best pivots, greedily: where the share of the residual is largest.

    Beside the pivots of features that are known, (r', n).
    """
    c, deviation = kernel.channels, np.sqrt(variances(kernel, points)[:, 0])
    before = np.empty((0, len(points))) if known is None else known / deviation
    residual = 1 - (before**2).sum(axis=0)
    columns = np.empty((min(rank, len(before) + len(points)), len(points)))
    columns[: len(before)] = before
    chosen: list[int] = []
    for j in range(len(before), len(columns)):
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
