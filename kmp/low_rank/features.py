"""Features of the kernel by pivoted Cholesky: k(s, s') = z(s)^T z(s') + residual.

z(s) = L^-1 k(S_p, s) with pivots S_p among the points and L L^T = k(S_p, S_p). The next pivot is
the point of the largest residual k(s, s) - |z(s)|^2, as a share of k(s, s). The Gaussian kernel has
a small numerical rank r: few pivots bring the residual below a tolerance. Fine and Scheinberg 2001.
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

BLOCK = 8192  # inputs computed at once, which bounds the memory
KEPT = 50_000_000  # features kept in memory, 400 MB; larger ones are computed again for each pass
_CANDIDATES = 4096  # pivots are chosen among this number of inputs
_ROUNDS = 6  # rounds of adding pivots where the residual exceeds the tolerance
_MARGIN = 0.25  # the candidates must meet this share of the tolerance, so that other inputs meet it
FLOOR = 1e-14  # a residual below this share of k(s, s) is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Features(Immutable):
    """z(s) = L^-1 k(S_p, s), with pivots S_p and the Cholesky factor L of k(S_p, S_p).

    A pivot is one channel of a functional: with rates, a value or its rate.
    """

    kernel: Kernel
    pivots: Functionals  # r
    channels: NDArray[np.intp]  # (r,) the channel of each pivot
    root: Array  # L (r, r)

    @classmethod
    def at(cls, kernel: Kernel, pivots: Functionals, channels: NDArray[np.intp]) -> Features:
        """The features of these r pivots, without those from which on rounding hides them."""
        k = _columns(
            _columns(between(kernel, pivots, pivots), channels, kernel).T, channels, kernel
        )
        root, info = lapack.dpotrf(k, lower=1, clean=1)
        if info:
            return cls.at(kernel, pivots.take(slice(info - 1)), channels[: info - 1])
        return cls(kernel, pivots, frozen(channels.copy()), frozen(np.asfortranarray(root)))

    @classmethod
    def of(
        cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float
    ) -> tuple[Features, float]:
        """The features and the largest residual, as `with_values` returns them."""
        features, residual, _ = cls.with_values(kernel, points, rank=rank, tolerance=tolerance)
        return features, residual

    @classmethod
    def spanning(cls, kernel: Kernel, points: Functionals, *, tolerance: float) -> Features:
        """The features of N points with residuals of at most `tolerance`, of any rank."""
        return cls.of(kernel, points, rank=len(points) * kernel.channels, tolerance=tolerance)[0]

    @classmethod
    def with_values(
        cls, kernel: Kernel, points: Functionals, *, rank: int, tolerance: float
    ) -> tuple[Features, float, list[Array]]:
        """At most `rank` features of N points, their largest residual, and z of the points.

        The residual, a share of k(s, s) of a channel, is at most `tolerance` unless the rank is too
        low. z is a list of blocks (r, n C), empty if they are too large to keep.
        """
        count = len(points)
        c = kernel.channels
        index = np.linspace(0, count - 1, min(count, _CANDIDATES // c)).astype(np.intp)
        chosen = _pivots(kernel, points.take(index), rank, _MARGIN * tolerance)
        features = cls.at(kernel, points.take(index[chosen // c]), chosen % c)
        blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
        z = [features(block) for block in blocks] if count * c * rank <= KEPT else []
        for n in range(_ROUNDS):
            pairs = (
                zip(blocks, z, strict=True) if z else ((block, features(block)) for block in blocks)
            )
            residual = np.concatenate(
                [features.residual_of(block, z_block).max(axis=1) for block, z_block in pairs]
            )
            worst = np.argsort(-residual, kind="stable")[: _CANDIDATES // (2 * c)]
            worst = np.sort(worst[residual[worst] > tolerance])
            if len(worst) == 0 or len(features.pivots) >= rank or n == _ROUNDS - 1:
                break
            worst_points = points.take(worst)
            more = _pivots(kernel, worst_points, rank, tolerance, features(worst_points))
            pivots = Functionals.concatenated([features.pivots, worst_points.take(more // c)])
            grown = cls.at(kernel, pivots, np.concatenate([features.channels, more % c]))
            if len(grown.pivots) <= len(features.pivots):
                break
            z = [grown._grown(block, z_block) for block, z_block in zip(blocks, z, strict=False)]  # noqa: SLF001
            features = grown
        return features, float(residual.max()), z

    def _grown(self, points: Functionals, z: Array) -> Array:
        """The features (r, n C) of n points, of which the first (r', n C) are known."""
        r = len(z)
        added = between(self.kernel, points, self.pivots.take(slice(r, None)))
        columns = _columns(added, self.channels[r:], self.kernel).T
        features = np.empty((len(self.pivots), columns.shape[1]), order="F")
        features[:r] = z
        features[r:] = lapack.dtrtrs(self.root[r:, r:], columns - self.root[r:, :r] @ z, lower=1)[0]
        return features

    def __call__(self, points: Functionals) -> Array:
        """z (r, n C) of n points, for each channel."""
        return self.of_kernel(between(self.kernel, points, self.pivots))

    def of_kernel(self, rows: Array) -> Array:
        """The features (r, n) of kernel rows (n, r C) to the pivots and all their channels."""
        columns = _columns(rows, self.channels, self.kernel).T
        return np.asarray(lapack.dtrtrs(self.root, columns, lower=1)[0])

    def kernel_weights(self, w: Array) -> Array:
        """The weights (r, O) of the pivots' kernels equal to w (r, D) of the features: L^-T w."""
        values = lapack.dtrtrs(self.root, w, lower=1, trans=1)[0]
        weights = np.zeros((len(w), self.kernel.channels, w.shape[1]))
        weights[np.arange(len(w)), self.channels] = values
        return weights.reshape(len(w), -1)

    def residual_of(self, points: Functionals, z: Array) -> Array:
        """k(s, s) - |z(s)|^2 as a share of k(s, s): (n, C), of n points with features (r, n C)."""
        shares = 1 - (z * z).sum(axis=0).reshape(len(points), -1) / variances(self.kernel, points)
        return np.asarray(np.maximum(shares, FLOOR))


def _columns(rows: Array, channels: NDArray[np.intp], kernel: Kernel) -> Array:
    """The columns (n, r) of rows (n, r C) that belong to these channels (r,)."""
    if kernel.channels == 1:
        return rows
    return np.asfortranarray(rows[:, np.arange(len(channels)) * kernel.channels + channels])


def _pivots(
    kernel: Kernel, points: Functionals, rank: int, tolerance: float, known: Array | None = None
) -> NDArray[np.intp]:
    """Pivots among the channels of N points, as indices below N C.

    Greedy: the next is where the residual is largest, as a share of k(s, s). `known` (r', N C) are
    the features of earlier pivots.
    """
    c = kernel.channels
    deviation = np.sqrt(variances(kernel, points)).ravel()
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
