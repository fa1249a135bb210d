"""Features of the kernel: k(s, s') = z(s) z(s')^T + what is left, by a pivoted Cholesky decomposition.

The Gaussian kernel of smooth data has a small numerical rank: r features, each made at one of the inputs (its pivot),
leave at each input a share of k(s, s) below a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.checks import Array
from kmp.immutable import Immutable, frozen
from kmp.kernel import Kernel

_CANDIDATES = 4096  # inputs among which pivots are sought at once
_ROUNDS = 6
_MARGIN = 0.25  # of the tolerance, for the inputs that are no candidates
_BLOCK = 8192  # rows at once, which bounds the memory
FLOOR = 1e-14  # of k(s, s): below it the share left is rounding


@dataclass(frozen=True, eq=False)
class Features(Immutable):
    """z(s) = L^-1 k(S_p, s), with the pivots S_p (r, I) and L the Cholesky factor of their kernel matrix. Read-only."""

    kernel: Kernel
    pivots: Array

    @classmethod
    def of(cls, kernel: Kernel, inputs: Array, *, rank: int, tolerance: float) -> tuple[Features, float]:
        """The features of inputs (N, I), no more than `rank`, and the largest share that they leave at an input.

        That share is no more than `tolerance`, unless the rank does not reach so far.
        """
        count = len(inputs)
        index = np.linspace(0, count - 1, min(count, _CANDIDATES)).astype(np.intp)
        for _ in range(_ROUNDS):
            chosen = _pivots(kernel, inputs[index], rank, _MARGIN * tolerance)
            found = cls(kernel, frozen(inputs[index[chosen]])).usable()
            left = np.concatenate([found.left(inputs[i : i + _BLOCK])[:, 0] for i in range(0, count, _BLOCK)])
            worst = np.argsort(-left, kind="stable")[: _CANDIDATES // 2]
            worst = np.setdiff1d(worst[left[worst] > tolerance], index)
            if len(worst) == 0 or len(found.pivots) >= rank:
                break
            index = np.union1d(index, worst)
        return found, float(left.max())

    def usable(self) -> Features:
        """The same, without the last pivots if those are no longer told from rounding."""
        factor, info = self._factorised()
        if not info:
            self.__dict__["root"] = factor
            return self
        return Features(self.kernel, frozen(self.pivots[: info - 1].copy())).usable()

    @cached_property
    def root(self) -> Array:
        """L (r, r)."""
        return self._factorised()[0]

    def __call__(self, inputs: Array) -> Array:
        """z at inputs (n, I), for each channel: (r, n C)."""
        lifted = self.kernel(inputs, self.pivots)[:, :: self.kernel.channels]
        return self.whitened(lifted.T)

    def whitened(self, columns: Array) -> Array:
        """L^-1 times columns (r, n) of the pivots' kernels."""
        return np.asarray(lapack.dtrtrs(self.root, columns, lower=1)[0])

    def weights(self, w: Array) -> Array:
        """What the pivots' kernels are weighted with, where the features are with w (r, D): (r, O)."""
        found = lapack.dtrtrs(self.root, w, lower=1, trans=1)[0]
        spread = np.zeros((len(w), self.kernel.channels, w.shape[1]))
        spread[:, 0] = found
        return spread.reshape(len(w), -1)

    def left(self, inputs: Array) -> Array:
        """k(s, s) - |z(s)|^2 at inputs (n, I), for each channel, as a share of k(s, s): (n, C), not below rounding."""
        z = self(inputs)
        own = np.diagonal(self.kernel.own)
        shares = 1 - (z * z).sum(axis=0).reshape(len(inputs), -1) / own
        return np.asarray(np.maximum(shares, FLOOR))

    def _factorised(self) -> tuple[Array, int]:
        c = self.kernel.channels
        factor, info = lapack.dpotrf(self.kernel(self.pivots, self.pivots)[::c, ::c], lower=1, clean=1)
        return frozen(np.asfortranarray(factor)), int(info)


def _pivots(kernel: Kernel, inputs: Array, rank: int, tolerance: float) -> NDArray[np.intp]:
    """Which inputs make the best pivots, greedily: where most is left. Pivoted Cholesky."""
    c = kernel.channels
    left = np.ones(len(inputs))
    columns = np.empty((min(rank, len(inputs)), len(inputs)))
    chosen: list[int] = []
    for j in range(len(columns)):
        n = int(left.argmax())
        if left[n] <= tolerance:
            break
        column = kernel(inputs[n : n + 1], inputs)[0, ::c] - columns[:j, n] @ columns[:j]
        columns[j] = column / np.sqrt(left[n])
        left -= columns[j] ** 2
        left[n] = 0
        chosen.append(n)
    return np.array(chosen, dtype=np.intp)
