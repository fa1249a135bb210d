"""The skill as the loop uses it: from the motion of two hands to where the tool should be, how that
moves, and how sure it is.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from kmp import KMP
from kmp.compiled import compiled
from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.frame import Vector

MOTION_STEPS, COVARIANCE_STEPS = 1e6, 1e10  # [1/m], [1/m²] to which a prediction is rounded


class Prediction(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    deviation: float  # root mean square over the axes [m]


@dataclass(frozen=True, eq=False)
class Skill:
    """Immutable: a KMP from both hands' positions (6 inputs [m]) to the tool's (3 outputs [m]), and
    what belongs to it.

    Made by `service.learning`, which learns, adapts and stores it.
    """

    name: str
    primitive: KMP
    orientation: Vector  # (4,) of the tool, quaternion x y z w
    workspace: Vector  # (2, 3) lower and upper corner for targets [m]
    threshold: float  # [m] a deviation above it is far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0  # of the mixture that it was learned with, 0 for none
    via_points: tuple[ViaPoint, ...] = ()
    tolerance: float = TOLERANCE_M  # [m] a reference point nearer to a via-point gives way
    figures: str = ""  # JSON of what was found in learning; empty where it was not judged
    file: bytes = field(default=b"", repr=False)  # all of the above, as it is stored and recorded

    def predict(
        self, hands: Vector, velocities: Vector, accelerations: Vector, *, covariance: Vector | None = None
    ) -> Prediction:
        """The prediction for hands (2, 3) [m] that move so.

        Equation (8) of Huang et al. 2019, its derivatives along the motion, its covariance. The
        covariance takes as long as all else; one that was predicted just before may be given (3, 3)
        [m²].

        Rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines that differ in the last bits agree on all
        that follows.
        """
        found = self.primitive.predict_motion(
            hands.reshape(6), velocities.reshape(6), accelerations.reshape(6), covariance=covariance is None
        )
        given = covariance if found.covariance is None else found.covariance
        assert given is not None
        motion, rounded = np.empty((3, 3)), np.empty((3, 3))
        deviation = _round(found.mean, found.velocity, found.acceleration, given, motion, rounded)
        return Prediction(motion[0], motion[1], motion[2], rounded, deviation)

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that tell this skill from any other."""
        return hashlib.blake2b(self.file, digest_size=16).digest()


@compiled
def _round(
    mean: Vector, velocity: Vector, acceleration: Vector, covariance: Vector, motion: Vector, rounded: Vector
) -> float:
    """Rounds a prediction into `motion` (3, 3) and `rounded` (3, 3); its deviation."""
    variance = 0.0
    for i in range(3):
        motion[0, i] = np.rint(mean[i] * MOTION_STEPS) / MOTION_STEPS
        motion[1, i] = np.rint(velocity[i] * MOTION_STEPS) / MOTION_STEPS
        motion[2, i] = np.rint(acceleration[i] * MOTION_STEPS) / MOTION_STEPS
        for j in range(3):
            rounded[i, j] = np.rint(covariance[i, j] * COVARIANCE_STEPS) / COVARIANCE_STEPS
        variance += rounded[i, i]
    return math.sqrt(variance / 3.0)
