"""The kernels that stand for the basis functions: how alike two inputs are (the paper, equation (7)).

A kernel has C channels: 1 where the outputs are values, 2 where they are a value and its rate. Rows and columns of its
matrices are (point, channel), the channel running faster, so that O = C D outputs share each entry D times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.distance import cdist

from kmp.checks import Array, numbers, positive
from kmp.immutable import Immutable, frozen


class Kernel(Protocol):
    """What a primitive asks of its kernel. R centres, I inputs, C channels, D outputs a channel, O = C D."""

    @property
    def ell(self) -> float | Array:
        """[1 / (unit of the inputs)^2] the parameter."""

    @property
    def channels(self) -> int:
        """C."""

    @property
    def own(self) -> Array:
        """k(s, s) (C, C), the same at every input."""

    def check(self, inputs: int, outputs: int) -> None:
        """Raises ValueError where the kernel does not go with so many inputs and outputs."""

    def __call__(self, a: Array, b: Array) -> Array:
        """k(a, b) for every pair: (A, I), (B, I) -> (A C, B C)."""

    def row_at(self, offsets: Array) -> Array:
        """k(s, s_r) of one query, from s - s_r (R, I): (R,) or (C, R C)."""

    def jacobian_of(self, offsets: Array, rows: Array) -> Array:
        """d/ds of sum_r k(s, s_r) w_r, with rows (D, R C) of the weights: (O, I)."""

    def curvature_of(self, offsets: Array, direction: Array, weights: Array) -> Array:
        """d^2/dt^2 of sum_r k(s + t v, s_r) w_r at t = 0, with weights (R C, D): (O,)."""


def spread(blocks: Array, copies: int) -> Array:
    """x (x) I for blocks (..., C, C) and a unit matrix of size D = `copies`: (..., C D, C D)."""
    c = blocks.shape[-1]
    wide = blocks[..., :, None, :, None] * np.eye(copies)[:, None, :]
    return np.asarray(wide.reshape(*blocks.shape[:-2], c * copies, c * copies))


@dataclass(frozen=True, eq=False)
class GaussianKernel(Immutable):
    """The kernel k(s, s') = exp(-ell |s - s'|^2), section III of the paper; `ell` in 1 / (unit of the inputs)^2.

    Given as an array (I,), `ell` has one value for each input: k(s, s') = exp(-sum_i ell_i (s_i - s'_i)^2).

    Two sets of inputs go into the call and into `gradient`. The methods `..._at` and `..._of` are for one query at a
    time, where the microseconds count: they take its offsets s - s_n (N, I) from N inputs.
    """

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

    @property
    def channels(self) -> int:
        """1: the outputs are values."""
        return 1

    @cached_property
    def own(self) -> Array:
        """k(s, s) = 1."""
        return frozen(np.ones((1, 1)))

    @cached_property
    def _scalar(self) -> float:
        # The parameter in coordinates stretched so that one number does.
        return self.ell if isinstance(self.ell, float) else 1.0

    @cached_property
    def _stretch(self) -> Array | None:
        return None if isinstance(self.ell, float) else frozen(np.sqrt(self.ell))

    def check(self, inputs: int, outputs: int) -> None:
        """One ell for each input, or one for all."""
        if self._stretch is not None and len(self._stretch) != inputs:
            raise ValueError(f"ell: {len(self._stretch)} values given, 1 or {inputs} needed for {inputs} inputs.")

    def __call__(self, a: Array, b: Array) -> Array:
        """k(a, b) for every pair: (A, I), (B, I) -> (A, B)."""
        if self._stretch is not None:
            a, b = a * self._stretch, b * self._stretch
        return np.exp(-self._scalar * cdist(a, b, "sqeuclidean"))

    def gradient(self, a: Array, b: Array) -> Array:
        """dk(a, b)/da for every pair: (A, I), (B, I) -> (A, B, I)."""
        offsets = a[:, None, :] - b[None, :, :]
        return np.asarray(-2 * self.ell * self(a, b)[:, :, None] * offsets)

    def value_at(self, offsets: Array) -> Array:
        """k(s, s_n): (N, I) -> (N,)."""
        if self._stretch is not None:
            offsets = offsets * self._stretch
        value = np.vecdot(offsets, offsets)
        value *= -self._scalar
        return np.asarray(np.exp(value, value))

    row_at = value_at

    def slope_at(self, offsets: Array) -> Array:
        """What each offset is multiplied by to give dk(s, s_n)/ds, but for ell if that is an array: (N, I) -> (N,)."""
        value = self.value_at(offsets)
        value *= -2 * self._scalar
        return value

    def curvature_at(self, offsets: Array, direction: Array) -> Array:
        """d^2 k(s + t v, s_n)/dt^2 at t = 0 along the direction v: (N, I), (I,) -> (N,)."""
        value = self.value_at(offsets)
        if self._stretch is not None:
            offsets, direction = offsets * self._stretch, direction * self._stretch
        slope = (2 * self._scalar) * (offsets @ direction)
        return np.asarray(value * (slope * slope - 2 * self._scalar * float(direction @ direction)))

    def jacobian_of(self, offsets: Array, rows: Array) -> Array:
        """d/ds of sum_r k(s, s_r) w_r, rows (O, R): (O, I)."""
        jacobian = (rows * self.slope_at(offsets)) @ offsets
        return np.asarray(jacobian if self._stretch is None else jacobian * self.ell)

    def curvature_of(self, offsets: Array, direction: Array, weights: Array) -> Array:
        """d^2/dt^2 of sum_r k(s + t v, s_r) w_r at t = 0, weights (R, O): (O,)."""
        return self.curvature_at(offsets, direction) @ weights


@dataclass(frozen=True)
class VelocityKernel(Immutable):
    """The kernel of skills driven by time whose outputs are a value and its rate: [xi, dxi/dt], 2 D outputs.

    IJRR 2019, section on time-driven trajectories: k(t, t') and its derivatives, exact, so that a via-point can fix the
    velocity too. With r = t - t' the block of two points is [[k, 2 ell r k], [-2 ell r k, (2 ell - 4 ell^2 r^2) k]];
    `ell` in 1 / (unit of time)^2. One input.
    """

    ell: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "ell", positive("ell", self.ell))

    @property
    def channels(self) -> int:
        """2: value and rate."""
        return 2

    @cached_property
    def own(self) -> Array:
        """k(t, t) (2, 2)."""
        return frozen(np.diag([1.0, 2 * self.ell]))

    def check(self, inputs: int, outputs: int) -> None:
        """One input, and as many rates as values."""
        if inputs != 1 or outputs % 2:
            raise ValueError(
                f"{inputs} inputs and {outputs} outputs given; value and rate over time need "
                "1 input and an even number of outputs: the values, then their rates."
            )

    def __call__(self, a: Array, b: Array) -> Array:
        """k(a, b) for every pair: (A, 1), (B, 1) -> (2 A, 2 B)."""
        return self._blocks(a - b.T, 0).transpose(0, 2, 1, 3).reshape(2 * len(a), 2 * len(b))

    def row_at(self, offsets: Array) -> Array:
        """k(t, t_r): (R, 1) -> (2, 2 R)."""
        return self._row(offsets, 0)

    def jacobian_of(self, offsets: Array, rows: Array) -> Array:
        """d/dt of sum_r k(t, t_r) w_r, rows (D, 2 R): (O, 1)."""
        return np.asarray((self._row(offsets, 1) @ rows.T).reshape(-1, 1))

    def curvature_of(self, offsets: Array, direction: Array, weights: Array) -> Array:
        """d^2/dt^2 of sum_r k(t, t_r) w_r times the direction squared, weights (2 R, D): (O,)."""
        return np.asarray((self._row(offsets, 2) @ weights).ravel() * float(direction @ direction))

    def _row(self, offsets: Array, order: int) -> Array:
        blocks = self._blocks(offsets.T, order)[0]  # (R, 2, 2)
        return np.ascontiguousarray(blocks.transpose(1, 0, 2)).reshape(2, -1)

    def _blocks(self, r: Array, order: int) -> Array:
        """The derivative of that order with respect to t, r (A, B): (A, B, 2, 2)."""
        # k^(n+1) = -2 ell (r k^(n) + n k^(n-1)); d/dt is d/dr and d/dt' is -d/dr.
        k = [np.exp(-self.ell * r * r)]
        k.append(-2 * self.ell * r * k[0])
        for n in range(1, order + 2):
            k.append(-2 * self.ell * (r * k[n] + n * k[n - 1]))
        a, b, c = k[order : order + 3]
        return np.stack([a, -b, b, -c], axis=-1).reshape(*r.shape, 2, 2)
