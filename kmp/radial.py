"""Radial kernels k(s, s') = f(u) of u = sum_i ell_i (s_i - s'_i)^2: Gaussian, Matern, a user's own.

By the chain rule, with the derivatives u_a of u along directions, D_a k = f' u_a, D_ab k = f'' u_a
u_b + f' u_ab and D_abc k = f''' u_a u_b u_c + f'' (u_ab u_c + u_ac u_b + u_bc u_a). In the
coordinates x = stretch * s with r = x - x', u is scale |r|^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import combinations
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from kmp.arrays.checks import Array, check_some, numbers, positive, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.composition import Composable
from kmp.functionals import Derivatives
from kmp.kernel import directed, unstretched

# Derivatives of f may have a pole at u = 0, where u_a is 0: they are evaluated at larger u only.
_LEAST_U = 1e-30
_LARGEST_ROOT = 1e3  # exp(-1000) is 0


@dataclass(frozen=True, eq=False, repr=False)
class RadialKernel(Composable, Immutable):
    """A kernel k(s, s') = f(u) of u = sum_i ell_i (s_i - s'_i)^2, given by f and its derivatives.

    A kernel of your own derives from this class, and gives f, f' and f'' of arrays of u:

    ```python
    class Cauchy(kmp.RadialKernel):
        def profile(self, u):
            return 1 / (1 + u)

        def first_derivative(self, u):
            return -1 / (1 + u) ** 2

        def second_derivative(self, u):
            return 2 / (1 + u) ** 3
    ```

    `ell` [1 / (unit of the inputs)^2] is one number, or an array (I,) with one for each input.
    Further parameters are fields, if the class is a dataclass (`@dataclass(frozen=True, eq=False,
    repr=False)`). `kmp.load(path, kernels={"Cauchy": Cauchy})` restores it from a file.

    Jacobians and observed derivatives need f', and f'' where two derivatives are compared, as in a
    curvature; a curvature where derivatives are observed needs f''', a `third_derivative`. What a
    class does not give is refused with a ValueError that names it. f must be positive definite.

    `a + b`, `a * b` and `0.5 * a` are kernels, too. Raises ValueError unless every ell is finite
    and above 0.
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
        return type(self) is type(other) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def __repr__(self) -> str:
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        parameters = (f"{name}={np.asarray(value).tolist()!r}" for name, value in values)
        return f"{type(self).__name__}({', '.join(parameters)})"

    def profile(self, u: Array) -> Array:
        """f(u), of the shape of u."""
        raise self._lacking("profile", "every prediction needs")

    def first_derivative(self, u: Array) -> Array:
        """df/du."""
        raise self._lacking("first_derivative", "Jacobians and observed derivatives need")

    def second_derivative(self, u: Array) -> Array:
        """d^2 f/du^2."""
        raise self._lacking("second_derivative", "curvatures and observed derivatives need")

    def third_derivative(self, u: Array) -> Array:
        """d^3 f/du^3."""
        raise self._lacking("third_derivative", "curvatures need where derivatives are observed")

    def _lacking(self, name: str, use: str) -> ValueError:
        return ValueError(
            f"kernel: {self} has no {name}, which {use}. Define it, or take a smoother kernel, "
            "such as GaussianKernel."
        )

    @cached_property
    def prior_variance(self) -> Array:
        origin = np.zeros((1, np.size(self.ell)))
        return frozen(self(origin, origin))

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
        u = frozen(scale * cdist(a * stretch, b * stretch, "sqeuclidean"))
        k = self.profile(u)
        if along_a is None and along_b is None:
            return k
        i, j, left, right, across = self._slopes(a, b, along_a, along_b)
        k[i] = self._chain(u[i], [-left])
        k[:, j] = self._chain(u[:, j], [-right])
        if len(i) and len(j):
            both = np.ix_(i, j)
            k[both] = self._chain(u[both], [left[:, j], right[i]], [-across])
        return k

    def _slopes(
        self, a: Array, b: Array, along_a: Array | None, along_b: Array | None
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array, Array]:
        """Indices (A',) and (B',) of the derivatives, and derivatives of -u.

        These are by a (A', B), by b (A, B'), and by both (A', B').
        """
        scale, stretch = self.coordinates(a.shape[1])
        x = a * stretch
        y = b * stretch
        i, along_x = directed(along_a, stretch)
        j, along_y = directed(along_b, stretch)
        # a shift to the first point, as differences of small numbers round less
        origin = y[:1].sum(axis=0)
        x = x - origin
        y = y - origin
        left = 2 * scale * (along_x @ y.T - np.vecdot(x[i], along_x)[:, None])
        right = 2 * scale * (x @ along_y.T - np.vecdot(y[j], along_y))
        return i, j, left, right, 2 * scale * (along_x @ along_y.T)

    def variances(self, along: Array) -> Array:
        inputs = along.shape[1]
        axes = np.eye(inputs)
        origin = np.zeros((inputs, inputs))
        across = self(origin, origin, axes, axes)  # (I, I)
        if not np.isfinite(across).all():
            raise ValueError(
                f"kernel: {self} has no finite first_derivative at 0, so that its functions have no "
                "derivatives. Take a smoother kernel, such as Matern32."
            )
        squares = np.vecdot(along @ across, along)[:, None]
        return np.where(along.any(axis=1, keepdims=True), squares, self.prior_variance)

    def derivative(self, offsets: Array, directions: Sequence[Array]) -> Array:
        """The derivative (R,) of k by s along up to three directions (R, I) or (I,).

        `offsets` (R, I) are s - s'.
        """
        if type(self).__call__ not in (RadialKernel.__call__, GaussianKernel.__call__):
            raise ValueError(f"kernel: {self} overrides __call__: override `derivative`, too.")
        scale, stretch = self.coordinates(offsets.shape[1])
        r = offsets * stretch
        u = scale * np.vecdot(r, r)
        if not directions:
            return self.profile(u)
        along = [direction * stretch for direction in directions]
        slopes = [2 * scale * np.vecdot(r, direction) for direction in along]
        bends = [2 * scale * np.vecdot(*pair) for pair in combinations(along, 2)]
        return self._chain(u, slopes, bends)

    def _chain(self, u: Array, slopes: Sequence[Array], bends: Sequence[Array] = ()) -> Array:
        """The derivative of f(u), by the first derivatives of u and the second of each pair."""
        above_0 = np.maximum(u, _LEAST_U)
        a, *more = slopes
        if not more:
            return self.first_derivative(above_0) * a
        b, *more = more
        second = self.second_derivative(above_0)
        if not more:
            return second * a * b + self.first_derivative(u) * bends[0]
        [c] = more
        ab, ac, bc = bends
        return self.third_derivative(above_0) * a * b * c + second * (ab * c + ac * b + bc * a)


@dataclass(frozen=True, eq=False, repr=False)
class GaussianKernel(RadialKernel):
    """k(s, s') = exp(-ell |s - s'|^2), `ell` in 1 / (unit of the inputs)^2. The paper, section III.

    Given as an array (I,), `ell` has one value for each input, to multiply (s_i - s'_i)^2 with. The
    methods are those of `Kernel`. Raises ValueError unless every ell is finite and above 0.
    """

    def profile(self, u: Array) -> Array:
        return np.exp(-u)

    def first_derivative(self, u: Array) -> Array:
        return -np.exp(-u)

    def second_derivative(self, u: Array) -> Array:
        return np.exp(-u)

    def third_derivative(self, u: Array) -> Array:
        return -np.exp(-u)

    def __call__(
        self, a: Array, b: Array, along_a: Array | None = None, along_b: Array | None = None
    ) -> Array:
        if type(self) is not GaussianKernel:  # a subclass may have another profile
            return super().__call__(a, b, along_a, along_b)
        scale, stretch = self.coordinates(a.shape[1])
        k = np.exp(-scale * cdist(a * stretch, b * stretch, "sqeuclidean"))
        if along_a is None and along_b is None:
            return k
        i, j, left, right, across = self._slopes(a, b, along_a, along_b)
        both = np.ix_(i, j)
        mixed = k[both] * (left[:, j] * right[i] + across)
        k[i] *= left
        k[:, j] *= right
        k[both] = mixed
        return k

    def variances(self, along: Array) -> Array:
        if type(self) is not GaussianKernel:
            return super().variances(along)
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


@dataclass(frozen=True, eq=False, repr=False)
class Matern32(RadialKernel):
    """The Matern kernel of nu = 3/2: (1 + d) exp(-d) with d^2 = 6 ell |s - s'|^2.

    Rasmussen and Williams 2006, equation (4.17), for the length 1 / sqrt(2 ell), which is that of a
    `GaussianKernel` of the same `ell`. Its functions are once differentiable (in mean square): it
    takes derivatives as observations, and refuses curvatures where there are any.
    """

    def profile(self, u: Array) -> Array:
        d = _root(6 * u)
        return (1 + d) * np.exp(-d)

    def first_derivative(self, u: Array) -> Array:
        return -3 * np.exp(-_root(6 * u))

    def second_derivative(self, u: Array) -> Array:
        d = _root(6 * u)
        return 9 * np.exp(-d) / d


@dataclass(frozen=True, eq=False, repr=False)
class Matern52(RadialKernel):
    """The Matern kernel of nu = 5/2: (1 + d + d^2 / 3) exp(-d) with d^2 = 10 ell |s - s'|^2.

    As `Matern32`, but its functions are twice differentiable.
    """

    def profile(self, u: Array) -> Array:
        d = _root(10 * u)
        return (1 + d + d * d / 3) * np.exp(-d)

    def first_derivative(self, u: Array) -> Array:
        d = _root(10 * u)
        return -5 / 3 * (1 + d) * np.exp(-d)

    def second_derivative(self, u: Array) -> Array:
        return 25 / 3 * np.exp(-_root(10 * u))

    def third_derivative(self, u: Array) -> Array:
        d = _root(10 * u)
        return -125 / 3 * np.exp(-d) / d


def _root(square: Array) -> Array:
    """The root d, cut where exp(-d) is 0, as infinity times 0 is no number."""
    return np.minimum(np.sqrt(square), _LARGEST_ROOT)
