"""The reference database, and how via-points change it (the paper, Algorithm 1)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from kmp.checks import Array, ViaPointMissed
from kmp.gaussians import Gaussians
from kmp.immutable import Immutable, frozen

_DISTANCES = 10_000_000  # from via-points to reference points, at once
_MISSED = 3.0  # of a via-point's deviations: more is a miss
_WORTH_SAYING = 1e-3  # [unit of the outputs] 1 mm, where that is the metre


class Changes(NamedTuple):
    """How an adapted database differs from its base: R points less, V via-points more."""

    replaced: NDArray[np.intp]  # (R,) indices of the base's points, ascending
    inputs: Array  # (V, I)
    points: Gaussians  # V


@dataclass(frozen=True, eq=False)
class Database(Immutable):
    """N reference points: where they are, and the normal distribution of the output there."""

    inputs: Array  # (N, I)
    reference: Gaussians  # N

    def __len__(self) -> int:
        return len(self.inputs)

    def unchanged(self) -> Changes:
        """No changes at all."""
        nothing = frozen(np.empty(0, dtype=np.intp))
        return Changes(nothing, self.inputs[:0], self.reference.take(slice(0, 0)))

    def changed(self, changes: Changes) -> Database:
        """The database after the changes: the points not replaced, then the via-points."""
        kept = np.delete(np.arange(len(self)), changes.replaced)
        inputs = frozen(np.concatenate([self.inputs[kept], changes.inputs]))
        return Database(inputs, Gaussians.concatenated([self.reference.take(kept), changes.points]))

    def nearest(self, via: Array, tolerance: float) -> NDArray[np.intp]:
        """The indices, ascending, of the points nearest to those of via (V, I), if near enough."""
        near = np.zeros(len(self), dtype=bool)
        step = max(1, _DISTANCES // len(self))
        for i in range(0, len(via), step):
            distance = cdist(via[i : i + step], self.inputs)  # (V, N)
            least = distance.min(axis=1, keepdims=True)
            near |= ((distance == least) & (least < tolerance)).any(axis=0)
        return np.flatnonzero(near)


def warn_of_missed(desired: Gaussians, mean: Array, channels: int) -> None:
    """Warns of the desired points that the mean (V, O) misses, and tells by how much."""
    count, d = len(mean), desired.outputs // channels
    residual = (desired.mean - mean).reshape(count, channels, d)
    distance = np.sqrt((residual * residual).sum(axis=2))  # (V, C)
    if not (distance > _WORTH_SAYING).any():
        return
    missed = []
    for c in range(channels):
        block = desired.covariance[:, c * d : (c + 1) * d, c * d : (c + 1) * d]
        white = np.linalg.solve(np.linalg.cholesky(block), residual[:, c, :, None])
        deviations = np.linalg.norm(white, axis=(1, 2))
        for n in np.flatnonzero((distance[:, c] > _WORTH_SAYING) & (deviations > _MISSED)):
            missed.append(f"{n} by {distance[n, c]:.3g} ({deviations[n]:.3g} deviations)")
    if missed:
        warnings.warn(
            f"Via-points missed [unit of the outputs]: {', '.join(missed)}. Another point near in the "
            "inputs asks for something else, or lambda is large: give the via-point less variance, "
            "replace what is near by a larger tolerance, or take a larger ell.",
            ViaPointMissed,
            stacklevel=3,
        )
