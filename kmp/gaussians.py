"""Normal distributions N(mu_n, Sigma_n) as one value: references, via-points, predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import Array, check_finite, check_kind, numbers, parts_of, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import symmetric

_SYMMETRIC = 1e-9  # largest asymmetry that counts as rounding, as a share of the largest entry
_EXACT = 1e-200  # [unit^2] the variance that stands for an exact output
_EXACT_BELOW = 1e-150  # [unit^2] a smaller variance is exact: rotation and scaling enlarge _EXACT
_FREE = 1e100  # [unit^2] the variance that stands for a free output
_FREE_ABOVE = 1e90
_MACHINE = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians(Immutable):
    """N normal distributions over O outputs: mean (N, O) [unit], covariance (N, O, O) [unit^2].

    Read-only. Raises ValueError if a number is not finite, shapes do not agree, or a covariance is
    not symmetric and positive definite.
    """

    mean: Array
    covariance: Array

    def __post_init__(self) -> None:
        mean = numbers("mean", self.mean, "N", "O")
        self.__dict__.update(
            mean=mean, covariance=covariances("covariance", self.covariance, *mean.shape)
        )

    @classmethod
    def of(cls, mean: ArrayLike, *, deviation: ArrayLike) -> Gaussians:
        """The normals of means (N, O), or of one (O,), with independent outputs.

        deviation [unit of the outputs]: one number for all, or one for each output (O,), or for
        each number (N, O). 0 stands for an exact output: whatever is fitted to it takes the least
        variance that rounding does not hide. Infinity stands for a free output.

        Raises ValueError if a number is not finite, shapes do not agree, or a deviation is below 0.
        """
        array = real("mean", mean)
        means = numbers("mean", array[None] if array.ndim == 1 else array, "N", "O")
        deviations = real("deviation", deviation)
        if deviations.shape not in {(), means.shape[1:], means.shape}:
            shape_text = f"(), {means.shape[1:]} or {means.shape}"
            raise ValueError(
                f"deviation: shape {deviations.shape} given, {shape_text} needed for a mean of "
                f"{means.shape}."
            )
        is_free = deviations == np.inf
        deviations = np.where(is_free, 0.0, deviations)
        check_finite("deviation", deviations)
        if (deviations < 0).any():
            raise ValueError(
                f"deviation: {deviations.min():g} given, and it must not be below 0. 0 means exact."
            )
        variances = np.maximum(deviations**2, _EXACT)
        check_finite("deviation", variances, "too large for its square:")
        variances = np.broadcast_to(np.where(is_free, _FREE, variances), means.shape)
        return unchecked(means.copy(), variances[:, :, None] * np.eye(means.shape[1]))

    @property
    def exact(self) -> NDArray[np.bool_]:
        """(N, O) true where an output is exact: its deviation in `of` was 0."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2) < _EXACT_BELOW)

    @property
    def free(self) -> NDArray[np.bool_]:
        """(N, O) true where an output is free: its deviation in `of` was infinite."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2) > _FREE_ABOVE)

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def outputs(self) -> int:
        """O, the number of dimensions."""
        return int(self.mean.shape[1])

    def __getitem__(self, index: int | slice | NDArray[Any] | Sequence[int]) -> Gaussians:
        """The distributions that NumPy's indexing chooses; a single one is a `Gaussians` of N = 1.

        Raises IndexError if an index is out of range.
        """
        chosen = np.arange(len(self))[index]
        return self.take(np.atleast_1d(chosen))

    def __repr__(self) -> str:
        return f"Gaussians({len(self)} over {self.outputs} outputs)"

    def take(self, index: NDArray[Any] | slice) -> Gaussians:
        """The chosen distributions, in the order of the index. Raises IndexError out of range."""
        return unchecked(self.mean[index].copy(), self.covariance[index].copy())

    def affine(self, matrix: ArrayLike, offset: ArrayLike) -> Gaussians:
        """The distributions of A x + b: (A mu + b, A Sigma A^T), with A (P, O) and b (P,).

        Raises ValueError if the shapes do not agree, or the rank of A is below P.
        """
        a = numbers("matrix", matrix, "P", self.outputs)
        b = numbers("offset", offset, len(a))
        covariance = covariances(
            "matrix: covariance", symmetric(a @ self.covariance @ a.T), len(self), len(a)
        )
        return Gaussians(self.mean @ a.T + b, covariance)

    def product(self, *others: Gaussians) -> Gaussians:
        """The normalised products with others, element by element; a small variance weighs more.

        Sigma = (sum_l Sigma_l^-1)^-1, mu = Sigma sum_l Sigma_l^-1 mu_l. Raises ValueError if the
        shapes differ.
        """
        factors = (self, *others)
        check_alike("product", factors)
        precisions = [np.linalg.inv(factor.covariance) for factor in factors]
        covariance = symmetric(np.linalg.inv(np.sum(precisions, axis=0)))
        return Gaussians(fused_mean(covariance, precisions, factors), covariance)

    @staticmethod
    def concatenated(parts: Sequence[Gaussians]) -> Gaussians:
        """All distributions of the parts, in order. Raises ValueError if O differs."""
        for i, part in enumerate(parts_of("parts", parts)):
            check_gaussians(f"parts[{i}]", part, parts[0].outputs if i else None)
        if len(nonempty := [part for part in parts if len(part)]) == 1:
            return nonempty[0]
        return unchecked(
            np.concatenate([part.mean for part in parts]),
            np.concatenate([part.covariance for part in parts]),
        )


def unchecked(mean: Array, covariance: Array) -> Gaussians:
    """Gaussians of arrays that are correct by construction: frozen, not checked, not copied."""
    self = object.__new__(Gaussians)
    self.__dict__.update(mean=frozen(mean), covariance=frozen(covariance))
    return self


def fused_mean(
    covariance: Array, precisions: Sequence[NDArray[Any]], factors: Sequence[Gaussians]
) -> Array:
    """Sigma sum_l P_l mu_l (N, O), of precisions P_l and a covariance Sigma (N, O, O)."""
    pulls = [
        precision @ factor.mean[:, :, None]
        for precision, factor in zip(precisions, factors, strict=True)
    ]
    return np.asarray((covariance @ np.sum(pulls, axis=0))[:, :, 0])


def check_gaussians(name: str, value: object, outputs: int | None = None) -> None:
    """Raise ValueError unless the value is `Gaussians`, over this number of outputs."""
    check_kind(name, value, Gaussians, "Gaussians(mean (N, O), covariance (N, O, O))")
    if outputs is not None and isinstance(value, Gaussians) and value.outputs != outputs:
        raise ValueError(f"{name}: normals over {value.outputs} outputs given, {outputs} needed.")


def check_alike(name: str, parts: Sequence[Gaussians]) -> None:
    """Raise ValueError unless the parts are as many normals each, over the same outputs."""
    for i, part in enumerate(parts):
        check_gaussians(f"{name}[{i}]", part)
        needed = parts[0].mean.shape
        if part.mean.shape != needed:
            raise ValueError(
                f"{name}[{i}]: means of shape {part.mean.shape} given, {needed} needed."
            )


def check_pairs(name: str, inputs: Array, points: Gaussians, outputs: int) -> None:
    """Raise ValueError unless each input (N, I) has one normal, over this number of outputs."""
    check_gaussians(name, points)
    if points.mean.shape != (len(inputs), outputs):
        n = len(inputs)
        points_text = f"{len(points)} normals over {points.outputs} outputs"
        raise ValueError(f"{name}: {points_text} given for {n} inputs; {n} over {outputs} needed.")


def covariances(name: str, value: ArrayLike, count: int, outputs: int) -> Array:
    """Covariances (N, O, O). Raises ValueError unless they are symmetric and positive definite."""
    covariance = numbers(name, value, count, outputs, outputs)
    if covariance.size == 0:
        return covariance
    size = np.abs(covariance).max(axis=(1, 2))
    lopsided = np.abs(covariance - covariance.mT).max(axis=(1, 2))
    for n in np.flatnonzero(lopsided > _SYMMETRIC * size)[:1]:
        fault = f"is not symmetric: it differs from its transpose by up to {lopsided[n]:.3g}"
        raise ValueError(f"{name}[{n}] {fault}. Give (C + C^T) / 2 if that is what is meant.")
    covariance = symmetric(covariance)
    for n in np.flatnonzero(~_is_definite(covariance))[:1]:
        smallest = np.linalg.eigvalsh(covariance[n])[0]
        raise ValueError(
            f"{name}[{n}] is not positive definite: its smallest eigenvalue is {smallest:.3g}, "
            "and must be above 0. Add a small variance to the diagonal: (deviation that may be "
            "ignored)^2."
        )
    return frozen(covariance)


def _is_definite(covariance: Array) -> NDArray[np.bool_]:
    """(N,) true where the correlations are positive definite, whatever the outputs' sizes."""
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    deviations = np.sqrt(np.where(variances > 0, variances, 1.0))
    correlation = covariance / deviations[:, :, None] / deviations[:, None, :]
    rounding = covariance.shape[1] * _MACHINE
    try:
        np.linalg.cholesky(correlation - rounding * np.eye(covariance.shape[1]))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(correlation)[:, 0] > rounding)
    return np.ones(len(covariance), dtype=bool)
