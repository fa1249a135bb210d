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
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)  # of the regions whose reach a skill knows
CHI_SQUARE = (0.5844, 1.2125, 2.3660, 4.1083, 6.2514, 7.8147, 11.3449)  # that reach, of a normal in space
REGION_95 = CHI_SQUARE[LEVELS.index(0.95)]
Arrays = Mapping[str, NDArray[Any]]


class Regions(NamedTuple):
    """What makes of a model's covariance one whose regions hold what they say.

    It is published `scale` times, with what comes of being early or late added before: the motion
    of the last TRAIL_S in a deviation `std_s` of the time. `radii` are squared Mahalanobis
    distances under that covariance, of the regions of LEVELS; that of 95 % is as of a normal.
    """

    scale: float = 1.0
    std_s: float = 0.0
    radii: tuple[float, ...] = CHI_SQUARE


NORMAL = Regions()
"""Of a model whose errors are as normal ones with its covariance."""


class Motion(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is; rounded."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    gate_m: float  # [m] what is compared with the skill's threshold: see `Model.measure`
    torn: float = 0.0  # how probable it is that the tool should be elsewhere, in another stage


class Seen(NamedTuple):
    """What is known of both hands."""

    moving: Vector  # (3, 6) position, velocity and acceleration, as the teacher saw them
    stillness: Vector  # (2,) of each hand, 0 to 1
    past: Vector  # (ORDER, 6) [m] the memory of where they were, as `remember` keeps it
    turns: Vector  # (TURNS, 18) how they are turned; (0, 18) where nobody says so
    now: Vector  # (3, 6) how they move at this moment, which the gate is about
    belief: Vector  # (MOST_STAGES,) how probable each stage is; zeros: not yet known
    period_s: float  # that has passed since it was so: it is brought up to date


class Target(NamedTuple):
    """Where the tool is to go [m, m/s, m/s²], and whether that is not quite what was asked for."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    clamped: bool


class Wanted(NamedTuple):
    """What the skill asks for: the target in the workspace, and how the tool is to turn there."""

    target: Target
    orientation: Vector  # (4,) quaternion x y z w
    turning: Vector  # (3,) [rad/s]
    gate_m: float  # what is compared with the skill's threshold
    torn: bool  # it is not known which stage of the task it is
    needs: bool  # a hand that is not seen: the tool may be far from where it is to be


class Model(Protocol):
    """From the motion of two hands to the tool's; immutable.

    Hands are (T, 6) [m], the left one's x y z first. I inputs of its primitive and of those beside
    it, orientation and gripper. Where hands rest at via-points, their `names` tell which, of
    those at which hands are alike.
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
        """The via-points that it learned by their names, in the order of its stages."""

    @property
    def delay_s(self) -> float:
        """How late the teacher was whom it does not know of: it was learned as if he were not."""

    @property
    def remembers(self) -> bool:
        """Whether it is a function of where hands were too."""

    def belief(self, hands: Vector) -> Vector:
        """The belief (MOST_STAGES,) in each stage of hands (6,) at rest, and nothing before."""

    def predict(self, seen: Seen, known: Vector | None) -> Motion:
        """The motion of the tool. A covariance (3, 3) that is `known` is handed back; it takes long
        to find.
        """

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """The tool (T, 3) [m] for hands that have been where they are; so in all that follows."""

    def covariances(self, hands: Vector) -> Vector:
        """How sure `mean` is, (T, 3, 3) [m²]."""

    def gates_m(self, hands: Vector) -> Vector:
        """What is compared with the threshold, (T,) [m]."""

    def inputs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """The primitives' inputs (T, I)."""

    def moving_inputs(self, seen: Seen) -> tuple[Vector, Vector]:
        """The primitives' input (I,), and its velocity (I,)."""

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
