"""What a skill knows of the tool besides where it is: how it is turned, and whether the gripper is
closed. Both from the same input as the position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kmp import KMP
from kmp.compiled import compiled
from service.core.frame import Vector
from service.core.geometry import turn_on
from service.core.skill.tuning import GRIPPER_CLOSE_ABOVE, GRIPPER_MOVES_S, GRIPPER_OPEN_BELOW, GRIPPER_THERE_M


def decided(gripper: int, closure: float, *, since_s: float = math.inf, off: float = 0.0) -> int:
    """UNKNOWN, OPEN or CLOSED: what becomes of a gripper, which changed so long ago, where such a
    closure is predicted and the tool is so far off [m].

    With hysteresis, and not before it can have moved: what trembles about the middle changes
    nothing. Not on the way: a tool that is late would open or close elsewhere.
    """
    if closure == NO_GRIPPER:
        return gripper
    if gripper == UNKNOWN:
        return CLOSED if closure > 0.5 else OPEN
    if since_s < GRIPPER_MOVES_S or off > GRIPPER_THERE_M or GRIPPER_OPEN_BELOW <= closure <= GRIPPER_CLOSE_ABOVE:
        return gripper
    return CLOSED if closure > GRIPPER_CLOSE_ABOVE else OPEN


TURN_ROUND_TO = 1e6  # [1/rad] microradians, to which orientations and angular velocities are rounded
COVARIANCE_ROUND_TO = 1e10  # [1/rad²] the same for covariances
CLOSURE_ROUND_TO = 1e6  # the same for closures
NO_GRIPPER = -1.0  # the closure that a skill without a gripper predicts
UNKNOWN, OPEN, CLOSED = 0, 1, 2  # of a gripper


class Turn(NamedTuple):
    """How the tool should be turned, how that changes, and how sure it is."""

    orientation: Vector  # (4,) quaternion x y z w
    velocity: Vector  # (3,) [rad/s] angular velocity, in frame base
    covariance: Vector  # (3, 3) [rad²] of small rotations, in frame base


@dataclass(frozen=True, eq=False)
class LearnedOrientation:
    """A primitive of zeta = log(q conj(q_a)) (3 outputs, half the angle [rad]), as
    `kmp.orientation` has it.
    """

    primitive: KMP
    auxiliary: Vector  # (4,) q_a, quaternion x y z w

    def predict(self, at: Vector, velocity: Vector, *, covariance: Vector | None = None) -> Turn:
        """The orientation at an input (I,) that moves so. One covariance that was predicted just
        before may be given (3, 3) [rad²]. Rounded (1 µrad), as positions are.
        """
        found = self.primitive.predict_motion(at, velocity, np.zeros_like(at), covariance=covariance is None)
        quaternion, turning = self.auxiliary.copy(), np.empty(3)
        if found.covariance is None:
            assert covariance is not None
            _turned(found.mean, found.velocity, _NOTHING, quaternion, turning, np.empty((3, 3)))
            return Turn(quaternion, turning, covariance)
        turned = np.empty((3, 3))
        _turned(found.mean, found.velocity, found.covariance, quaternion, turning, turned)
        return Turn(quaternion, turning, turned)


@dataclass(frozen=True, eq=False)
class LearnedGripper:
    """A primitive of how far the gripper is closed, 0 to 1 (1 output)."""

    primitive: KMP

    def predict(self, at: Vector) -> float:
        """How far it should be closed at an input (I,), 0 (open) to 1 (closed)."""
        found = self.primitive.predict_motion(at, np.zeros_like(at), np.zeros_like(at), covariance=False)
        return round(min(max(float(found.mean[0]), 0.0), 1.0) * CLOSURE_ROUND_TO) / CLOSURE_ROUND_TO


_NOTHING = np.zeros((3, 3))  # in place of a covariance that is known


@compiled
def _turned(
    zeta: Vector, rate: Vector, covariance: Vector, quaternion: Vector, turning: Vector, turned: Vector
) -> None:
    """Turns the auxiliary quaternion (4,) by 2 zeta, in place; into turning (3,) the angular
    velocity, into turned (3, 3) the covariance of small rotations.

    As `kmp.orientation`: by the left Jacobian of the rotation.
    """
    vector, per_zeta, part = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    square = 0.0
    for i in range(3):
        vector[i] = 2.0 * np.rint(zeta[i] * TURN_ROUND_TO) / TURN_ROUND_TO
        square += vector[i] * vector[i]
    angle = math.sqrt(square)
    first, second = 0.5, 1.0 / 6.0
    if angle > 1e-3:
        first, second = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    for i in range(3):
        for j in range(3):
            per_zeta[i, j] = 2.0 * second * vector[i] * vector[j]
        per_zeta[i, i] += 2.0 * (1.0 - second * square)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        per_zeta[j, k] -= 2.0 * first * vector[i]
        per_zeta[k, j] += 2.0 * first * vector[i]
    for i in range(3):
        turning[i] = 0.0
        for j in range(3):
            turning[i] += per_zeta[i, j] * rate[j]
            part[i, j] = 0.0
            for k in range(3):
                part[i, j] += per_zeta[i, k] * covariance[k, j]
        turning[i] = np.rint(turning[i] * TURN_ROUND_TO) / TURN_ROUND_TO
    for i in range(3):
        for j in range(3):
            turned[i, j] = 0.0
            for k in range(3):
                turned[i, j] += part[i, k] * per_zeta[j, k]
            turned[i, j] = np.rint(turned[i, j] * COVARIANCE_ROUND_TO) / COVARIANCE_ROUND_TO
    turn_on(quaternion, vector)
