"""The inverse of a triangular factor, kept so that the covariance of one query costs one multiplication."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from kmp.checks import Array, frozen

_BANDS = 4  # with 4, five eighths of the square are kept


class Whitener:
    """L^-1 (x (x) I) for a lower triangular L (n D, n D) and columns x (n, C), without forming the product x (x) I."""

    def __init__(self, factor: Array, copies: int) -> None:
        """`copies` is D, the size of the unit matrix."""
        size, d = len(factor), copies
        n = size // d
        inverse, _ = lapack.dtrtri(factor, lower=1)
        rows = inverse.reshape(size, n, d)
        edges = [n * band // _BANDS for band in range(_BANDS + 1)]
        self.copies = d
        # In bands of rows, each without the columns beyond the triangle.
        self.bands: tuple[Array, ...] = tuple(
            frozen(np.ascontiguousarray(rows[a * d : b * d, :b].transpose(0, 2, 1)).reshape(-1, b))
            for a, b in pairwise(edges)
            if a < b  # fewer points than bands
        )

    def one(self, columns: Array) -> Array:
        """L^-1 (x (x) I), transposed, for one x: (n,) or (n, C) -> (C D, n D)."""
        root = np.concatenate([band @ columns[: band.shape[1]] for band in self.bands])
        if columns.ndim == 1:
            return root.reshape(-1, self.copies).T
        channels = columns.shape[1]
        return root.reshape(-1, self.copies, channels).transpose(2, 1, 0).reshape(channels * self.copies, -1)

    def many(self, columns: Array, channels: int) -> Array:
        """L^-1 (x (x) I) for M of them: (n, M C) -> (M, n D, C D)."""
        root = np.concatenate([band @ columns[: band.shape[1]] for band in self.bands])
        split = root.reshape(-1, self.copies, columns.shape[1] // channels, channels)
        return split.transpose(2, 0, 3, 1).reshape(split.shape[2], -1, channels * self.copies)

    def __setstate__(self, state: dict[str, object]) -> None:
        # Unpickled arrays come back writeable.
        self.__dict__.update(state)
        for band in self.bands:
            frozen(band)
