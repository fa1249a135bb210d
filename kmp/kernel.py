"""The kernel that stands for the basis functions: how alike two inputs are (the paper, equation (7))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from kmp.checks import Array, positive


@dataclass(frozen=True)
class GaussianKernel:
    """The kernel k(s, s') = exp(-ell |s - s'|^2), section III of the paper; `ell` in 1 / (unit of the inputs)^2.

    Two sets of inputs go into the call and into `gradient`. The methods `..._at` are for one query at a time, where the
    microseconds count: they take its offsets s - s_n (N, I) from N inputs.
    """

    ell: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "ell", positive("ell", self.ell))

    def __call__(self, a: Array, b: Array) -> Array:
        """k(a, b) for every pair: (A, I), (B, I) -> (A, B)."""
        return np.exp(-self.ell * cdist(a, b, "sqeuclidean"))

    def gradient(self, a: Array, b: Array) -> Array:
        """dk(a, b)/da for every pair: (A, I), (B, I) -> (A, B, I)."""
        offsets = a[:, None, :] - b[None, :, :]
        return np.asarray(-2 * self.ell * self(a, b)[:, :, None] * offsets)

    def value_at(self, offsets: Array) -> Array:
        """k(s, s_n): (N, I) -> (N,)."""
        return np.asarray(np.exp(-self.ell * np.vecdot(offsets, offsets)))

    def slope_at(self, offsets: Array) -> Array:
        """What each offset is multiplied by to give dk(s, s_n)/ds: (N, I) -> (N,)."""
        return np.asarray(-2 * self.ell * self.value_at(offsets))

    def curvature_at(self, offsets: Array, direction: Array) -> Array:
        """d^2 k(s + t v, s_n)/dt^2 at t = 0 along the direction v: (N, I), (I,) -> (N,)."""
        slope = (2 * self.ell) * (offsets @ direction)
        return np.asarray(self.value_at(offsets) * (slope * slope - 2 * self.ell * float(direction @ direction)))
