"""Skill of the paper: a kernelised movement primitive (KMP) from the hands' positions, and
optionally their past and their orientation, to the tool's position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from kmp import KMP, Gaussians
from kmp.compiled import compiled
from kmp.named_arrays import from_arrays
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M, ORDER, SIGNS, TURNS
from thirdhand.core.skill.memory import moving_features
from thirdhand.core.skill.model import (
    COVARIANCE_ROUND_TO,
    KNOWN_SIGNS,
    MOTION_ROUND_TO,
    NO_SIGNS,
    Arrays,
    Motion,
    Seen,
    standard_deviation,
    standard_deviations,
)
from thirdhand.core.skill.segments import MOST_SEGMENTS
from thirdhand.core.skill.support import (
    LocalErrors,
    averages,
    mix,
    neighbour_table,
    stretch_of,
)
from thirdhand.core.skill.task import check_shapes
from thirdhand.core.skill.task_clock import TaskClock
from thirdhand.core.skill.tuning import TURN_WEIGHT_M
from thirdhand.core.skill.via_points import neighbourhoods
from thirdhand.core.vectors import round_to

TURN_INPUTS = 18  # the entries of both hands' rotation matrices


@dataclass(frozen=True, eq=False)
class HandsKMP:
    """Model with the outputs tool position (3,) [m] and these I inputs [m], see `Model`:

    * both hands' positions (6);
    * for each of `order` rows of their memory, its offset from these positions (6 each);
    * if `turned`, both hands' rotation matrices times TURN_WEIGHT_M (18);
    * if the `clock` of the task has a weight, its time times its weight (1).

    A hand of unknown orientation is assumed to have the mean orientation of the demonstrations.
    Where no clock is known, as at a via-point, it is that of the nearest reference point.

    The mean is a mixture of the primitive's and, with the share `neighbours`, of the average tool
    at the reference points nearby, see `thirdhand.core.skill.support`.

    With the `errors` of held-out demonstrations, the covariance is their local scatter, and there
    are signs of an error; without them, it is the primitive's. The gate always compares the
    primitive's.
    """

    primitive: KMP
    turned: bool = False  # true if the hands' orientation is an input
    clock: TaskClock | None = None
    errors: LocalErrors | None = None
    neighbours: float = 0.0

    measure: ClassVar[str] = "the target's standard deviation"
    units: ClassVar[str] = (
        "inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"
    )
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = {
        "error_inputs": (-1e3, 1e3, ""),
        "error_samples": (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
        "error_unknown_std": (0.0, MAX_SKILL_DISTANCE_M, "m"),
        "neighbours": (0.0, 1.0, ""),
    }
    # [1/m²] the kernel's standard deviation is 2 cm of a hand's motion
    gripper_ell: ClassVar[float] = 1000.0
    names: ClassVar[tuple[str, ...]] = ()
    delay_s: ClassVar[float] = 0.0

    @property
    def order(self) -> int:
        """Number of rows of the hands' memory that are inputs."""
        extra_inputs = TURN_INPUTS * self.turned + self.is_timed
        return min(max((int(self.primitive.inputs.shape[1]) - extra_inputs) // 6 - 1, 0), ORDER)

    @property
    def shape(self) -> tuple[int, int]:
        return 6 * (1 + self.order) + TURN_INPUTS * self.turned + self.is_timed, 3

    @property
    def is_timed(self) -> bool:
        """True if the clock is an input."""
        return self.clock is not None and self.clock.weight > 0.0

    @cached_property
    def _usual_turns(self) -> Vector:
        """Mean orientation inputs (TURN_INPUTS,) [m] of the demonstrations; empty if orientation is
        no input.
        """
        first = 6 * (1 + self.order)
        return np.asarray(
            self.primitive.base.inputs[:, first : first + TURN_INPUTS * self.turned].mean(axis=0)
        )

    @property
    def hands(self) -> Vector:
        return self.primitive.inputs[:, :6]

    @property
    def remembers(self) -> bool:
        return self.order > 0

    @cached_property
    def clock_rows(self) -> Vector | None:
        return None if self.clock is None else self.clock.numbers[None]

    def belief(self, hands: Vector) -> Vector:
        return np.zeros(MOST_SEGMENTS)

    def predict(self, seen: Seen, known: Vector | None) -> Motion:
        """Motion of the tool: equation (8) of Huang et al. 2019 and its derivatives along the
        hands' motion.

        The covariance, which takes as long as all else, is computed only if it is not `known`.
        """
        moving = self._moving(seen)
        motion = self.primitive.predict_motion(
            moving[0], moving[1], moving[2], covariance=known is None
        )
        covariance = motion.covariance if known is None else known
        assert covariance is not None
        out = np.empty((6, 3))
        out[:3] = motion.mean, motion.velocity, motion.acceleration
        signs = NO_SIGNS if known is None else KNOWN_SIGNS
        errors = self.errors if known is None else None
        if errors is not None:
            signs = np.empty(SIGNS)
            self._mix(moving, self.neighbours, out[:3], signs)
        elif self.neighbours:
            self._mix(moving, self.neighbours, out[:3], KNOWN_SIGNS)
        deviation = _rounded(covariance, out)
        if errors is not None:
            errors.scatter(np.ascontiguousarray(moving[0]), out[3:], signs[-2:])
            round_to(out[3:], COVARIANCE_ROUND_TO)
        if known is not None and self.errors is not None:
            # the gate compares the primitive's own covariance, which was not computed
            deviation = math.nan
        return Motion(out[0], out[1], out[2], out[3:], deviation, signs=signs)

    def _mix(self, moving: Vector, share: float, motion: Vector, signs: Vector) -> None:
        """Mix the neighbours into a motion (3, 3) and write the first signs of an error, unless
        there are none, see `mix`.
        """
        table, stretch = self._near
        unknown_std_m = 0.0 if self.errors is None else self.errors.unknown_std_m
        mix(np.ascontiguousarray(moving), table, stretch, share, unknown_std_m, motion, signs)

    @cached_property
    def _near(self) -> tuple[Vector, Vector]:
        """The `neighbour_table` of the reference points, and the stretch (I,) of their inputs."""
        base = self.primitive.base
        stretch = stretch_of(self.clock, base.inputs)
        return neighbour_table(base.inputs * stretch, base.reference.mean), stretch

    def tools(self, inputs: Vector) -> Vector:
        """Mean tool (T, 3) [m] at inputs (T, I)."""
        out = np.array(self.primitive.mean(inputs))
        if self.neighbours:
            shares, average_tools = self._averages(inputs)
            out += self.neighbours * (average_tools - shares * out)
        return out

    def _averages(self, inputs: Vector) -> tuple[Vector, Vector]:
        """Shares (T, 1) and average tools (T, 3) [m] at inputs (T, I), see `support.averages`."""
        base = self.primitive.base
        stretch = self._near[1]
        squares = cdist(inputs * stretch, base.inputs * stretch, "sqeuclidean")
        return averages(squares, base.reference.mean)

    def uncertainty(self, inputs: Vector, tools: Vector) -> tuple[Vector, Vector]:
        """Covariances (T, 3, 3) [m²] and signs (T, SIGNS) of errors of these tools (T, 3) [m] at
        inputs (T, I). The model must have held-out errors.
        """
        assert self.errors is not None
        covariances = np.empty((len(inputs), 3, 3))
        signs = np.empty((len(inputs), SIGNS))
        moving = np.zeros((3, inputs.shape[1]))
        motion = np.empty((3, 3))
        for t in range(len(inputs)):
            moving[0] = inputs[t]
            motion[0] = tools[t]
            self._mix(moving, 0.0, motion, signs[t])
            self.errors.scatter(moving[0], covariances[t], signs[t, -2:])
        return covariances, signs

    def elsewhere(
        self, now: Vector, stillness: Vector, period_s: float, belief: Vector, unprimed: Vector
    ) -> float:
        return 0.0

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        return self.tools(self.inputs(hands))

    def covariances(self, hands: Vector) -> Vector:
        if self.errors is not None:
            return self.errors.covariances(self.inputs(hands))
        return self.primitive.predict(self.inputs(hands)).covariance

    def gates_m(self, hands: Vector) -> Vector:
        return standard_deviations(self.primitive.predict(self.inputs(hands)).covariance)

    def inputs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        if not self._is_rich:
            return hands
        usual = self._usual_turns
        out = [hands, np.zeros((len(hands), 6 * self.order)), np.tile(usual, (len(hands), 1))]
        if self.is_timed:
            learned = self.primitive.base.inputs
            nearest = ((hands[:, None] - learned[:, :6]) ** 2).sum(axis=2).argmin(axis=1)
            out.append(learned[nearest, -1:])
        return np.hstack(out)

    @property
    def _is_rich(self) -> bool:
        """True if there are other inputs than positions."""
        return bool(self.order or self.turned or self.is_timed)

    def moving_inputs(self, seen: Seen) -> tuple[Vector, Vector]:
        moving = self._moving(seen)
        return moving[0], moving[1]

    def _moving(self, seen: Seen) -> Vector:
        """Inputs (I,) with their velocity and acceleration, (3, I)."""
        if not self._is_rich:
            return seen.moving
        turns = seen.turns
        out = np.empty((3, self.shape[0]))
        if self.turned and not len(turns):
            turns = np.tile(self._usual_turns / TURN_WEIGHT_M, (TURNS, 1))
        moving_features(seen.moving, seen.past[: self.order], turns, out)
        if self.clock is not None and self.clock.weight > 0.0:
            out[:, -1] = self.clock.weight * seen.clock[:3]
        return out

    def through(
        self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float
    ) -> HandsKMP:
        """Model adapted to via-points by Algorithm 1 of Huang et al. 2019. The primitive passes
        through where the mixture with the neighbours then passes through the via-points.
        """
        hands, outputs, deviations = neighbourhoods(via_points)
        inputs = self.inputs(hands)
        if self.neighbours and len(inputs):
            shares, average_tools = self._averages(inputs)
            outputs = outputs - self.neighbours * average_tools
            outputs /= 1.0 - self.neighbours * shares
        desired = Gaussians(outputs, weight * deviations[:, None, None] ** 2 * np.eye(3))
        return replace(
            self, primitive=self.primitive.base.adapt(inputs, desired, tolerance=tolerance)
        )

    def unadapted(self) -> HandsKMP:
        return replace(self, primitive=self.primitive.base)

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        out: dict[str, NDArray[Any]] = {"turned": np.array(1)} if self.turned else {}
        if self.clock is not None:
            out["task_clock"] = self.clock.numbers
        if self.neighbours:
            out["neighbours"] = np.array(self.neighbours)
        if self.errors is not None:
            out["error_inputs"] = self.errors.inputs
            out["error_samples"] = self.errors.errors
            out["error_unknown_std"] = np.array(self.errors.unknown_std_m)
        return out

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> HandsKMP:
        primitive = from_arrays(arrays)
        errors = None
        clock = TaskClock.of(arrays["task_clock"].ravel()) if "task_clock" in arrays else None
        if "error_inputs" in arrays:
            count = len(arrays["error_inputs"])
            shapes = {
                "error_inputs": (count, primitive.inputs.shape[1]),
                "error_samples": (count, 3),
            }
            check_shapes(arrays, shapes)
            unknown_std_m = float(arrays["error_unknown_std"])
            errors = LocalErrors.of(
                primitive, arrays["error_inputs"], arrays["error_samples"], unknown_std_m
            )
        neighbours = float(arrays.get("neighbours", 0.0))
        return cls(primitive, "turned" in arrays, clock, errors, neighbours)


@compiled
def _rounded(covariance: Vector, out: Vector) -> float:
    """Round the position, velocity and acceleration in `out` (6, 3), and write the rounded
    covariance (3, 3) below them. Returns the standard deviation [m] of that covariance.
    """
    out[3:] = covariance
    round_to(out[:3], MOTION_ROUND_TO)
    round_to(out[3:], COVARIANCE_ROUND_TO)
    return standard_deviation(out[3:])
