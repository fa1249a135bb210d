"""Sums and products of kernels, which are kernels. Rasmussen and Williams 2006, section 4.2.4."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, ClassVar

import numpy as np

from kmp.arrays.checks import Array, positive
from kmp.arrays.immutable import Immutable, frozen
from kmp.kernel import Kernel, checked_kernel, third_derivative


class Composable(Immutable):
    """The operators of kernels: `a + b`, `a * b` and `0.5 * a`. The parts have one channel each."""

    __array_ufunc__ = None  # np.float64(0.5) * kernel is computed by __rmul__

    channels: ClassVar[int] = 1

    def __add__(self: Any, other: Kernel) -> SumKernel:
        return SumKernel(*zip(*_terms(self), *_terms(other), strict=True))

    def __mul__(self: Any, other: Kernel | float) -> SumKernel | ProductKernel:
        if not isinstance(other, (int, float, np.number)):
            return ProductKernel((self, other))
        factor = positive("factor of a kernel", other)
        return SumKernel(*zip(*((part, factor * c) for part, c in _terms(self)), strict=True))

    __rmul__ = __mul__

    @cached_property
    def prior_variance(self: Any) -> Array:
        """k(s, s) (1, 1)."""
        origin = np.zeros((1, np.size(self.ell)))
        return frozen(self(origin, origin))

    def variances(self: Any, along: Array) -> Array:
        """k (N, 1) of N functionals with themselves; zero for a value."""
        axes = np.eye(along.shape[1])
        across = self(0 * axes, 0 * axes, axes, axes)  # (I, I)
        squares = np.vecdot(along @ across, along)[:, None]
        return np.asarray(np.where(along.any(axis=1, keepdims=True), squares, self.prior_variance))


@dataclass(frozen=True, repr=False)
class _Composite(Composable):
    """A kernel made of others."""

    parts: tuple[Kernel, ...]

    def __post_init__(self) -> None:
        for part in self.parts:
            if checked_kernel(part).channels > 1:
                raise ValueError(
                    f"kernel: {part} has rates, and no sum or product: give kernels of values."
                )

    @property
    def ell(self) -> float | Array:
        """The sum of the parts': that of a product of Gaussian kernels, a bound for others."""
        return reduce(np.add, [part.ell for part in self.parts])

    @property
    def period(self) -> float | None:
        """The period that all parts have; None if they differ."""
        periods = {part.period for part in self.parts}
        return periods.pop() if len(periods) == 1 else None

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError unless the inputs and outputs fit each part."""
        for part in self.parts:
            part.check(inputs, outputs)


@dataclass(frozen=True, repr=False)
class SumKernel(_Composite):
    """The sum of kernels, each times a factor: sum_p c_p k_p(s, s')."""

    factors: tuple[float, ...]

    def __repr__(self) -> str:
        return " + ".join(f"{part}" if c == 1 else f"{c!r} * {part}" for part, c in _terms(self))

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        return self._sum(part(a, b, along_a, along_b) for part in self.parts)

    def third(self, offsets: Array, along: Array, direction: Array) -> Array:
        """As `third_derivative`."""
        return self._sum(third_derivative(part, offsets, along, direction) for part in self.parts)

    def _sum(self, values: Iterable[Array]) -> Array:
        return reduce(np.add, map(np.multiply, self.factors, values))


@dataclass(frozen=True, repr=False)
class ProductKernel(_Composite):
    """The product of two kernels: k(s, s') k'(s, s')."""

    def __repr__(self) -> str:
        return " * ".join(f"({part})" if "+" in f"{part}" else f"{part}" for part in self.parts)

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        (value, by_a, by_b, by_both), (value_2, by_a_2, by_b_2, by_both_2) = (
            (
                part(a, b),
                part(a, b, along_a),
                part(a, b, None, along_b),
                part(a, b, along_a, along_b),
            )
            for part in self.parts
        )
        if along_a is None and along_b is None:
            return value * value_2
        total = by_both * value_2 + by_a * by_b_2 + by_b * by_a_2 + value * by_both_2
        # a point that is a value is derived nowhere: each term is there twice
        return total / (_copies(along_a, a)[:, None] * _copies(along_b, b))


def _copies(along: Array | None, points: Array) -> Array:
    """1 for each point (A,) that is a derivative, 2 for a value."""
    return np.where(np.zeros(len(points)) if along is None else along.any(axis=1), 1.0, 2.0)


def _terms(kernel: Kernel) -> list[tuple[Kernel, float]]:
    """The parts and factors of a sum; a kernel of another kind is its only part."""
    if isinstance(kernel, SumKernel):
        return list(zip(kernel.parts, kernel.factors, strict=True))
    return [(kernel, 1.0)]
