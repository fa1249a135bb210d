"""The reference database (s_n, mu_n, Sigma_n) and its changes by via-points.

The paper, Algorithm 1: a via-point replaces the nearest reference point within a tolerance, or is
inserted.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from kmp.arrays.checks import Array, ViaPointMissed
from kmp.arrays.immutable import Immutable, frozen
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians
from kmp.kernel import Kernel, variances
from kmp.problem.hyperparameters import Hyperparameters

DISTANCES = 10_000_000  # distances computed at once, which bounds the memory to 80 MB
_PAIR = 2  # a distance needs two points
_MISSED_DEVIATIONS = 3.0  # a via-point is missed beyond this multiple of its deviation
_MISSED_SHARE = 1e-3  # smaller errors, as a share of the prior deviation, are not reported
_NAMED = 5  # a message names at most this many via-points


class Changes(NamedTuple):
    """Difference of an adapted database from its base: R points removed, V via-points added."""

    replaced: NDArray[np.intp]  # (R,) indices of the base's points, ascending
    functionals: Functionals  # V
    points: Gaussians  # V

    @property
    def inputs(self) -> Array:
        """The inputs (V, I) of the via-points."""
        return self.functionals.inputs

    @property
    def added(self) -> Database:
        """The via-points."""
        return Database(self.functionals, self.points)

    def near(
        self, points: Functionals, tolerance: float, period: float | None
    ) -> NDArray[np.bool_]:
        """Whether each via-point (V,) is a value nearer than `tolerance` [unit of the inputs] to
        one of the points that is a value, or is one of the points.
        """
        distance = _distances(self.inputs, points.inputs, period)  # (V, P)
        along = self.functionals.along[:, None] == points.along
        same = (distance == 0) & along.all(axis=2)
        both = self.functionals.values[:, None] & points.values
        near: NDArray[np.bool_] = (same | (both & (distance < tolerance))).any(axis=1)
        return near


@dataclass(frozen=True, eq=False, repr=False)
class Database(Immutable):
    """N reference points: functionals of the output, and a normal distribution of each."""

    functionals: Functionals  # N
    reference: Gaussians  # N

    def __len__(self) -> int:
        return len(self.functionals)

    @property
    def inputs(self) -> Array:
        """The inputs (N, I) of the points."""
        return self.functionals.inputs

    def least_shares(self, kernel: Kernel) -> Array:
        """The least eigenvalue (N,) of each Sigma_n, as a share of k(s_n, s_n) of its channel."""
        scale = np.sqrt(self._variances(kernel))
        shares = self.reference.covariance / (scale[:, :, None] * scale[:, None, :])
        return np.asarray(np.linalg.eigvalsh(shares)[:, 0])

    def exceeds(self, kernel: Kernel, share: float) -> bool:
        """True if all `least_shares` are above this one."""
        least = share * self._variances(kernel)
        identity = np.eye(self.reference.outputs)
        try:
            np.linalg.cholesky(self.reference.covariance - least[:, :, None] * identity)
        except np.linalg.LinAlgError:
            return False
        return True

    def _variances(self, kernel: Kernel) -> Array:
        """The diagonal (N, O) of k(s_n, s_n) (x) I."""
        outputs = self.reference.outputs // kernel.channels
        return np.asarray(variances(kernel, self.functionals).repeat(outputs, axis=1))

    def take(self, chosen: NDArray[np.intp] | slice) -> Database:
        """The chosen points."""
        return Database(self.functionals.take(chosen), self.reference.take(chosen))

    def joined(self, other: Database) -> Database:
        """These points, then the others."""
        functionals = Functionals.concatenated([self.functionals, other.functionals])
        return Database(functionals, Gaussians.concatenated([self.reference, other.reference]))

    def unchanged(self) -> Changes:
        """The empty set of changes."""
        nothing = frozen(np.empty(0, dtype=np.intp))
        return Changes(nothing, Functionals(self.inputs[:0]), self.reference.take(slice(0, 0)))

    def changed(self, changes: Changes) -> Database:
        """The database after the changes: the points not replaced, then the via-points."""
        remaining = self
        if len(changes.replaced):
            remaining = self.take(np.delete(np.arange(len(self)), changes.replaced))
        return remaining.joined(changes.added)

    def spacing(self, period: float | None) -> float:
        """Median distance [unit of inputs] of a value to its nearest neighbour; 0 without any."""
        values = np.unique(self.inputs[self.functionals.values], axis=0)
        if len(values) < _PAIR:
            return 0.0
        if period is not None:
            values = np.unique(values % period, axis=0)
            gaps = np.diff(values[:, 0], append=values[0, 0] + period)
            return float(np.median(np.minimum(gaps, np.roll(gaps, 1))))
        distances, _ = cKDTree(values).query(values, k=[2])
        return float(np.median(distances))

    def nearest(
        self, via: Functionals, tolerance: float, period: float | None
    ) -> list[NDArray[np.intp]]:
        """The indices, ascending, of the values that each via-point (V,) replaces: those nearest to
        it within the tolerance.

        `tolerance` and `period` [unit of the inputs]. Derivatives neither replace a point nor are
        replaced.
        """
        replaced = [np.empty(0, dtype=np.intp)] * len(via)
        if tolerance == 0:
            return replaced
        values = np.flatnonzero(via.values)
        step = max(1, DISTANCES // len(self))
        for i in range(0, len(values), step):
            block = values[i : i + step]
            distance = _distances(via.inputs[block], self.inputs, period)  # (V, N)
            if self.functionals.directions is not None:
                distance[:, ~self.functionals.values] = np.inf
            least = distance.min(axis=1)
            for n in np.flatnonzero(least < tolerance):
                replaced[block[n]] = np.flatnonzero(distance[n] == least[n])
        return replaced


def _distances(a: Array, b: Array, period: float | None) -> Array:
    """Distances |a - b| (A, B) of a (A, I) and b (B, I), modulo the period if there is one."""
    if period is None:
        return cdist(a, b)
    r = np.abs(a - b.T) % period
    return np.asarray(np.minimum(r, period - r))


def warn_of_missed(desired: Gaussians, mean: Array, parameters: Hyperparameters) -> None:
    """Warn of the desired points that the mean (V, O) misses.

    The error r of a channel is a miss if |r / prior deviation| > 0.001 and sqrt(r^T Sigma^-1 r) >
    3.
    """
    channels = parameters.kernel.channels
    d = parameters.channel_outputs
    residual = (desired.mean - mean).reshape(len(mean), channels, d)
    units = parameters.prior_deviations.reshape(channels, d)
    is_far = np.linalg.norm(residual / units, axis=2) > _MISSED_SHARE  # (V, C)
    if not is_far.any():
        return
    distance = np.linalg.norm(residual, axis=2)
    missed = []
    for c in range(channels):
        block = desired.covariance[:, c * d : (c + 1) * d, c * d : (c + 1) * d]
        pull = np.linalg.solve(block, residual[:, c, :, None])[:, :, 0]
        deviations = np.sqrt(np.vecdot(residual[:, c], pull))
        for n in np.flatnonzero(is_far[:, c] & (deviations > _MISSED_DEVIATIONS)):
            missed.append(f"{n} by {distance[n, c]:.3g} ({deviations[n]:.3g} deviations)")
    if missed:
        more = f" and {len(missed) - _NAMED} more" if len(missed) > _NAMED else ""
        warnings.warn(
            f"Via-points missed [unit of the outputs]: {', '.join(missed[:_NAMED])}{more}. Another "
            "point near in the inputs requires another value, or lambda is large: give the "
            "via-point less variance, replace what is near by a larger tolerance, or take a "
            "larger ell.",
            ViaPointMissed,
            stacklevel=4,
        )
