"""Orientation of the tool and state of the gripper: a skill's predictions in addition to the
position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import sin_cos
from thirdhand.core.frame import Vector
from thirdhand.core.geometry import turn_on
from thirdhand.core.skill.tuning import (
    GRIPPER_CLOSE_ABOVE,
    GRIPPER_MOVES_S,
    GRIPPER_OPEN_BELOW,
    GRIPPER_THERE_M,
)
from thirdhand.core.vectors import add_product, round_to, rounded, square, times

if TYPE_CHECKING:
    from kmp import KMP


def decided(gripper: int, closure: float, *, since_s: float = math.inf, off: float = 0.0) -> int:
    """State of the gripper, UNKNOWN, OPEN or CLOSED, for a predicted `closure`.

    Its last change was `since_s` ago, and the tool is `off` [m] from its target. Hysteresis ignores
    a closure that trembles about the middle; the gripper is left alone until it has had time to
    move (GRIPPER_MOVES_S), and while the tool is more than GRIPPER_THERE_M from its target, because
    a late tool would open or close it elsewhere.
    """
    if closure == NO_GRIPPER:
        return gripper
    if gripper == UNKNOWN:
        return CLOSED if closure > 0.5 else OPEN
    if (
        since_s < GRIPPER_MOVES_S
        or off > GRIPPER_THERE_M
        or GRIPPER_OPEN_BELOW <= closure <= GRIPPER_CLOSE_ABOVE
    ):
        return gripper
    return CLOSED if closure > GRIPPER_CLOSE_ABOVE else OPEN


TURN_ROUND_TO = 1e6  # [1/rad] orientations and angular velocities are rounded to microradians
COVARIANCE_ROUND_TO = 1e10  # [1/rad²] covariances are rounded to 1e-10 rad²
CLOSURE_ROUND_TO = 1e6  # closures are rounded to 1e-6
NO_GRIPPER = -1.0  # the closure that a skill without a gripper predicts
# state of a gripper
UNKNOWN = 0
OPEN = 1
CLOSED = 2


class Turn(NamedTuple):
    """Predicted orientation of the tool, its rate and its uncertainty."""

    orientation: Vector  # (4,) quaternion x y z w
    velocity: Vector  # (3,) [rad/s] angular velocity, in frame base
    covariance: Vector  # (3, 3) [rad²] of small rotations, in frame base


@dataclass(frozen=True, eq=False)
class LearnedOrientation:
    """Primitive with 3 outputs ζ = log(q conj(q_a)), half the rotation vector [rad], see
    `kmp.orientation`.
    """

    primitive: KMP
    auxiliary: Vector  # (4,) q_a, quaternion x y z w

    def predict(self, at: Vector, velocity: Vector, *, covariance: Vector | None = None) -> Turn:
        """Orientation at an input (I,) with its velocity (I,), rounded to 1 µrad. A `covariance`
        (3, 3) [rad²] that was predicted before may be given; it is then returned as it is.
        """
        motion = self.primitive.predict_motion(
            at, velocity, np.zeros_like(at), covariance=covariance is None
        )
        quaternion = self.auxiliary.copy()
        turning = np.empty(3)
        if motion.covariance is None:
            assert covariance is not None
            _turned(motion.mean, motion.velocity, _NOTHING, quaternion, turning, np.empty((3, 3)))
            return Turn(quaternion, turning, covariance)
        turned = np.empty((3, 3))
        _turned(motion.mean, motion.velocity, motion.covariance, quaternion, turning, turned)
        return Turn(quaternion, turning, turned)


@dataclass(frozen=True, eq=False)
class LearnedGripper:
    """Primitive with 1 output, the closure of the gripper: 0 (open) to 1 (closed)."""

    primitive: KMP

    def predict(self, at: Vector) -> float:
        """Closure at an input (I,), clipped to 0 ... 1 and rounded."""
        motion = self.primitive.predict_motion(
            at, np.zeros_like(at), np.zeros_like(at), covariance=False
        )
        return (
            round(min(max(float(motion.mean[0]), 0.0), 1.0) * CLOSURE_ROUND_TO) / CLOSURE_ROUND_TO
        )


_NOTHING = np.zeros((3, 3))  # in place of a covariance that need not be computed


@compiled
def _turned(
    zeta: Vector,
    rate: Vector,
    covariance: Vector,
    quaternion: Vector,
    turning: Vector,
    turned: Vector,
) -> None:
    """Orientation from the primitive's output ζ (3,), its rate (3,) and its covariance C (3, 3), as
    in `kmp.orientation`. `quaternion` (4,) holds q_a, and is changed in place.

        φ = 2 ζ,   quaternion = exp(φ / 2) q_a,   J = 2 J_l(φ)
        turning = J dζ/dt,   turned = J C Jᵀ

    J_l is the left Jacobian of SO(3), with θ = |φ|:

        J_l = I + (1 - cos θ) / θ² [φ]× + (θ - sin θ) / θ³ [φ]×²

    `turning` (3,) is the angular velocity [rad/s], `turned` (3, 3) the covariance of small
    rotations [rad²], both in frame base.
    """
    vector = np.empty(3)
    per_zeta = np.empty((3, 3))
    part = np.zeros((3, 3))
    for i in range(3):
        vector[i] = 2.0 * rounded(zeta[i], TURN_ROUND_TO)
    squared_rad2 = square(vector)
    angle = math.sqrt(squared_rad2)

    # factors of [φ]× and [φ]×² in J_l, then `per_zeta` = J
    first = 0.5
    second = 1.0 / 6.0
    if angle > 1e-3:
        sine, cosine = sin_cos(angle)
        first = (1.0 - cosine) / squared_rad2
        second = (angle - sine) / (squared_rad2 * angle)
    for i in range(3):
        for j in range(3):
            per_zeta[i, j] = 2.0 * second * vector[i] * vector[j]
        per_zeta[i, i] += 2.0 * (1.0 - second * squared_rad2)
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        per_zeta[j, k] -= 2.0 * first * vector[i]
        per_zeta[k, j] += 2.0 * first * vector[i]

    turning[:] = times(per_zeta, rate)
    for i in range(3):
        turning[i] = rounded(turning[i], TURN_ROUND_TO)
    turned[:] = 0.0
    add_product(per_zeta, covariance, part)
    add_product(part, per_zeta.T, turned)
    round_to(turned, COVARIANCE_ROUND_TO)
    turn_on(quaternion, vector)
