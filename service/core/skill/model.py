"""What predicts in a skill: one surface, whatever it is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.compiled import compiled
from service.contract.requests import ViaPoint
from service.core.frame import Vector

MOTION_ROUND_TO = 1e6  # [1/m] micrometres, to which positions and their derivatives are rounded
COVARIANCE_ROUND_TO = 1e10  # [1/m²] the same for covariances
FARTHEST_M = 10.0  # of anything in a skill's file from the base plate

Arrays = Mapping[str, NDArray[Any]]


class Motion(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is; rounded."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    gate_m: float  # [m] what is compared with the skill's threshold: see `Model.measure`


class Model(Protocol):
    """From the motion of two hands to the tool's; immutable.

    Hands are (T, 6) [m], the left one's x y z first, and each is still by (T, 2), 0 to 1: wholly,
    where that is not given. I inputs of its primitive and of those beside it, orientation and
    gripper.
    """

    measure: ClassVar[str]
    """In words, what `gate_m` is."""
    formats: ClassVar[tuple[int, ...]]
    """Of its file: without figures, with figures."""
    units: ClassVar[str]
    """Of its primitive, as its file says them."""
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]]
    """Least, greatest and unit of the numbers in each array that it stores beside its primitive."""
    gripper_ell: ClassVar[float]
    """[1 / (unit of the inputs)²] of a gripper's kernel: it opens and closes where hands arrive."""

    @property
    def primitive(self) -> KMP:
        """What was fitted to demonstrations."""

    @property
    def shape(self) -> tuple[int, int]:
        """Inputs and outputs that its primitive must have."""

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] that it knows."""

    @property
    def names(self) -> tuple[str, ...]:
        """The via-points that it learned by their names."""

    def predict(self, moving: Vector, stillness: Vector, known: Vector | None, past: Vector) -> Motion:
        """The motion of the tool for hands with this position, velocity and acceleration (3, 6).

        A covariance (3, 3) that is `known` is handed back; it takes long to find. `past` (ORDER, 6)
        [m] is the memory of the hands, as `remember` keeps it.
        """

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands that have been where they are; so in all that follows."""

    def covariances(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        """How sure `mean` is, (T, 3, 3) [m²]."""

    def gates_m(self, hands: Vector) -> Vector:
        """What is compared with the threshold, (T,) [m]."""

    def inputs(self, hands: Vector) -> Vector:
        """The primitives' inputs (T, I)."""

    def moving_inputs(self, moving: Vector, stillness: Vector, past: Vector) -> tuple[Vector, Vector]:
        """The primitives' input (I,) for hands that move so (3, 6), and its velocity (I,)."""

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> Self:
        """One that goes through these via-points and no others. Raises ValueError.

        `weight` multiplies their variances.
        """

    def unadapted(self) -> Self:
        """As it was learned."""

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        """What it stores beside its primitive, by name."""

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> Self:
        """What was stored in these arrays. Raises ValueError, KeyError."""


def standard_deviations(covariances: Vector) -> Vector:
    """Standard deviations (...) of covariances (..., 3, 3), root mean square over the axes."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariances, axis1=-2, axis2=-1), 0.0) / 3))


@compiled
def standard_deviation(covariance: Vector) -> float:
    """As `standard_deviations`, of one that was rounded."""
    return math.sqrt((covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0)
