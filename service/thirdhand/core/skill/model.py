"""Interface of the models with which a skill predicts the tool's motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kmp.compiled import compiled
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill import SIGNS
from thirdhand.core.skill.task_clock import TaskClock

if TYPE_CHECKING:
    from kmp import KMP

MOTION_ROUND_TO = 1e6  # [1/m] positions and their derivatives are rounded to micrometres
COVARIANCE_ROUND_TO = 1e10  # [1/m²] covariances are rounded to 1e-10 m²
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)  # confidence levels of the calibrated regions
# χ² with 3 degrees of freedom
CHI_SQUARE = (0.5844, 1.2125, 2.3660, 4.1083, 6.2514, 7.8147, 11.3449)
REGION_95 = CHI_SQUARE[LEVELS.index(0.95)]
Arrays = Mapping[str, NDArray[Any]]
NO_CLOCK = np.zeros(3)
NO_SIGNS = np.zeros(SIGNS)
KNOWN_SIGNS = np.zeros(0)
# For a normal distribution with tr C = t UNSURE_M², the logit of the probability that an error is
# larger than UNSURE_M is about -0.4 + 2 log t: its line through probabilities of 0.4 and 0.1.
NORMAL_WEIGHTS = (-0.4, 2.0, *SIGNS * [0.0])


class Regions(NamedTuple):
    """Calibration of a model's covariance C, so that its confidence regions contain as many errors
    as they state, and its errors are as probable as it states.

    The published covariance is scale (C + std_s² v vᵀ). v is the tool's mean velocity over the last
    TRAIL_S, and `std_s` the standard deviation of the prediction's timing. `radii` are the squared
    Mahalanobis distances under it that bound the regions of LEVELS; the one of 95 % is always that
    of a normal distribution.

    `weights` are those of a logistic regression, which makes an error probability of the published
    covariance and of signs, see `support.error_probability`. The skill is unsure where that
    probability is above the `alarm`; without one, where the 95 % region reaches farther than
    UNSURE_M.
    """

    scale: float = 1.0
    std_s: float = 0.0
    radii: tuple[float, ...] = CHI_SQUARE
    weights: tuple[float, ...] = NORMAL_WEIGHTS
    alarm: float = 0.0


NORMAL = Regions()
"""No calibration: the errors are normally distributed with the model's covariance."""


class Motion(NamedTuple):
    """Predicted motion of the tool and its uncertainty, rounded."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    # [m] distance that is compared with the skill's threshold: see `Model.measure`; NaN: that of
    # the prediction before
    gate_m: float
    ambiguity: float = 0.0  # probability that the tool belongs elsewhere, in another segment
    # (SIGNS,) of an error; (0,) if the covariance was known, with which they are computed
    signs: Vector = NO_SIGNS


class Seen(NamedTuple):
    """Motion, memory and belief of both hands: all that a model predicts from."""

    # (3, 6) position, velocity and acceleration of the hands, `delay_s` less the lead ago
    moving: Vector
    stillness: Vector  # (2,) stillness of each hand, 0 to 1
    past: Vector  # (ORDER, 6) [m] memory of the hands' positions, see `remember`
    # (TURNS, 18) filters of the hands' rotation matrices; (0, 18) if these are unknown
    turns: Vector
    turn_lag_s: float  # time constant of these filters
    now: Vector  # (3, 6) motion of the hands at this tick, from which gate and belief are computed
    belief: Vector  # (MOST_SEGMENTS,) probability of each segment; zeros: not yet known
    period_s: float  # time since the belief was updated; 0: it is not updated
    # (3,) or more: clock of the task [s] and its two derivatives; see `task_clock`
    clock: Vector = NO_CLOCK


class Target(NamedTuple):
    """Target of the tool [m, m/s, m/s²]; `clamped` is true if the prediction was outside the
    workspace.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    clamped: bool


