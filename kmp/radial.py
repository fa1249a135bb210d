"""Radial kernels k(s, s') = f(u) of u = sum_i ell_i (s_i - s'_i)^2: Gaussian, Matern, a user's own.

By the chain rule, with the derivatives u_a of u along directions: D_a k = f' u_a, D_ab k = f'' u_a
u_b + f' u_ab, and D_abb k = f''' u_a u_b^2 + f'' (2 u_ab u_b + u_bb u_a). In the coordinates x =
stretch * s, u is scale |x - x'|^2.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from scipy.spatial.distance import cdist

from kmp.arrays.checks import Array, check_some, numbers, positive, real
from kmp.arrays.immutable import frozen
from kmp.composition import Composable
from kmp.kernel import directed, unstretched

# Derivatives of f may have a pole at u = 0, where u_a is 0: they are evaluated at larger u only.
_LEAST_U = 1e-30
_LARGEST_ROOT = 1e3  # exp(-1000) is 0


@dataclass(frozen=True, eq=False, repr=False)
class RadialKernel(Composable):
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
        raise self._lacking("profile")

    def first_derivative(self, u: Array) -> Array:
        """df/du."""
        raise self._lacking("first_derivative")

    def second_derivative(self, u: Array) -> Array:
        """d^2 f/du^2."""
        raise self._lacking("second_derivative")

    def third_derivative(self, u: Array) -> Array:
        """d^3 f/du^3."""
        raise self._lacking("third_derivative")

    def _lacking(self, name: str) -> ValueError:
        return ValueError(
            f"kernel: {self} has no {name}, needed here. Define it, or take a smoother kernel: "
            "GaussianKernel."
        )

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
        u = frozen(scale * cdist(x, y, "sqeuclidean"))
        k = self.profile(u)
        if along_a is None and along_b is None:
            return k
        i, v = directed(along_a, stretch)
        j, w = directed(along_b, stretch)
        # a shift to the first point, as differences of small numbers round less
        origin = y[:1].sum(axis=0)
        x = x - origin
        y = y - origin
        # the derivatives of -u by a (A', B), by b (A, B'), and by both
        left = 2 * scale * (v @ y.T - np.vecdot(x[i], v)[:, None])
        right = 2 * scale * (x @ w.T - np.vecdot(y[j], w))
        both = np.ix_(i, j)
        mixed = k[both]
        if mixed.size:
            across = 2 * scale * (v @ w.T)
            mixed = self._derived(u[both], left[:, j] * right[i], across)
        k[i] = self._derived(u[i], left)
        k[:, j] = self._derived(u[:, j], right)
        k[both] = mixed
        return k

    def _derived(self, u: Array, slope: Array, across: Array | None = None) -> Array:
        """D_a k, by the slope -u_a; with -u_ab given, D_ab k by the slope u_a u_b."""
        above_0 = np.maximum(u, _LEAST_U)
        if across is None:
            return -self.first_derivative(above_0) * slope
        return self.second_derivative(above_0) * slope - self.first_derivative(u) * across

    def third(self, offsets: Array, along: Array, direction: Array) -> Array:
        """As `kmp.kernel.third_derivative`."""
        if type(self).__call__ is not RadialKernel.__call__:
            raise ValueError(f"kernel: {self} overrides __call__: override `third`, too.")
        scale, stretch = self.coordinates(len(direction))
        r = offsets * stretch
        v = along * stretch
        w = direction * stretch
        u = np.maximum(scale * np.vecdot(r, r), _LEAST_U)
        u_v, u_w, u_vw, u_ww = (
            2 * scale * np.vecdot(*pair) for pair in ((r, v), (r, w), (v, w), (w, w))
        )
        second = self.second_derivative(u) * (2 * u_vw * u_w + u_ww * u_v)
        return np.asarray(self.third_derivative(u) * u_v * u_w * u_w + second)


@dataclass(frozen=True, eq=False, repr=False)
class GaussianKernel(RadialKernel):
    """k(s, s') = exp(-ell |s - s'|^2), `ell` in 1 / (unit of the inputs)^2. The paper, section III.

    Given as an array (I,), `ell` has one value for each input, to multiply (s_i - s'_i)^2 with. The
    methods are those of `Kernel`. Raises ValueError unless every ell is finite and above 0.
    """

    def profile(self, u: Array) -> Array:
        minus = -u
        return np.exp(minus, minus)

    def first_derivative(self, u: Array) -> Array:
        return -self.profile(u)

    def second_derivative(self, u: Array) -> Array:
        return self.profile(u)

    third_derivative = first_derivative


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
