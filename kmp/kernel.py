"""Kernels k(s, s'), the inner products of the basis functions: equation (7) of the paper.

A kernel is a function of s - s'. It has C channels: 1 where the outputs are values, 2 where they
are a value and its rate. Rows and columns of its matrices are (point, channel), the channel running
faster, so that the O = C D outputs share each entry D times. A point may also stand for the
derivative along a direction: its row is the kernel derived.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array, brief
from kmp.arrays.immutable import frozen
from kmp.functionals import Derivatives, Functionals


class Kernel(Protocol):
    """The members that a primitive uses, of a function of s - s'. I inputs, C channels.

    `RadialKernel` has them all but f(u). A kernel that is not radial gives them itself; for a
    curvature where derivatives are observed, it also needs `RadialKernel.derivative`.
    """

    @property
    def ell(self) -> float | Array:
        """The parameter [1 / (unit of the inputs)^2], from which the rank is estimated."""

    @property
    def channels(self) -> int:
        """C."""

    @property
    def period(self) -> float | None:
        """The period of the inputs [unit of the inputs]; None without one."""

    @property
    def prior_variance(self) -> Array:
        """k(s, s) (C, C), the same at every input."""

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError if the kernel does not fit this number of inputs and outputs."""

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        """k(a, b) of every pair: (A, I), (B, I) -> (A C, B C).

        Where a direction in `along_a` (A, I) or `along_b` (B, I) is not zero, the derivative of k
        by a or b along it.
        """

    def variances(self, along: Array) -> Array:
        """k (N, C) of N functionals with themselves, for directions (N, I); zero for a value."""


class OneQueryKernel(Kernel, Protocol):
    """A kernel with formulas of its own for one query s, where microseconds count.

    They are functions of arrays in the coordinates x = stretch * s, in which one scale holds for
    all inputs: the offsets x - x_r (R, I) from R centres, the values k (R,), and the centres that
    are derivatives. The weights are of D outputs a channel.
    """

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        """The scale, and the stretch (I,) of the inputs."""

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        """k (R,) of the offsets, as if all centres were values."""

    @staticmethod
    def row(
        offsets: Array, values: Array, scale: float, derivatives: Derivatives | None = None
    ) -> Array:
        """k(s, s_r): (R,) if C is 1, else (C, R C)."""

    @staticmethod
    def jacobian(
        offsets: Array,
        values: Array,
        scale: float,
        weight_rows: Array,
        derivatives: Derivatives | None = None,
    ) -> Array:
        """d/dx sum_r k(s, s_r) w_r (O, I), of weights w as rows (D, R C)."""

    @staticmethod
    def curvature(
        offsets: Array,
        values: Array,
        scale: float,
        weights: Array,
        direction: Array,
        derivatives: Derivatives | None = None,
    ) -> Array:
        """d^2/dt^2 of that sum (O,) at x + t v for t = 0, of v (I,) and weights (R C, D)."""


_MEMBERS = ("ell", "channels", "period", "prior_variance", "check", "__call__", "variances")


def missing_members(kernel: object) -> list[str]:
    """The members of `Kernel` that a value lacks."""
    return [name for name in _MEMBERS if isinstance(kernel, type) or not hasattr(kernel, name)]


def checked_kernel(kernel: Kernel) -> Kernel:
    """The kernel. Raises ValueError unless it is a `Kernel`."""
    missing = missing_members(kernel)
    if "prior_variance" in missing:
        raise ValueError(
            f"kernel: {brief(kernel)} given, a kernel needed: GaussianKernel(ell=8.0), for one."
        )
    if missing:
        raise ValueError(
            f"kernel: {brief(kernel)} lacks {', '.join(missing)}. Derive it from RadialKernel."
        )
    return kernel


def derivative(kernel: Kernel, offsets: Array, directions: tuple[Array, ...]) -> Array:
    """The derivative (R,) of k by s along up to three directions (R, I) or (I,).

    `offsets` (R, I) are s - s'. Raises ValueError if the kernel has no such derivatives.
    """
    if not hasattr(kernel, "derivative"):
        raise ValueError(
            f"kernel: {brief(kernel)} has no method `derivative`, which curvatures need where "
            "derivatives are observed."
        )
    return np.asarray(cast(Any, kernel).derivative(offsets, directions))


def between(kernel: Kernel, a: Functionals, b: Functionals) -> Array:
    """k (A C, B C) of every pair of functionals."""
    return kernel(a.inputs, b.inputs, a.directions, b.directions)


def variances(kernel: Kernel, functionals: Functionals) -> Array:
    """k (N, C) of each functional with itself."""
    if functionals.directions is None:
        return np.broadcast_to(
            np.diagonal(kernel.prior_variance), (len(functionals), kernel.channels)
        )
    return kernel.variances(functionals.directions)


@cache
def unstretched(inputs: int) -> Array:
    """The stretch (I,) of coordinates that are the inputs themselves: ones."""
    return frozen(np.ones(inputs))


def directed(along: Array | None, stretch: Array) -> tuple[NDArray[np.intp], Array]:
    """Indices (I',) of the directions that are not zero, and these, stretched (I', I)."""
    if along is None:
        return np.empty(0, dtype=np.intp), np.empty((0, len(stretch)))
    rows = np.flatnonzero(along.any(axis=1))
    return rows, along[rows] * stretch