class Wanted(NamedTuple):
    """Request of the skill to the stages after it: target in the workspace, and orientation."""

    target: Target
    orientation: Vector  # (4,) quaternion x y z w
    turning: Vector  # (3,) [rad/s]
    gate_m: float  # [m] distance that is compared with the skill's threshold
    is_ambiguous: bool  # true if the segment of the task is ambiguous
    needs_unseen_hand: bool  # true if a hand that is not seen may move the target far


class Model(Protocol):
    """Map from the motion of two hands to the motion of the tool; immutable.

    Hands are (T, 6) [m]: left x y z, right x y z. I is the number of inputs of the model's
    primitive, and of the primitives for orientation and gripper. Where hands rest at via-points,
    `names` are the via-points' names; they distinguish via-points at which the hands are alike.
    """

    measure: ClassVar[str]
    """Name of the distance `gate_m`."""
    units: ClassVar[str]
    """Units of its primitive, as its file states them."""
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]]
    """Minimum, maximum and unit of the numbers in each array stored beside its primitive."""
    gripper_ell: ClassVar[float]
    """Scale of the gripper's kernel [1 / (unit of the inputs)²]; it acts where the hands arrive."""

    @property
    def primitive(self) -> KMP:
        """Primitive that was fitted to the demonstrations."""

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of inputs and outputs that the primitive must have."""

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] of the demonstrations."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the via-points that were learned, in the order of the segments."""

    @property
    def delay_s(self) -> float:
        """Delay [s] of the demonstrated tool behind the hands: the model predicts the tool from the
        hands' motion this long ago.
        """

    @property
    def remembers(self) -> bool:
        """True if the hands' past positions are inputs."""

    @property
    def turned(self) -> bool:
        """True if the tool depends on the hands' orientation."""

    @property
    def clock(self) -> TaskClock | None:
        """Clock of the task, if it is an input."""

    @property
    def clock_rows(self) -> Vector | None:
        """Parameters (K, 13) of the clock in each segment, see `task_clock.count`."""

    def belief(self, hands: Vector) -> Vector:
        """Belief (MOST_SEGMENTS,) in each segment for hands (6,) that have always been at rest."""

    def predict(self, seen: Seen, known: Vector | None) -> Motion:
        """Predict the motion of the tool. A covariance (3, 3) that is `known` is returned as it is,
        because computing one takes long. What the gate compares is then NaN if it is computed from
        another covariance.
        """

    def elsewhere(
        self, now: Vector, stillness: Vector, period_s: float, belief: Vector, unprimed: Vector
    ) -> float:
        """Probability that the task did not begin at its first segment, so that the tool belongs
        elsewhere, for the hands' motion (3, 6); `unprimed` (MOST_SEGMENTS,) is updated in place.
        """

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """Tool positions (T, 3) [m] for hands (T, 6) that have always been at rest, as in all
        methods below.
        """

    def covariances(self, hands: Vector) -> Vector:
        """Covariances (T, 3, 3) [m²] of `mean`."""

    def gates_m(self, hands: Vector) -> Vector:
        """Distances (T,) [m] that are compared with the skill's threshold."""

    def inputs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """Inputs (T, I) of the primitives."""

    def moving_inputs(self, seen: Seen) -> tuple[Vector, Vector]:
        """Input (I,) of the primitives for moving hands, and its velocity (I,)."""

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> Self:
        """Model adapted to these via-points and no others, whose variances are multiplied by
        `weight`. Raises ValueError.
        """

    def unadapted(self) -> Self:
        """Model as it was learned, without adaptation to via-points."""

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays by name that a skill's file has beside the primitive."""

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> Self:
        """Model stored in the arrays of a skill's file. Raises ValueError, KeyError."""


def standard_deviations(covariances: Vector) -> Vector:
    """Standard deviations (...) of covariances (..., 3, 3): sqrt(trace / 3)."""
    return np.asarray(np.sqrt(np.maximum(np.trace(covariances, axis1=-2, axis2=-1), 0.0) / 3))


@compiled
def standard_deviation(covariance: Vector) -> float:
    """Standard deviation sqrt(trace / 3) of one rounded covariance (3, 3)."""
    return math.sqrt((covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3.0)
