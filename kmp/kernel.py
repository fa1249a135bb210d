"""Kernels k(s, s'), the inner products of the basis functions: equation (7) of the paper.

A kernel is a function of s - s'. It has C channels: 1 where the outputs are values, 2 where they
are a value and its rate. Rows and columns of its matrices are (point, channel), the channel running
faster, so that the O = C D outputs share each entry D times. A point may also stand for the
derivative along a direction: its row is the kernel derived.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array, brief
from kmp.arrays.immutable import frozen
from kmp.functionals import Functionals


class Kernel(Protocol):
    """The members that a primitive uses, of a function of s - s'. I inputs, C channels.

    `RadialKernel` has them all but f(u). A kernel that is not radial gives them itself.
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


_MEMBERS = ("ell", "channels", "period", "prior_variance", "check", "__call__", "variances")


def checked_kernel(kernel: Kernel) -> Kernel:
    """The kernel. Raises ValueError unless it is a `Kernel`."""
    lacks = [name for name in _MEMBERS if isinstance(kernel, type) or not hasattr(kernel, name)]
    if lacks:
        raise ValueError(
            f"kernel: {brief(kernel)} given, a kernel needed: GaussianKernel(ell=8.0), for one. "
            f"It lacks {', '.join(lacks)}, which RadialKernel has."
        )
    return kernel


def third_derivative(kernel: Any, offsets: Array, along: Array, direction: Array) -> Array:
    """The derivatives (R, C, C) of k by s, once along (R, I) and twice along one direction (I,).

    `offsets` (R, I) are s - s'. Raises ValueError if the kernel has no such derivative.
    """
    if not hasattr(kernel, "third"):
        raise ValueError(
            f"kernel: {brief(kernel)} has no `third`, which curvatures need where "
            "derivatives are observed."
        )
    third = np.asarray(kernel.third(offsets, along, direction))
    return third.reshape(-1, kernel.channels, kernel.channels)


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
