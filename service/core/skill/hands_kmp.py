"""The paper's skill: a KMP from where the hands are to where the tool should be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, Gaussians
from kmp.compiled import compiled
from service.contract.records import Layout
from service.contract.requests import ViaPoint
from service.core.frame import Record, Vector
from service.core.geometry import round_to
from service.core.skill.model import (
    COVARIANCE_ROUND_TO,
    MOTION_ROUND_TO,
    Arrays,
    Motion,
    standard_deviation,
    standard_deviations,
)
from service.core.skill.via_points import neighbourhoods


@dataclass(frozen=True, eq=False)
class HandsKMP:
    """A model whose inputs are both hands' positions (6) [m], whose outputs are the tool's (3) [m].

    How still a hand is makes no difference. See `Model`.
    """

    primitive: KMP

    measure: ClassVar[str] = "the target's standard deviation"
    formats: ClassVar[tuple[int, ...]] = (1, 2)
    units: ClassVar[str] = "inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = {}
    state_fields: ClassVar[Layout] = ()
    gripper_ell: ClassVar[float] = 1000.0  # 2 cm of a hand
    shape: ClassVar[tuple[int, int]] = (6, 3)
    names: ClassVar[tuple[str, ...]] = ()

    @property
    def hands(self) -> Vector:
        return self.primitive.inputs

    def predict(self, moving: Vector, stillness: Vector, known: Vector | None, memory: Record | None) -> Motion:
        """Equation (8) of Huang et al. 2019, its derivatives along the motion, and its covariance,
        which takes as long as all else.
        """
        found = self.primitive.predict_motion(moving[0], moving[1], moving[2], covariance=known is None)
        covariance = found.covariance if known is None else known
        assert covariance is not None
        out = np.empty((6, 3))
        deviation = _rounded(found.mean, found.velocity, found.acceleration, covariance, out)
        return Motion(out[0], out[1], out[2], out[3:], deviation)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.primitive.mean(hands)

    def covariances(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.primitive.predict(hands).covariance

    def gates_m(self, hands: Vector) -> Vector:
        return standard_deviations(self.covariances(hands))

    def inputs(self, hands: Vector) -> Vector:
        return hands

    def moving_inputs(self, moving: Vector, stillness: Vector) -> tuple[Vector, Vector]:
        return moving[0], moving[1]

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> HandsKMP:
        """Algorithm 1 of the paper."""
        inputs, outputs, deviations = neighbourhoods(via_points)
        desired = Gaussians(outputs, weight * deviations[:, None, None] ** 2 * np.eye(3))
        return replace(self, primitive=self.primitive.base.adapt(inputs, desired, tolerance=tolerance))

    def unadapted(self) -> HandsKMP:
        return replace(self, primitive=self.primitive.base)

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        return {}

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> HandsKMP:
        return cls(KMP.from_arrays(arrays))


@compiled
def _rounded(mean: Vector, velocity: Vector, acceleration: Vector, covariance: Vector, out: Vector) -> float:
    """Rounds a prediction into `out` (6, 3); its standard deviation."""
    out[0], out[1], out[2], out[3:] = mean, velocity, acceleration, covariance
    round_to(out[:3], MOTION_ROUND_TO)
    round_to(out[3:], COVARIANCE_ROUND_TO)
    return standard_deviation(out[3:])
