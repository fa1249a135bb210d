"""Skills whose output is an orientation: unit quaternions in a tangent space.

Huang et al., Generalized Orientation Learning in Robot Task Space, ICRA 2019, and Toward
Orientation Learning and Adaptation in Cartesian Space, T-RO 2021 ("T-RO"). zeta = log(q conj(q_a))
(3) lies in the tangent space at an auxiliary quaternion q_a; |zeta| is half of the angle of
rotation. Quaternions are x y z w, and q and -q are one orientation; rotations multiply from the
left, so that axes, angular velocities and deviations are those of the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, Seed, check_finite, numbers, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, covariances, unchecked
from kmp.predictor import Uncertainty
from kmp.primitive import KMP, Saved, checked_primitive
from kmp.query import MotionPrediction
from kmp.solution import Solution, least_of_channels

_TINY = 1e-4  # [rad] below it a power series is exact to rounding
_CONJUGATE = frozen(np.array([-1.0, -1.0, -1.0, 1.0]))
_UNIT = 1e-3  # a norm farther from 1 is an error of the caller


def continuous(quaternions: ArrayLike) -> Array:
    """The same orientations (T, 4), of norm 1, with signs so that q_t . q_(t+1) >= 0. x y z w.

    Raises ValueError if the shape differs, a number is not finite, or a norm is far from 1.
    """
    q = _unit("quaternions", quaternions).copy()
    signs = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(signs)[:, None]
    return frozen(q)


def multiplied(a: Array, b: Array) -> Array:
    """The products a b (..., 4): rotation b, then a. Raises ValueError if shapes differ."""
    a = real("a", a)
    b = real("b", b)
    for name, factor, other in (("a", a, b), ("b", b, a)):
        if factor.shape[-1:] != (4,) or (
            factor.ndim > 1 and other.ndim > 1 and factor.shape != other.shape
        ):
            raise ValueError(
                f"{name}: shape {factor.shape} given, for a of {a.shape} and b of {b.shape}; (..., "
                "4) needed."
            )
        check_finite(name, factor)
    av = a[..., :3]
    aw = a[..., 3:]
    bv = b[..., :3]
    bw = b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - (av * bv).sum(axis=-1, keepdims=True)], axis=-1)


def log(quaternions: ArrayLike, auxiliary: ArrayLike) -> Array:
    """zeta = log(q conj(q_a)) (T, 3) [rad, half the angle], for q (T, 4), q_a (4,).

    zeta = angle * axis for q conj(q_a) = (axis sin(angle), cos(angle)). T-RO, section II. q and -q
    differ here. Raises ValueError if a shape differs, a number is not finite, a norm is far from
    1, or q = -q_a, where the angle of rotation would be 360 degrees.
    """
    q_a = _unit("auxiliary", auxiliary, 4)
    q = multiplied(_unit("quaternions", quaternions), q_a * _CONJUGATE)
    length = np.linalg.norm(q[:, :3], axis=1, keepdims=True)
    angle = np.arctan2(length, q[:, 3:])
    for n in np.flatnonzero(angle > np.pi - 1e-6)[:1]:
        raise ValueError(
            f"quaternions[{n}] is the auxiliary one with the sign changed: give -q, the same "
            "orientation."
        )
    series = 1 + length**2 / 6
    return np.asarray(
        np.where(length > _TINY, angle / np.maximum(length, _TINY), series) * q[:, :3]
    )


def exp(zeta: Array, auxiliary: Array) -> Array:
    """q = exp(zeta) q_a (T, 4) for zeta (T, 3) [rad, half the angle], q_a (4,). x y z w.

    exp(zeta) = (zeta sin|zeta| / |zeta|, cos|zeta|). T-RO, section II. Raises ValueError if a shape
    differs.
    """
    zeta = numbers("zeta", zeta, "T", 3)
    auxiliary = numbers("auxiliary", auxiliary, 4)
    angle = np.linalg.norm(zeta, axis=1, keepdims=True)
    check_finite("zeta", angle)
    return multiplied(
        np.concatenate([np.sinc(angle / np.pi) * zeta, np.cos(angle)], axis=1), auxiliary
    )


def _nearest_log(quaternions: Array, auxiliary: Array, near: Array) -> Array:
    """The zeta (V, 3) of the orientations (V, 4) of q or -q that are nearest to `near` (V, 3).

    Those of one orientation are a half turn |zeta| = pi apart, along one axis.
    """
    signs = np.where(multiplied(quaternions, auxiliary * _CONJUGATE)[:, 3:] < 0, -1.0, 1.0)
    zeta = log(signs * quaternions, auxiliary)
    angle = np.linalg.norm(zeta, axis=1, keepdims=True)
    along = np.where(angle > _TINY, zeta, near)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    axis = along / np.maximum(length, np.finfo(np.float64).tiny)
    turns = np.round(np.vecdot(axis, near - zeta)[:, None] / np.pi)
    return np.asarray(zeta + turns * np.pi * axis)


def rotation_per_zeta(zeta: ArrayLike) -> Array:
    """J (3, 3): a small rotation [rad], or angular velocity, is J times the change of zeta (3,).

    Twice the left Jacobian of SO(3) at v = 2 zeta: J = 2 (I + (1 - cos|v|) / |v|^2 [v] + (|v| -
    sin|v|) / |v|^3 [v]^2) with the cross product matrix [v]. The papers take finite differences in
    time instead. Raises ValueError if the shape differs or a number is not finite.
    """
    vector = 2 * numbers("zeta", zeta, 3)
    cross = _cross(vector)
    first, second = _factors(float(np.linalg.norm(vector)))
    return np.asarray(2 * (np.eye(3) + first * cross + second * (cross @ cross)))


def rotation_rate_per_zeta(zeta: ArrayLike, rate: ArrayLike) -> Array:
    """dJ/dt (3, 3) of `rotation_per_zeta` at zeta (3,), which changes by `rate` (3,) [1/s].

    With J = 2 (I + f [v] + g [v]^2): 2 (f' [v] + f [v'] + g' [v]^2 + g ([v'][v] + [v][v'])).
    """
    v = 2 * numbers("zeta", zeta, 3)
    change = 2 * numbers("rate", rate, 3)
    angle = float(np.linalg.norm(v))
    cross = _cross(v)
    moved = _cross(change)
    first, second = _factors(angle)
    bends = np.array([-1 / 12, -1 / 60])  # f' and g' over v . v'
    if angle >= _TINY:
        bends[0] = (angle * np.sin(angle) - 2 * (1 - np.cos(angle))) / angle**4
        bends[1] = (angle * (1 - np.cos(angle)) - 3 * (angle - np.sin(angle))) / angle**5
    bend_first, bend_second = bends * float(v @ change)
    return np.asarray(
        2
        * (
            bend_first * cross
            + first * moved
            + bend_second * cross @ cross
            + second * (moved @ cross + cross @ moved)
        )
    )


def _factors(angle: float) -> tuple[float, float]:
    """f = (1 - cos|v|) / |v|^2 and g = (|v| - sin|v|) / |v|^3 of an angle |v| [rad]."""
    if angle < _TINY:
        return 1 / 2, 1 / 6
    return (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3


def _cross(v: Array) -> Array:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, eq=False, repr=False)
class _Rotating(Immutable, Saved):
    """A primitive of P positions and zeta, over time with their rates. n = P + 3.

    Raises ValueError if the primitive has other outputs, or the auxiliary quaternion is not one.
    """

    primitive: KMP
    auxiliary: Array
    """(4,) q_a, x y z w."""

    _positions: ClassVar[int] = 0

    def __post_init__(self) -> None:
        needed = self._size * checked_primitive(self.primitive).kernel.channels
        if (outputs := self.primitive.outputs) != needed:
            raise ValueError(f"primitive: {outputs} outputs given, {needed} needed.")
        auxiliary = _unit("auxiliary", self.auxiliary, 4)
        object.__setattr__(self, "auxiliary", frozen(auxiliary.copy()))

    def mean(self, queries: ArrayLike) -> Array:
        """The means (M, P + 4) at queries (M, I): positions, then quaternions x y z w.

        Raises ValueError as `KMP.mean`.
        """
        return self._placed(self.primitive.mean(queries))

    def predict(self, queries: ArrayLike) -> tuple[Array, Array]:
        """The means (M, P + 4) at queries (M, I), and covariances J Sigma J^T (M, n, n).

        The covariances are those of positions [unit^2] and small rotations in the world [rad^2],
        with J of `rotation_per_zeta`. Raises ValueError as `KMP.predict`.
        """
        prediction = self.primitive.predict(queries)
        turn = self._turn(prediction.mean)
        return self._placed(prediction.mean), self._turned(turn, prediction.covariance)

    def predict_motion(
        self,
        query: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        covariance: bool = True,
    ) -> MotionPrediction:
        """The mean (P + 4,) at one query (I,), and its motion with the input, as
        `KMP.predict_motion`: velocities and accelerations (n,) of positions and of rotation [rad/s,
        rad/s^2], omega = J dzeta/dt. If the input is time, its velocity is 1.

        Raises ValueError if a shape differs or a number is not finite.
        """
        inner = self.primitive.predict_motion(query, velocity, acceleration, covariance=covariance)
        size = self._size
        turn = self._turn(inner.mean[None])
        pushed = np.zeros(size)
        rate = inner.velocity[self._positions : size]
        pushed[self._positions :] = (
            rotation_rate_per_zeta(inner.mean[self._positions : size], rate) @ rate
        )
        return MotionPrediction(
            self._placed(inner.mean[None])[0],
            turn[0] @ inner.velocity[:size],
            turn[0] @ inner.acceleration[:size] + pushed,
            None if inner.covariance is None else self._turned(turn, inner.covariance[None])[0],
            turn[0] @ inner.jacobian[:size],
            turn[0] @ inner.curvature[:size] + pushed,
        )

    def jacobian(self, query: ArrayLike) -> Array:
        """Motion and small rotation [rad] by the input (n, I) at one query (I,).

        Raises ValueError as `KMP.jacobian`.
        """
        still = np.zeros(self.primitive.inputs.shape[1])
        return self.predict_motion(query, still, still, covariance=False).jacobian

    def sample(self, queries: ArrayLike, count: int, *, seed: Seed = 0) -> Array:
        """Paths through queries (M, I): (count, M, P + 4). Raises ValueError as `KMP.sample`."""
        drawn = self.primitive.sample(queries, count, seed=seed)
        return self._placed(drawn.reshape(-1, drawn.shape[2])).reshape(*drawn.shape[:2], -1)

    def uncertainty(self, queries: ArrayLike) -> Uncertainty:
        """The covariances of `predict`, by their causes. Raises ValueError as that does."""
        turn = self._turn(self.primitive.mean(queries))
        causes = self.primitive.uncertainty(queries)
        return Uncertainty(
            self._turned(turn, causes.variability), self._turned(turn, causes.distance)
        )

    def adapt(
        self,
        inputs: ArrayLike,
        desired: ArrayLike,
        covariance: ArrayLike,
        *,
        tolerance: float | None = None,
        velocities: ArrayLike | None = None,
        velocity_covariance: ArrayLike | None = None,
    ) -> Self:
        """A new skill that also goes through desired (V, P + 4) at inputs (V, I), as of `mean`.

        Of all zeta of an orientation, the one nearest to the skill's present zeta is used.
        `covariance` (n, n) or (V, n, n) [unit^2, rad^2] is that of positions and small rotations.
        Where its rows are 0, they are met as exactly as rounding allows; those of a rotation are 0
        for all three axes, or for none. Skills with rates take velocities too, (V, n) [unit/s,
        rad/s] with their covariance; None leaves them free. `tolerance` [unit of the inputs] is
        that of `KMP.adapt`.

        Raises ValueError as `KMP.adapt` does, if a quaternion has another norm than 1, if some axes
        of a rotation alone are exact, or if rates are given to a skill without.
        """
        where = numbers("inputs", inputs, "V", self.primitive.inputs.shape[1])
        size = self._size
        poses = numbers("desired", desired, len(where), size + 1)
        q = _unit("desired", poses[:, self._positions :])
        present = self.primitive.mean(where)[:, self._positions : size]
        zeta = _nearest_log(q, self.auxiliary, present)
        values = np.hstack([poses[:, : self._positions], zeta])
        back = np.asarray(np.linalg.inv(self._turn(values)), dtype=np.float64)
        turned = self._back("covariance", covariance, back, 0)
        has_rates = self.primitive.kernel.channels > 1
        if (velocities is None) != (velocity_covariance is None):
            raise ValueError("velocities and velocity_covariance: give both, or none.")
        if not has_rates:
            if velocities is not None:
                raise ValueError(
                    "velocities: the skill has no rates; fit it with a VelocityKernel."
                )
            return self._adapted(where, unchecked(values, turned), tolerance)
        if velocities is None or velocity_covariance is None:
            rates = np.zeros((len(where), size))
            rate_covariance = Gaussians.of(rates, deviation=np.inf).covariance
        else:
            moving = numbers("velocities", velocities, len(where), size)
            rates = (back @ moving[:, :, None])[:, :, 0]
            rate_covariance = self._back("velocity_covariance", velocity_covariance, back, 1)
        whole = np.zeros((len(where), 2 * size, 2 * size))
        whole[:, :size, :size] = turned
        whole[:, size:, size:] = rate_covariance
        return self._adapted(where, unchecked(np.hstack([values, rates]), whole), tolerance)

    @property
    def _size(self) -> int:
        return self._positions + 3

    def _placed(self, values: Array) -> Array:
        """Positions and quaternions (M, P + 4) of the primitive's outputs (M, O)."""
        turned = exp(values[:, self._positions : self._size], self.auxiliary)
        return np.hstack([values[:, : self._positions], turned])

    def _turn(self, values: Array) -> Array:
        """J (M, n, n) of motion and rotation by the outputs (M, O)."""
        turn = np.tile(np.eye(self._size), (len(values), 1, 1))
        for n, row in enumerate(values):
            turn[n, self._positions :, self._positions :] = rotation_per_zeta(
                row[self._positions : self._size]
            )
        return turn

    def _turned(self, turn: Array, covariance: Array) -> Array:
        size = self._size
        return symmetric(turn @ covariance[:, :size, :size] @ turn.mT)

    def _back(self, name: str, covariance: ArrayLike, back: Array, channel: int) -> Array:
        """Covariances J^-1 S J^-T (V, n, n) of a channel's outputs, of S of rotations; 0 is exact.

        `back` is J^-1 (V, n, n). Raises ValueError if a covariance is not positive definite, too
        small, or exact for some axes of a rotation only.
        """
        count, size, _ = back.shape
        matrices = real(name, covariance)
        matrices = (
            np.broadcast_to(matrices, back.shape) if matrices.shape == (size, size) else matrices
        )
        array = numbers(name, matrices, count, size, size)
        exact = np.asarray(~array.any(axis=2))
        exact_axes = np.count_nonzero(exact[:, self._positions :], axis=1)
        for n in np.flatnonzero(exact_axes % 3)[:1]:
            raise ValueError(
                f"{name}[{n}] is 0 for {exact_axes[n]} of the 3 axes of a rotation: give 0 for all "
                "three or for none, and a small variance to the axes that matter."
            )
        rows, outputs = np.nonzero(exact)
        filled = np.array(array)
        filled[rows, outputs, outputs] = 1.0
        checked = covariances(name, filled, count, size)
        turned = symmetric(back @ checked @ back.mT)
        check_finite(name, turned, "too large:")
        # the least variance of each output; that of a rotation is up to 4 times larger
        solution: Solution = self.primitive.inner.solution
        least = least_of_channels(solution)[channel] * solution.hyperparameters.prior_variances
        over_least = turned / np.sqrt(np.outer(least, least))
        for n in np.flatnonzero(np.linalg.eigvalsh(over_least)[:, 0] < 1)[:1]:
            smallest = np.linalg.eigvalsh(array[n])[0]
            raise ValueError(
                f"{name}[{n}] would be lost in rounding: its smallest eigenvalue is "
                f"{smallest:.3g}, and {4.1 * least.max():.2g} is enough. Give 0 for the least, or "
                "the primitive a larger lambda_covariance."
            )
        turned[rows, outputs, :] = turned[rows, :, outputs] = 0.0
        turned[rows, outputs, outputs] = Gaussians.of([0.0], deviation=0).covariance[0, 0, 0]
        return turned

    def _adapted(self, inputs: Array, desired: Gaussians, tolerance: float | None) -> Self:
        adapted = self.primitive.adapt(inputs, desired, tolerance=tolerance)
        return type(self)(adapted, self.auxiliary)


class OrientationKMP(_Rotating):
    """A skill whose output is an orientation, n = 3: a primitive of zeta, over time with its rate.

    To learn one: make each demonstration's quaternions `continuous`, take `log` with a common
    auxiliary quaternion near the middle of them, learn a reference of zeta (over time with its rate
    and a VelocityKernel), and fit the primitive.
    """


class PoseKMP(_Rotating):
    """A skill whose output is a position and an orientation, n = 6, with their correlations: a
    primitive of position and zeta, over time with their rates. As for an `OrientationKMP`.
    """

    _positions = 3


def _unit(name: str, quaternions: ArrayLike, *shape: int) -> Array:
    q = numbers(name, quaternions, *(shape or ("T", 4)))
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    for n in np.flatnonzero(np.abs(length - 1) > _UNIT)[:1]:
        index_text = "" if shape else f"[{n}]"
        norm = f"{length.flat[n]:.4g}"
        raise ValueError(
            f"{name}{index_text} has norm {norm}, and must have 1. Divide by it, if that is what "
            "is meant."
        )
    return np.asarray(q / length)
