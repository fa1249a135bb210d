"""Features of the kernel: k(s, s') = z(s) z(s')^T + a residual, by pivoted Cholesky.

The Gaussian kernel of smooth data has a small numerical rank: r features, each made of one of the
points (its pivot), leave at each point a share of k(s, s) below a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable, frozen
from kmp.functionals import Functionals
from kmp.kernel import Kernel, between, variances

BLOCK = 8192  # inputs at once, which bounds the memory
KEPT = 50_000_000  # numbers of features that are kept, 400 MB; more are made again for each pass
_CANDIDATES = 4096  # inputs among which pivots are sought at once
_ROUNDS = 6
_MARGIN = 0.25  # of the tolerance, for the inputs that are no candidates
_FLOOR = 1e-14  # of k(s, s): a smaller residual is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Features(Immutable):
    """z(s) = L^-1 k(S_p, s), with pivots S_p and the Cholesky factor L of their kernel matrix.

    A pivot is one channel of a functional: of a kernel with rates, a value or its rate.
    """

    kernel: Kernel
    pivots: Functionals  # r
    channels: NDArray[np.intp]  # (r,) the channel of each pivot
    root: Array  # L (r, r)

    @classmethod
    def at(cls, kernel: Kernel, pivots: Functionals, channels: NDArray[np.intp]) -> Features:
        """The features of these r pivots, without the last if rounding hides what they add."""
        k = _columns(_columns(between(kernel, pivots, pivots), channels, kernel).T, channels, kernel)
        root, info = lapack.dpotrf(k, lower=1, clean=1)
        if info:
            return cls.at(kernel, pivots.take(slice(info - 1)), channels[: info - 1])
        return cls(kernel, pivots, frozen(channels.copy()), frozen(np.asfortranarray(root)))

    @classmethod
    def of(cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float) -> tuple[Features, float]:
        """`made`, without what was kept."""
        found, residual, _ = cls.made(kernel, points, rank=rank, tolerance=tolerance)
        return found, residual

    @classmethod
    def spanning(cls, kernel: Kernel, points: Functionals, *, tolerance: float) -> Features:
        """The features of N points that leave at most `tolerance` of them, whatever their rank."""
        return cls.of(kernel, points, rank=len(points) * kernel.channels, tolerance=tolerance)[0]

    @classmethod
    def made(
        cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float
    ) -> tuple[Features, float, list[Array]]:
        """The features of N points, at most `rank`, and their largest residual at one of them.

        The residual is a share of k(s, s) of a channel. It is at most `tolerance`, unless the rank
        is too low for that. The third value holds the features of the points in blocks (r, n C), if
        these are few enough to keep.
        """
        count, c = len(points), kernel.channels
        index = np.linspace(0, count - 1, min(count, _CANDIDATES // c)).astype(np.intp)
        chosen = _pivots(kernel, points.take(index), rank, _MARGIN * tolerance)
        found = cls.at(kernel, points.take(index[chosen // c]), chosen % c)
        blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
        z = [found(block) for block in blocks] if count * c * rank <= KEPT else []
        for n in range(_ROUNDS):
            each = zip(blocks, z, strict=True) if z else ((block, found(block)) for block in blocks)
            residual = np.concatenate([found.left(block, one).max(axis=1) for block, one in each])
            worst = np.argsort(-residual, kind="stable")[: _CANDIDATES // (2 * c)]
            worst = np.sort(worst[residual[worst] > tolerance])
            if len(worst) == 0 or len(found.pivots) >= rank or n == _ROUNDS - 1:
                break
            some = points.take(worst)
            more = _pivots(kernel, some, rank, tolerance, found(some))
            pivots = Functionals.concatenated([found.pivots, some.take(more // c)])
            grown = cls.at(kernel, pivots, np.concatenate([found.channels, more % c]))
            if len(grown.pivots) <= len(found.pivots):
                break
            z = [grown._grown(block, one) for block, one in zip(blocks, z, strict=False)]  # noqa: SLF001
            found = grown
        return found, float(residual.max()), z

    def _grown(self, points: Functionals, z: Array) -> Array:
        """The features of n points, of which the first (r', n C) are known."""
        r = len(z)
        added = between(self.kernel, points, self.pivots.take(slice(r, None)))
        columns = _columns(added, self.channels[r:], self.kernel).T
        found = np.empty((len(self.pivots), columns.shape[1]), order="F")
        found[:r] = z
        found[r:] = lapack.dtrtrs(self.root[r:, r:], columns - self.root[r:, :r] @ z, lower=1)[0]
        return found

    def __call__(self, points: Functionals) -> Array:
        """z of n points, for each channel: (r, n C)."""
        return self.of_kernel(between(self.kernel, points, self.pivots))

    def of_kernel(self, rows: Array) -> Array:
        """The features (r, n) of kernel rows (n, r C) to the pivots and all their channels."""
        columns = _columns(rows, self.channels, self.kernel).T
        return np.asarray(lapack.dtrtrs(self.root, columns, lower=1)[0])

    def kernel_weights(self, w: Array) -> Array:
        """The weights (r, O) of the pivots' kernels that stand for w (r, D) of the features."""
        values = lapack.dtrtrs(self.root, w, lower=1, trans=1)[0]
        weights = np.zeros((len(w), self.kernel.channels, w.shape[1]))
        weights[np.arange(len(w)), self.channels] = values
        return weights.reshape(len(w), -1)

    def residual(self, points: Functionals) -> Array:
        """k(s, s) - |z(s)|^2 of n points, for each channel, as a share of k(s, s): (n, C)."""
        return self.left(points, self(points))

    def left(self, points: Functionals, z: Array) -> Array:
        """The same, of points whose features (r, n C) are known."""
        shares = 1 - (z * z).sum(axis=0).reshape(len(points), -1) / variances(self.kernel, points)
        return np.asarray(np.maximum(shares, _FLOOR))


def _columns(rows: Array, channels: NDArray[np.intp], kernel: Kernel) -> Array:
    """Of rows (n, r C) the columns of these channels (r,): (n, r)."""
    if kernel.channels == 1:
        return rows
    return np.asfortranarray(rows[:, np.arange(len(channels)) * kernel.channels + channels])


def _pivots(
    kernel: Kernel, points: Functionals, rank: int, tolerance: float, known: Array | None = None
) -> NDArray[np.intp]:
    """The best pivots among the channels of N points, as numbers below N C.

    They are chosen greedily: the next is where the share of the residual is largest. `known` (r',
    N C) are the features of pivots that there are already.
    """
    c, deviation = kernel.channels, np.sqrt(variances(kernel, points)).ravel()
    count = len(deviation)
    before = np.empty((0, count)) if known is None else known / deviation
    residual = 1 - (before**2).sum(axis=0)
    columns = np.empty((min(rank, len(before) + count), count))
    columns[: len(before)] = before
    chosen: list[int] = []
    for j in range(len(before), len(columns)):
        n = int(residual.argmax())
        if residual[n] <= tolerance:
            break
        column = between(kernel, points.take(slice(n // c, n // c + 1)), points)[n % c]
        column = column / (deviation[n] * deviation) - columns[:j, n] @ columns[:j]
        columns[j] = column / np.sqrt(residual[n])
        residual -= columns[j] ** 2
        residual[n] = 0
        chosen.append(n)
    return np.array(chosen, dtype=np.intp)
