"""Skills whose output is an orientation: unit quaternions in a tangent space.

Huang et al., Generalized Orientation Learning in Robot Task Space, ICRA 2019, and Toward
Orientation Learning and Adaptation in Cartesian Space, T-RO 2021 ("T-RO"). zeta = log(q conj(q_a))
(3) lies in the tangent space at an auxiliary quaternion q_a; |zeta| is half of the angle of
rotation. Quaternions are x y z w, and q and -q are one orientation; rotations multiply from the
left, so that axes, angular velocities and deviations are those of the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, check_finite, not_negative, numbers, real
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, covariances, unchecked
from kmp.primitive import KMP, checked_primitive

_TINY = 1e-4  # [rad] below it a power series is exact to rounding
_CONJUGATE = frozen(np.array([-1.0, -1.0, -1.0, 1.0]))
_UNIT = 1e-3  # a norm farther from 1 is an error of the caller
_FREE = 1e6  # variance of a rate that is not prescribed, over the largest one of the reference


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


def rotation_per_zeta(zeta: ArrayLike) -> Array:
    """J (3, 3): a small rotation [rad], or angular velocity, is J times the change of zeta (3,).

    Twice the left Jacobian of SO(3) at v = 2 zeta: J = 2 (I + (1 - cos|v|) / |v|^2 [v] + (|v| -
    sin|v|) / |v|^3 [v]^2) with the cross product matrix [v]. The papers take finite differences in
    time instead. Raises ValueError if the shape differs or a number is not finite.
    """
    vector = 2 * numbers("zeta", zeta, 3)
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < _TINY:
        return np.asarray(2 * (np.eye(3) + cross / 2 + cross @ cross / 6))
    first = (1 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.asarray(2 * (np.eye(3) + first * cross + second * (cross @ cross)))


@dataclass(frozen=True, eq=False, repr=False)
class OrientationKMP(Immutable):
    """A skill whose output is an orientation: a primitive of zeta, over time with its rate.

    To learn one: make each demonstration's quaternions `continuous`, take `log` with a common
    auxiliary quaternion near the middle of them, learn a reference of zeta (over time with its rate
    and a VelocityKernel), and fit the primitive. Raises ValueError if the primitive has other
    outputs, or the auxiliary quaternion is not one.
    """

    primitive: KMP
    auxiliary: Array
    """(4,) q_a, x y z w."""

    def __post_init__(self) -> None:
        needed_outputs = 3 * checked_primitive(self.primitive).kernel.channels
        if (outputs := self.primitive.outputs) != needed_outputs:
            raise ValueError(
                f"primitive: {outputs} outputs given, {needed_outputs} needed for an orientation."
            )
        auxiliary = _unit("auxiliary", self.auxiliary, 4)
        object.__setattr__(self, "auxiliary", frozen(auxiliary.copy()))

    def mean(self, queries: ArrayLike) -> Array:
        """The orientations (M, 4) at queries (M, I), x y z w. Raises ValueError as `KMP.mean`."""
        return exp(self.primitive.mean(queries)[:, :3], self.auxiliary)

    def predict(self, queries: ArrayLike) -> tuple[Array, Array]:
        """The orientations (M, 4) at queries (M, I), and covariances J Sigma J^T (M, 3, 3) [rad^2].

        The covariances are those of small rotations in the world, with J of `rotation_per_zeta`.
        Raises ValueError as `KMP.predict`.
        """
        prediction = self.primitive.predict(queries)
        zeta = prediction.mean[:, :3]
        turn = np.array([rotation_per_zeta(tangent) for tangent in zeta]).reshape(-1, 3, 3)
        return exp(zeta, self.auxiliary), turn @ prediction.covariance[:, :3, :3] @ turn.transpose(
            0, 2, 1
        )

    def angular_velocity(self, query: ArrayLike, velocity: ArrayLike) -> Array:
        """omega (3,) [rad/s] at one query (I,) that moves with (I,) [unit of the inputs / s].

        omega = J dzeta/dt with J of `rotation_per_zeta`. If the input is time, its velocity is 1.
        Raises ValueError if a shape differs or a number is not finite.
        """
        still = np.zeros(self.primitive.inputs.shape[1])
        moving = self.primitive.predict_motion(query, velocity, still, covariance=False)
        return np.asarray(rotation_per_zeta(moving.mean[:3]) @ moving.velocity[:3])

    def adapt(
        self,
        inputs: ArrayLike,
        quaternions: ArrayLike,
        covariance: ArrayLike,
        *,
        tolerance: float | None = None,
        angular_velocities: ArrayLike | None = None,
        velocity_covariance: ArrayLike | None = None,
    ) -> OrientationKMP:
        """A new skill that also goes through orientations (V, 4) at inputs (V, I). x y z w.

        Of q and -q, the one nearer to the skill's present mean is used. `covariance` (3, 3) or
        (V, 3, 3) [rad^2] is that of small rotations; 0 is the least that rounding does not hide.
        Skills with rates take angular velocities too, (V, 3) [rad/s] with their covariance
        [(rad/s)^2]; None leaves them free. `tolerance` [unit of the inputs] is that of `KMP.adapt`.

        Raises ValueError as `KMP.adapt` does, if a quaternion has another norm than 1, or if rates
        are given to a skill without.
        """
        where = numbers("inputs", inputs, "V", self.primitive.inputs.shape[1])
        if tolerance is not None:
            not_negative("tolerance", tolerance)
        q = _unit("quaternions", numbers("quaternions", quaternions, len(where), 4))
        zeta = self._nearest(where, q)
        back = np.array([np.linalg.inv(rotation_per_zeta(tangent)) for tangent in zeta]).reshape(
            -1, 3, 3
        )
        turned = self._turned("covariance", covariance, back, self.primitive.least_variance)
        if self.primitive.kernel.channels == 1:
            if angular_velocities is not None or velocity_covariance is not None:
                raise ValueError(
                    "angular_velocities: the skill has no rates; fit it with a VelocityKernel."
                )
            return self._adapted(where, unchecked(zeta, turned), tolerance)
        if (angular_velocities is None) != (velocity_covariance is None):
            raise ValueError("angular_velocities and velocity_covariance: give both, or none.")
        if angular_velocities is None or velocity_covariance is None:
            rates = self.primitive.mean(where)[:, 3:]
            variance = _FREE * np.max(np.abs(self.primitive.reference.covariance))
            rate_covariance = np.tile(variance * np.eye(3), (len(where), 1, 1))
        else:
            omega = numbers("angular_velocities", angular_velocities, len(where), 3)
            rates = (back @ omega[:, :, None])[:, :, 0]
            least = self.primitive.least_variance * float(
                self.primitive.kernel.prior_variance[1, 1]
            )
            rate_covariance = self._turned("velocity_covariance", velocity_covariance, back, least)
        whole = np.zeros((len(where), 6, 6))
        whole[:, :3, :3] = turned
        whole[:, 3:, 3:] = rate_covariance
        return self._adapted(
            where, unchecked(np.hstack([zeta, rates]), symmetric(whole)), tolerance
        )

    @staticmethod
    def _turned(name: str, covariance: ArrayLike, back: Array, least: float) -> Array:
        """Covariances J^-1 S J^-T (V, 3, 3) of zeta or its rate, of S of rotations; 0 is exact.

        `back` is J^-1 (V, 3, 3). `least` is the least variance of zeta that rounding does not hide;
        a rotation's is at most 4 times that of zeta. Raises ValueError if a covariance is not
        positive definite, or too small.
        """
        count = len(back)
        array = real(name, covariance)
        array = numbers(
            name,
            np.broadcast_to(array, (count, 3, 3)) if array.shape == (3, 3) else array,
            count,
            3,
            3,
        )
        exact = ~array.any(axis=(1, 2), keepdims=True)
        checked = covariances(name, np.where(exact, np.eye(3), array), count, 3)
        turned = symmetric(back @ checked @ back.transpose(0, 2, 1))
        check_finite(name, turned, "too large:")
        for n in np.flatnonzero(np.linalg.eigvalsh(turned)[:, 0] < least)[:1]:
            smallest = np.linalg.eigvalsh(array[n])[0]
            raise ValueError(
                f"{name}[{n}] would be lost in rounding: its smallest eigenvalue is "
                f"{smallest:.3g}, and {4.1 * least:.2g} is enough. Give 0 for the least, or the "
                "primitive a larger lambda_covariance."
            )
        return np.where(exact, Gaussians.of(np.zeros(3), deviation=0).covariance, turned)

    def _adapted(
        self, inputs: Array, desired: Gaussians, tolerance: float | None
    ) -> OrientationKMP:
        return OrientationKMP(
            self.primitive.adapt(inputs, desired, tolerance=tolerance), self.auxiliary
        )

    def _nearest(self, inputs: Array, quaternions: Array) -> Array:
        """zeta (V, 3) of q or -q, whichever is nearer to the skill's present mean."""
        signs = np.where(
            (self.mean(inputs) * quaternions).sum(axis=1, keepdims=True) < 0, -1.0, 1.0
        )
        return log(signs * quaternions, self.auxiliary)


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
