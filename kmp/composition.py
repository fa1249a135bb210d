"""Sums and products of kernels. Rasmussen and Williams 2006, section 4.2.4.

The product rule: D_u (k k') = D_u k k' + k D_u k', and so on for each further direction.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import compress, product
from typing import ClassVar

import numpy as np

from kmp.arrays.checks import Array, positive
from kmp.arrays.immutable import Immutable, frozen
from kmp.kernel import (
    Kernel,
    checked_kernel,
    derivative,
    directed,
    missing_members,
    unstretched,
)


class Composable:
    """The operators of kernels: `a + b`, `a * b` and `0.5 * a`."""

    __array_ufunc__ = None  # np.float64(0.5) * kernel is computed by __rmul__

    def __add__(self: Kernel, other: Kernel) -> SumKernel:
        if missing_members(other):
            return NotImplemented
        (parts, factors), (others, other_factors) = _terms(self), _terms(other)
        return SumKernel(parts + others, factors + other_factors)

    def __mul__(self: Kernel, other: Kernel | float) -> SumKernel | ProductKernel:
        if isinstance(other, (int, float, np.number)):
            factor = positive("factor of a kernel", other)
            parts, factors = _terms(self)
            return SumKernel(parts, tuple(factor * each for each in factors))
        return NotImplemented if missing_members(other) else ProductKernel((self, other))

    def __rmul__(self: Kernel, other: float) -> SumKernel | ProductKernel:
        return Composable.__mul__(self, other)


@dataclass(frozen=True, repr=False)
class _Composite(Composable, Immutable):
    """A kernel made of others, each of one channel."""

    channels: ClassVar[int] = 1
    parts: tuple[Kernel, ...]

    def __post_init__(self) -> None:
        for part in self.parts:
            if checked_kernel(part).channels > 1:
                raise ValueError(
                    f"kernel: {part} has rates among its outputs, so it cannot be a part of a sum "
                    "or product. Give kernels of values, and `directions` for rates."
                )

    @property
    def period(self) -> float | None:
        """The period that all parts have; None if they differ."""
        periods = {part.period for part in self.parts}
        return periods.pop() if len(periods) == 1 else None

    @property
    @abstractmethod
    def ell(self) -> float | Array:
        """The parameter of the sharpest part of a sum, or the sum over a product's parts."""

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError unless the inputs and outputs fit each part."""
        for part in self.parts:
            part.check(inputs, outputs)


@dataclass(frozen=True, repr=False)
class SumKernel(_Composite):
    """The sum of kernels, each times a factor: sum_p c_p k_p(s, s')."""

    factors: tuple[float, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for factor in self.factors:
            positive("factor of a kernel", factor)

    def __repr__(self) -> str:
        terms = zip(self.factors, self.parts, strict=True)
        return " + ".join(
            f"{factor!r} * {part}" if factor != 1 else f"{part}" for factor, part in terms
        )

    @property
    def ell(self) -> float | Array:
        return reduce(np.maximum, [part.ell for part in self.parts])

    @cached_property
    def prior_variance(self) -> Array:
        return frozen(self._sum(part.prior_variance for part in self.parts))

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        return self._sum(part(a, b, along_a, along_b) for part in self.parts)

    def variances(self, along: Array) -> Array:
        return self._sum(part.variances(along) for part in self.parts)

    def derivative(self, offsets: Array, directions: tuple[Array, ...]) -> Array:
        return self._sum(derivative(part, offsets, directions) for part in self.parts)

    def _sum(self, values: Iterable[Array]) -> Array:
        terms = (factor * value for factor, value in zip(self.factors, values, strict=True))
        return reduce(np.add, terms)


@dataclass(frozen=True, repr=False)
class ProductKernel(_Composite):
    """The product of two kernels: k(s, s') k'(s, s')."""

    def __repr__(self) -> str:
        return " * ".join(
            f"({part})" if isinstance(part, SumKernel) else f"{part}" for part in self.parts
        )

    @property
    def ell(self) -> float | Array:
        first, second = self.parts
        return first.ell + second.ell

    @cached_property
    def prior_variance(self) -> Array:
        first, second = self.parts
        return frozen(first.prior_variance * second.prior_variance)

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        first, second = (part(a, b) for part in self.parts)
        k = first * second
        if along_a is None and along_b is None:
            return k
        i, u = directed(along_a, unstretched(a.shape[1]))
        j, v = directed(along_b, unstretched(a.shape[1]))
        both = np.ix_(i, j)
        by_a = [part(a[i], b, u) for part in self.parts]
        by_b = [part(a, b[j], None, v) for part in self.parts]
        by_both = [part(a[i], b[j], u, v) for part in self.parts]
        mixed = by_both[0] * second[both] + first[both] * by_both[1]
        mixed += by_a[0][:, j] * by_b[1][i] + by_b[0][i] * by_a[1][:, j]
        k[i] = by_a[0] * second[i] + first[i] * by_a[1]
        k[:, j] = by_b[0] * second[:, j] + first[:, j] * by_b[1]
        k[both] = mixed
        return k

    def variances(self, along: Array) -> Array:
        first, second = (part.variances(along) for part in self.parts)
        first_value, second_value = (part.prior_variance[0] for part in self.parts)
        of_derivatives = first * second_value + first_value * second
        return np.where(along.any(axis=1, keepdims=True), of_derivatives, first * second)

    def derivative(self, offsets: Array, directions: tuple[Array, ...]) -> Array:
        """The sum over all ways to share the directions between the two kernels."""
        first, second = self.parts
        total = np.zeros(len(offsets))
        for shares in product((True, False), repeat=len(directions)):
            of_first = tuple(compress(directions, shares))
            of_second = tuple(compress(directions, np.logical_not(shares)))
            total += derivative(first, offsets, of_first) * derivative(second, offsets, of_second)
        return total


def _terms(kernel: Kernel) -> tuple[tuple[Kernel, ...], tuple[float, ...]]:
    """The parts and factors of a sum; a kernel of another kind is its only part."""
    return (kernel.parts, kernel.factors) if isinstance(kernel, SumKernel) else ((kernel,), (1.0,))
