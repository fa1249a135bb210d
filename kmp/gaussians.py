"""Normal distributions as one value: the reference database's mu_n and Sigma_n, via-points, and predictions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.checks import Array, ViaPointMissed, numbers
from kmp.immutable import Immutable, frozen

_SYMMETRIC = 1e-9  # of the largest entry: what rounding leaves in a covariance that was meant to be symmetric
_MISSED = 3.0  # of a via-point's deviations: more is a miss
_WORTH_SAYING = 1e-3  # [unit of the outputs] 1 mm, where that is the metre
_MACHINE = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Gaussians(Immutable):
    """N normal distributions over O outputs: mean (N, O) [unit], covariance (N, O, O) [unit^2]. Read-only.

    Each covariance is symmetric and positive definite, or the constructor says which is not.
    """

    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        mean = numbers("mean", self.mean, "N", "O")
        n, outputs = mean.shape
        covariance = numbers("covariance", self.covariance, n, outputs, outputs)
        _check_covariances("covariance", covariance)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", frozen(_symmetric(covariance)))

    @classmethod
    def trusted(cls, mean: Array, covariance: Array) -> Gaussians:
        """The distributions without check or copy, for results that are right by construction; freezes the arrays."""
        self = object.__new__(cls)
        mean.setflags(write=False)
        covariance.setflags(write=False)
        self.__dict__["mean"] = mean
        self.__dict__["covariance"] = covariance
        return self

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def outputs(self) -> int:
        """O, the number of dimensions."""
        return int(self.mean.shape[1])

    def take(self, index: NDArray[Any] | slice) -> Gaussians:
        """The chosen distributions, in the order of the index."""
        return Gaussians.trusted(self.mean[index].copy(), self.covariance[index].copy())

    def affine(self, matrix: ArrayLike, offset: ArrayLike) -> Gaussians:
        """The distributions of A x + b: (A mu + b, A Sigma A^T), with A (P, O) of rank P and b (P,)."""
        a = numbers("matrix", matrix, "P", self.outputs)
        b = numbers("offset", offset, len(a))
        return Gaussians(self.mean @ a.T + b, _symmetric(a @ self.covariance @ a.T))

    def product(self, *others: Gaussians) -> Gaussians:
        """The normalised product with others, one by one.

        Sigma = (sum_l Sigma_l^-1)^-1, mu = Sigma sum_l Sigma_l^-1 mu_l: what they agree on, the surer the stronger.
        """
        factors = (self, *others)
        for other in others:
            if other.mean.shape != self.mean.shape:
                raise ValueError(f"product: means of shape {other.mean.shape} given, {self.mean.shape} needed.")
        precisions = [np.linalg.inv(one.covariance) for one in factors]
        covariance = _symmetric(np.linalg.inv(np.sum(precisions, axis=0)))
        pulls = [precision @ one.mean[:, :, None] for precision, one in zip(precisions, factors, strict=True)]
        return Gaussians((covariance @ np.sum(pulls, axis=0))[:, :, 0], covariance)

    @staticmethod
    def concatenated(parts: Sequence[Gaussians]) -> Gaussians:
        """All distributions of the parts, in order."""
        return Gaussians.trusted(np.concatenate([part.mean for part in parts]), np.concatenate([part.covariance for part in parts]))


def _symmetric(covariance: Array) -> Array:
    # Leaves a symmetric array as it is, bit for bit.
    return np.asarray((covariance + covariance.swapaxes(1, 2)) / 2)


def _check_covariances(name: str, covariance: Array) -> None:
    if covariance.size == 0:
        return
    size = np.abs(covariance).max(axis=(1, 2))
    lopsided = np.abs(covariance - covariance.swapaxes(1, 2)).max(axis=(1, 2))
    for n in np.flatnonzero(lopsided > _SYMMETRIC * size)[:1]:
        raise ValueError(
            f"{name}[{n}] is not symmetric: it differs from its transpose by up to {lopsided[n]:.3g}. Give (C + C^T) / 2 if that is what is meant."
        )
    smallest = np.linalg.eigvalsh(covariance)[:, 0]
    for n in np.flatnonzero(smallest <= covariance.shape[1] * _MACHINE * size)[:1]:
        raise ValueError(
            f"{name}[{n}] is not positive definite: its smallest eigenvalue is {smallest[n]:.3g}, and must be above 0. "
            "Add a small variance to the diagonal: (deviation that may be ignored)^2."
        )


def check_pairs(inputs: Array, points: Gaussians, outputs: int) -> None:
    """Raises ValueError unless there is one normal over that many outputs for each input (N, I)."""
    if points.mean.shape != (len(inputs), outputs):
        raise ValueError(f"{len(points)} normals over {points.outputs} outputs given for {len(inputs)} inputs; {len(inputs)} over {outputs} needed.")


def warn_of_missed(desired: Gaussians, mean: Array, channels: int) -> None:
    """Warns of the desired points that the mean (V, O) is far from, in their deviations and in the unit."""
    count, d = len(mean), desired.outputs // channels
    miss = (desired.mean - mean).reshape(count, channels, d)
    far = np.sqrt((miss * miss).sum(axis=2))  # (V, C)
    if not (far > _WORTH_SAYING).any():
        return
    told = []
    for c in range(channels):
        block = desired.covariance[:, c * d : (c + 1) * d, c * d : (c + 1) * d]
        deviations = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(block), miss[:, c, :, None]), axis=(1, 2))
        told += [
            f"{n} by {far[n, c]:.3g} ({deviations[n]:.3g} deviations)" for n in np.flatnonzero((far[:, c] > _WORTH_SAYING) & (deviations > _MISSED))
        ]
    if told:
        warnings.warn(
            f"Via-points missed [unit of the outputs]: {', '.join(told)}. Another point near in the inputs asks for "
            "something else, or lambda is large: give the via-point less variance, replace what is near by a "
            "larger tolerance, or take a larger ell.",
            ViaPointMissed,
            stacklevel=3,
        )
