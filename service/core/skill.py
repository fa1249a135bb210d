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
from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.frame import Vector


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
    components: int = 0  # of the mixture that it was learned with
    via_points: tuple[ViaPoint, ...] = ()
    tolerance: float = TOLERANCE_M  # [m] a reference point nearer to a via-point gives way
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
        v, a = velocities.reshape(6), accelerations.reshape(6)
        found = self.primitive.predict_motion(hands.reshape(6), v, a, covariance=covariance is None)
        if found.covariance is not None:
            covariance = np.round(found.covariance, 10)
        assert covariance is not None
        jacobian = np.round(found.jacobian, 6)
        return Prediction(
            np.round(found.mean, 6),
            np.round(jacobian @ v, 6),
            np.round(jacobian @ a + found.curvature, 6),
            covariance,
            math.sqrt(float(np.trace(covariance)) / 3),
        )

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that tell this skill from any other."""
        return hashlib.blake2b(self.file, digest_size=16).digest()
