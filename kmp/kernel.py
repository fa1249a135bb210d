"""The kernels that stand for the basis functions: how alike two inputs are. Equation (7).

A kernel has C channels: 1 where the outputs are values, 2 where they are a value and its rate. Rows
and columns of its matrices are (point, channel), the channel running faster, so that the O = C D
outputs share each entry D times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from scipy.spatial.distance import cdist

from kmp.checks import Array, numbers, positive
from kmp.immutable import Immutable, frozen


class Kernel(Protocol):
    """What a primitive asks of its kernel. R centres, I inputs, C channels, D outputs a channel.

    `values`, `row`, `jacobian` and `curvature` serve one query s, where microseconds count. They
    are functions of arrays alone, in the coordinates x = stretch * s, in which one scale serves all
    inputs: of the offsets x - x_r (R, I) from the centres, and of the values (R,) there.
    """

    @property
    def ell(self) -> float | Array:
        """The parameter [1 / (unit of the inputs)^2]."""

    @property
    def channels(self) -> int:
        """C."""

    @property
    def prior_variance(self) -> Array:
        """k(s, s) (C, C), the same at every input."""

    def check(self, inputs: int, outputs: int) -> None:
        """Raises ValueError where the kernel does not go with so many inputs and outputs."""

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        """The scale, and the stretch (I,) of each input."""

    def __call__(self, a: Array, b: Array) -> Array:
        """k(a, b) for every pair: (A, I), (B, I) -> (A C, B C)."""

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        """exp(-scale |x - x_r|^2): (R,)."""

    @staticmethod
    def row(offsets: Array, values: Array, scale: float) -> Array:
        """k(s, s_r): (R,) where C is 1, else (C, R C)."""

    @staticmethod
    def jacobian(offsets: Array, values: Array, scale: float, weight_rows: Array) -> Array:
        """d/dx of sum_r k(s, s_r) w_r, with the weights' rows (D, R C): (O, I)."""

    @staticmethod
    def curvature(offsets: Array, values: Array, scale: float, weights: Array, direction: Array) -> Array:
        """d^2/dt^2 of that sum at x + t v for t = 0, with v (I,) and the weights (R C, D): (O,)."""


@dataclass(frozen=True, eq=False)
class GaussianKernel(Immutable):
    """k(s, s') = exp(-ell |s - s'|^2), `ell` in 1 / (unit of the inputs)^2. The paper, section III.

    Given as an array (I,), `ell` has one value for each input, to multiply (s_i - s'_i)^2 with. The
    methods are those of `Kernel`. Raises ValueError unless every ell is finite and above 0.
    """

    channels: ClassVar[int] = 1
    ell: float | Array

    def __post_init__(self) -> None:
        if np.ndim(self.ell) == 0:
            object.__setattr__(self, "ell", positive("ell", float(self.ell)))
            return
        ell = numbers("ell", self.ell, "I")
        for i, value in enumerate(ell):
            positive(f"ell[{i}]", value)
        object.__setattr__(self, "ell", ell)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, GaussianKernel) and np.array_equal(self.ell, other.ell)

    def __hash__(self) -> int:
        return hash(np.asarray(self.ell).tobytes())

    @cached_property
    def prior_variance(self) -> Array:
        return frozen(np.ones((1, 1)))

    def check(self, inputs: int, outputs: int) -> None:
        """Raises ValueError unless there is one ell for each input, or one for all."""
        if np.ndim(self.ell) and np.size(self.ell) != inputs:
            raise ValueError(f"ell: {np.size(self.ell)} values given, 1 or {inputs} needed for {inputs} inputs.")

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        if np.ndim(self.ell):
            return 1.0, frozen(np.sqrt(self.ell))
        return float(self.ell), frozen(np.ones(inputs))

    def __call__(self, a: Array, b: Array) -> Array:
        scale, stretch = self.coordinates(a.shape[1])
        return np.exp(-scale * cdist(a * stretch, b * stretch, "sqeuclidean"))

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        value = np.vecdot(offsets, offsets)
        value *= -scale
        return np.asarray(np.exp(value, value))

    @staticmethod
    def row(offsets: Array, values: Array, scale: float) -> Array:
        return values

    @staticmethod
    def jacobian(offsets: Array, values: Array, scale: float, weight_rows: Array) -> Array:
        return np.asarray((weight_rows * (values * (-2 * scale))) @ offsets)

    @staticmethod
    def curvature(offsets: Array, values: Array, scale: float, weights: Array, direction: Array) -> Array:
        slope = (2 * scale) * (offsets @ direction)
        return np.asarray((values * (slope * slope - 2 * scale * float(direction @ direction))) @ weights)


@dataclass(frozen=True)
class VelocityKernel(Immutable):
    """The kernel of skills over time whose 2 D outputs are a value and its rate: [xi, dxi/dt].

    k(t, t') and its derivatives, exact, so that a via-point can fix the velocity too (IJRR 2019, on
    time-driven trajectories). With r = t - t' the block of two points is
    [[k, 2 ell r k], [-2 ell r k, (2 ell - 4 ell^2 r^2) k]]; `ell` in 1 / (unit of time)^2. It
    takes one input. The methods are those of `Kernel`. Raises ValueError unless ell is finite and
    above 0.
    """

    channels: ClassVar[int] = 2
    ell: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "ell", positive("ell", self.ell))

    @cached_property
    def prior_variance(self) -> Array:
        return frozen(np.diag([1.0, 2 * self.ell]))

    def check(self, inputs: int, outputs: int) -> None:
        """Raises ValueError unless there is one input, and there are as many rates as values."""
        if inputs != 1 or outputs % 2:
            raise ValueError(
                f"{inputs} inputs and {outputs} outputs given; value and rate over time need "
                "1 input and an even number of outputs: the values, then their rates."
            )

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        return self.ell, frozen(np.ones(inputs))

    def __call__(self, a: Array, b: Array) -> Array:
        r = a - b.T
        blocks = _rate_blocks(r, np.exp(-self.ell * r * r), self.ell, order=0)
        return blocks.transpose(0, 2, 1, 3).reshape(2 * len(a), 2 * len(b))

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        r = offsets[:, 0]
        return np.asarray(np.exp(-scale * r * r))

    @staticmethod
    def row(offsets: Array, values: Array, scale: float, order: int = 0) -> Array:
        """The row, or its derivative of that order by t."""
        blocks = _rate_blocks(offsets[:, 0], values, scale, order)
        return np.ascontiguousarray(blocks.transpose(1, 0, 2)).reshape(2, -1)

    @staticmethod
    def jacobian(offsets: Array, values: Array, scale: float, weight_rows: Array) -> Array:
        return np.asarray((VelocityKernel.row(offsets, values, scale, 1) @ weight_rows.T).reshape(-1, 1))

    @staticmethod
    def curvature(offsets: Array, values: Array, scale: float, weights: Array, direction: Array) -> Array:
        row = VelocityKernel.row(offsets, values, scale, 2)
        return np.asarray((row @ weights).ravel() * float(direction @ direction))


def _rate_blocks(r: Array, values: Array, ell: float, order: int) -> Array:
    """The derivative of that order by t of the kernel's blocks at r = t - t' (...): (..., 2, 2)."""
    # k^(n+1) = -2 ell (r k^(n) + n k^(n-1)); d/dt is d/dr and d/dt' is -d/dr.
    k = [values, -2 * ell * r * values]
    for n in range(1, order + 2):
        k.append(-2 * ell * (r * k[n] + n * k[n - 1]))
    a, b, c = k[order : order + 3]
    return np.stack([a, -b, b, -c], axis=-1).reshape(*r.shape, 2, 2)
