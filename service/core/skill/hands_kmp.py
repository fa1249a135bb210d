"""The paper's skill: a KMP from where the hands are, or also were, to where the tool should be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, Gaussians
from kmp.compiled import compiled
from service.contract.requests import ViaPoint
from service.core.frame import Vector
from service.core.geometry import round_to
from service.core.skill import ORDER
from service.core.skill.memory import moving_features
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
    """A model whose inputs are both hands' positions (6) [m], then how far behind them rows of
    their memory are (6 each) [m], whose outputs are the tool's (3) [m].

    How still a hand is makes no difference. See `Model`.
    """

    primitive: KMP

    measure: ClassVar[str] = "the target's standard deviation"
    formats: ClassVar[tuple[int, ...]] = (1, 2)
    units: ClassVar[str] = "inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = {}
    gripper_ell: ClassVar[float] = 1000.0  # 2 cm of a hand
    names: ClassVar[tuple[str, ...]] = ()

    @property
    def order(self) -> int:
        """How many rows of the memory are inputs."""
        return min(max(int(self.primitive.inputs.shape[1]) // 6 - 1, 0), ORDER)

    @property
    def shape(self) -> tuple[int, int]:
        return 6 * (1 + self.order), 3

    @property
    def hands(self) -> Vector:
        return self.primitive.inputs[:, :6]

    def predict(self, moving: Vector, stillness: Vector, known: Vector | None, past: Vector) -> Motion:
        """Equation (8) of Huang et al. 2019, its derivatives along the motion, and its covariance,
        which takes as long as all else.
        """
        moving = self._moving(moving, past)
        found = self.primitive.predict_motion(moving[0], moving[1], moving[2], covariance=known is None)
        covariance = found.covariance if known is None else known
        assert covariance is not None
        out = np.empty((6, 3))
        deviation = _rounded(found.mean, found.velocity, found.acceleration, covariance, out)
        return Motion(out[0], out[1], out[2], out[3:], deviation)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.primitive.mean(self.inputs(hands))

    def covariances(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.primitive.predict(self.inputs(hands)).covariance

    def gates_m(self, hands: Vector) -> Vector:
        return standard_deviations(self.covariances(hands))

    def inputs(self, hands: Vector) -> Vector:
        return np.pad(hands, ((0, 0), (0, 6 * self.order))) if self.order else hands

    def moving_inputs(self, moving: Vector, stillness: Vector, past: Vector) -> tuple[Vector, Vector]:
        moving = self._moving(moving, past)
        return moving[0], moving[1]

    def _moving(self, moving: Vector, past: Vector) -> Vector:
        """The inputs of hands that move so (3, 6), and how these move (3, I)."""
        if not self.order:
            return moving
        out = np.empty((3, self.shape[0]))
        moving_features(moving, past[: self.order], out)
        return out

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> HandsKMP:
        """Algorithm 1 of the paper."""
        hands, outputs, deviations = neighbourhoods(via_points)
        inputs = self.inputs(hands)
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
