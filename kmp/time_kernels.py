"""Kernels of one input, time or phase: with rates among the outputs, or periodic.

With r = x - x' in the kernel's coordinates, each needs the derivatives d^n/dr^n of its block (C, C)
of two points: d/dx is d/dr, and d/dx' is -d/dr.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from kmp.arrays.checks import Array, positive
from kmp.arrays.immutable import frozen
from kmp.composition import Composable
from kmp.kernel import directed, unstretched


@dataclass(frozen=True)
class _OneInput(Composable):
    """A kernel of one input, defined by its blocks' derivatives with respect to r = x - x'."""

    ell: float

    @staticmethod
    @abstractmethod
    def values(offsets: Array, scale: float) -> Array:
        """k of values (R,) at offsets (R, 1)."""

    @staticmethod
    @abstractmethod
    def blocks(r: Array, values: Array, scale: float, order: int) -> Array:
        """d^order/dr^order of the blocks (..., C, C) of two points, at r (...)."""

    @abstractmethod
    def coordinates(self, inputs: int) -> tuple[float, Array]:
        """The scale, and the stretch (1,)."""

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        scale, stretch = self.coordinates(1)
        r = a * stretch - (b * stretch).T
        values = self.values(r.reshape(-1, 1), scale).reshape(r.shape)
        k = self.blocks(r, values, scale, 0)
        if along_a is not None or along_b is not None:
            i, u = directed(along_a, stretch)
            j, v = directed(along_b, stretch)
            index = np.ix_(i, j)
            through = self.blocks(r[index], values[index], scale, 2) * (-u * v.T)[:, :, None, None]
            k[i] = self.blocks(r[i], values[i], scale, 1) * u[:, :, None, None]
            k[:, j] = self.blocks(r[:, j], values[:, j], scale, 1) * -v[:, :, None]
            k[index] = through
        return k.transpose(0, 2, 1, 3).reshape(self.channels * len(a), self.channels * len(b))

    def variances(self, along: Array) -> Array:
        scale, stretch = self.coordinates(1)
        home = np.zeros(len(along))
        at_home = self.values(home[:, None], scale)
        values, bends = (
            np.diagonal(self.blocks(home, at_home, scale, n), axis1=1, axis2=2) for n in (0, 2)
        )
        return np.where(along != 0, -bends * (along * stretch) ** 2, values)

    def third(self, offsets: Array, along: Array, direction: Array) -> Array:
        """As `kmp.kernel.third_derivative`."""
        scale, stretch = self.coordinates(1)
        r = offsets * stretch
        blocks = self.blocks(r[:, 0], self.values(r, scale), scale, 3)
        moved = along * stretch * (direction * stretch) ** 2  # (R, 1)
        return np.asarray(blocks * moved[:, :, None])


@dataclass(frozen=True)
class VelocityKernel(_OneInput):
    """The kernel of skills over time whose 2 D outputs are values and their rates: [xi, dxi/dt].

    A via-point can then fix the velocity too (IJRR 2019, on time-driven trajectories; there the
    derivatives are differences, here they are exact). With r = t - t' the block of two points is
    [[k, 2 ell r k], [-2 ell r k, (2 ell - 4 ell^2 r^2) k]]; `ell` in 1 / (unit of time)^2. It
    takes one input. The methods are those of `Kernel`. Raises ValueError unless ell is finite and
    above 0.
    """

    channels: ClassVar[int] = 2
    period: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "ell", positive("ell", self.ell))

    @cached_property
    def prior_variance(self) -> Array:
        return frozen(np.diag([1.0, 2 * self.ell]))

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError unless there are one input and as many rates as values."""
        if inputs != 1 or outputs % 2:
            raise ValueError(
                f"kernel: {inputs} inputs and {outputs} outputs given; value and rate over time "
                "need 1 input and an even number of outputs: the values, then their rates."
            )

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        return self.ell, unstretched(inputs)

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        r = offsets[:, 0]
        return np.asarray(np.exp(-scale * r * r))

    @staticmethod
    def blocks(r: Array, values: Array, scale: float, order: int) -> Array:
        r = np.where(values > 0, r, 0.0)  # k is 0 far away, where r k would be infinity times 0
        # k^(n+1) = -2 ell (r k^(n) + n k^(n-1)); d/dt is d/dr and d/dt' is -d/dr.
        k = [values, -2 * scale * r * values]
        for n in range(1, order + 2):
            k.append(-2 * scale * (r * k[n] + n * k[n - 1]))
        a, b, c = k[order : order + 3]
        return np.stack([a, -b, b, -c], axis=-1).reshape(*r.shape, 2, 2)


@dataclass(frozen=True)
class PeriodicKernel(_OneInput):
    """k(t, t') = exp(-ell (T / pi)^2 sin^2(pi (t - t') / T)), periodic with the period T.

    Near to t it is the Gaussian kernel of the same `ell` [1 / (unit of time)^2]; `period` T [unit
    of time], 2 pi for a phase in radians. MacKay, Introduction to Gaussian Processes, 1998. A
    rhythmic skill has no seam: predictions at t and t + T are equal. It takes one input. The
    methods are those of `Kernel`. Raises ValueError unless both are finite and above 0.
    """

    period: float

    def __post_init__(self) -> None:
        self.__dict__.update(ell=positive("ell", self.ell), period=positive("period", self.period))

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError unless there is one input."""
        if inputs != 1:
            raise ValueError(
                f"kernel: {inputs} inputs given; a periodic kernel needs 1, the time or a phase."
            )

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        """The scale ell (T / pi)^2, and the stretch 2 pi / T to radians."""
        return self.ell * (self.period / np.pi) ** 2, frozen(
            np.full(inputs, 2 * np.pi / self.period)
        )

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        return np.asarray(np.exp(-scale * np.sin(offsets[:, 0] / 2) ** 2))

    @staticmethod
    def blocks(r: Array, values: Array, scale: float, order: int) -> Array:
        c = scale / 2
        sine = np.sin(r)
        cosine = np.cos(r)
        if order == 0:
            factor = np.ones_like(r)
        elif order == 1:
            factor = -c * sine
        elif order == 2:
            factor = c * c * sine * sine - c * cosine
        else:
            factor = c * sine * (3 * c * cosine + 1 - c * c * sine * sine)
        return np.asarray((factor * values)[..., None, None])
