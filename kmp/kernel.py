"""Kernels k(s, s'), the inner products of the basis functions: equation (7) of the paper.

GaussianKernel: k(s, s') = exp(-ell |s - s'|^2). In the coordinates x = stretch * s with r = x - x':
dk/dx = -2 scale r k and d^2 k / dx dx' = (2 scale I - 4 scale^2 r r^T) k.

A kernel has C channels: 1 where the outputs are values, 2 where they are a value and its rate. Rows
and columns of its matrices are (point, channel), the channel running faster, so that the O = C D
outputs share each entry D times. A point may also stand for the derivative along a direction: its
row is the kernel derived.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from kmp.arrays.checks import Array, check_some, numbers, positive, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.functionals import Derivatives, Functionals


class Kernel(Protocol):
    """The members that a primitive uses. R centres, I inputs, C channels, D outputs a channel.

    `values`, `row`, `jacobian` and `curvature` serve one query s, where microseconds count. They
    are functions of arrays in the coordinates x = stretch * s, in which one scale holds for all
    inputs: the offsets x - x_r (R, I) from the centres, the values k (R,), and the centres that are
    derivatives.
    """

    @property
    def ell(self) -> float | Array:
        """The parameter [1 / (unit of the inputs)^2]."""

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

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        """The scale, and the stretch (I,) of the inputs."""

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        """k(a, b) of every pair: (A, I), (B, I) -> (A C, B C).

        Where a direction in `along_a` (A, I) or `along_b` (B, I) is not zero, the derivative of k
        by a or b along it.
        """

    def variances(self, along: Array) -> Array:
        """k (N, C) of N functionals with themselves, for directions (N, I); zero for a value."""

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


@dataclass(frozen=True, eq=False, repr=False)
class GaussianKernel(Immutable):
    """k(s, s') = exp(-ell |s - s'|^2), `ell` in 1 / (unit of the inputs)^2. The paper, section III.

    Given as an array (I,), `ell` has one value for each input, to multiply (s_i - s'_i)^2 with. The
    methods are those of `Kernel`. Raises ValueError unless every ell is finite and above 0.
    """

    channels: ClassVar[int] = 1
    period: ClassVar[None] = None
    ell: float | Array

    def __post_init__(self) -> None:
        if real("ell", self.ell).ndim == 0:
            object.__setattr__(self, "ell", positive("ell", self.ell))
            return
        ell = numbers("ell", self.ell, "I")
        check_some("ell", ell)
        for i, value in enumerate(ell):
            positive(f"ell[{i}]", value)
        object.__setattr__(self, "ell", ell)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, GaussianKernel) and np.array_equal(self.ell, other.ell)

    def __repr__(self) -> str:
        return f"GaussianKernel(ell={np.asarray(self.ell).tolist()})"

    def __hash__(self) -> int:
        return hash(np.asarray(self.ell).tobytes())

    @cached_property
    def prior_variance(self) -> Array:
        return frozen(np.ones((1, 1)))

    def check(self, inputs: int, outputs: int) -> None:
        """Raise ValueError unless there is one ell for each input, or one for all."""
        if np.ndim(self.ell) and np.size(self.ell) != inputs:
            raise ValueError(
                f"kernel's ell: {np.size(self.ell)} values given, 1 or {inputs} needed for "
                f"{inputs} inputs."
            )

    def coordinates(self, inputs: int) -> tuple[float, Array]:
        if isinstance(self.ell, float):
            return self.ell, unstretched(inputs)
        return 1.0, frozen(np.sqrt(self.ell))

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        scale, stretch = self.coordinates(a.shape[1])
        x = a * stretch
        y = b * stretch
        k = np.exp(-scale * cdist(x, y, "sqeuclidean"))
        if along_a is None and along_b is None:
            return k
        i, u = directed(along_a, stretch)
        j, v = directed(along_b, stretch)
        # a shift to the first point, as differences of small numbers round less
        origin = y[:1].sum(axis=0)
        x = x - origin
        y = y - origin
        left = 2 * scale * (u @ y.T - np.vecdot(x[i], u)[:, None])  # (I', B)
        right = 2 * scale * (x @ v.T - np.vecdot(y[j], v))  # (A, J')
        mixed = k[np.ix_(i, j)] * (left[:, j] * right[i] + 2 * scale * (u @ v.T))
        k[i] *= left
        k[:, j] *= right
        k[np.ix_(i, j)] = mixed
        return k

    def variances(self, along: Array) -> Array:
        scale, stretch = self.coordinates(along.shape[1])
        squares = 2 * scale * ((along * stretch) ** 2).sum(axis=1, keepdims=True)
        return np.where(squares > 0, squares, 1.0)

    @staticmethod
    def values(offsets: Array, scale: float) -> Array:
        value = np.vecdot(offsets, offsets)
        value *= -scale
        return np.asarray(np.exp(value, value))

    @staticmethod
    def row(
        offsets: Array, values: Array, scale: float, derivatives: Derivatives | None = None
    ) -> Array:
        if derivatives is None:
            return values
        row = values.copy()
        rows, along = derivatives
        row[rows] *= 2 * scale * np.vecdot(offsets[rows], along)
        return row

    @staticmethod
    def jacobian(
        offsets: Array,
        values: Array,
        scale: float,
        weight_rows: Array,
        derivatives: Derivatives | None = None,
    ) -> Array:
        if derivatives is None:
            return np.asarray((weight_rows * (values * (-2 * scale))) @ offsets)
        row = GaussianKernel.row(offsets, values, scale, derivatives)
        rows, along = derivatives
        through = (weight_rows[:, rows] * (values[rows] * (2 * scale))) @ along
        return np.asarray((weight_rows * (row * (-2 * scale))) @ offsets + through)

    @staticmethod
    def curvature(
        offsets: Array,
        values: Array,
        scale: float,
        weights: Array,
        direction: Array,
        derivatives: Derivatives | None = None,
    ) -> Array:
        slope = (2 * scale) * (offsets @ direction)
        bend = slope * slope - 2 * scale * float(direction @ direction)
        if derivatives is None:
            return np.asarray((values * bend) @ weights)
        bend *= GaussianKernel.row(offsets, values, scale, derivatives)
        rows, along = derivatives
        bend[rows] -= values[rows] * (4 * scale) * (along @ direction) * slope[rows]
        return np.asarray(bend @ weights)


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
