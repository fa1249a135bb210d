"""The inverse L^-1 of a Cholesky factor, by which a query's covariance costs one product.

k (L L^T)^-1 k^T = R R^T with the root R = (L^-1 (k^T (x) I))^T.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable, frozen

_BANDS = 4  # L^-1 is stored as 4 bands of rows, which hold 5/8 of the square


@dataclass(frozen=True, eq=False, repr=False)
class InverseCholeskyFactor(Immutable):
    """L^-1 of a lower triangular L (n D, n D), for products L^-1 (x (x) I) with I of size D.

    The Kronecker product x (x) I is never formed: a column of x goes through D columns of L^-1 at
    once.
    """

    copies: int  # D
    bands: tuple[Array, ...]
    """Bands of rows of L^-1 without the columns beyond the triangle, D columns stacked."""

    @classmethod
    def of(cls, factor: Array, copies: int) -> InverseCholeskyFactor:
        """The inverse of a factor L (n D, n D), with D = `copies`."""
        size = len(factor)
        d = copies
        n = size // d
        inverse, _ = lapack.dtrtri(factor, lower=1)
        rows = inverse.reshape(size, n, d)
        edges = [n * band // _BANDS for band in range(_BANDS + 1)]
        bands = (
            np.ascontiguousarray(rows[a * d : b * d, :b].transpose(0, 2, 1)).reshape(-1, b)
            for a, b in pairwise(edges)
            if a < b  # a band is empty where there are fewer points than bands
        )
        return cls(d, tuple(frozen(band) for band in bands))

    def times(self, x: Array, channels: int) -> Array:
        """L^-1 (x_m (x) I) for M of them side by side, x (n, M C): (M, n D, C D)."""
        product = np.concatenate([band @ x[: band.shape[1]] for band in self.bands])
        split = product.reshape(-1, self.copies, x.shape[1] // channels, channels)
        return split.transpose(2, 0, 3, 1).reshape(split.shape[2], -1, channels * self.copies)
