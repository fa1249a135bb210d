"""A skill between via-points, which holds wherever these are: a KMP from how far along a stage of
the task each hand is to how far the tool is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.immutable import Immutable, frozen
from kmp.named_arrays import from_arrays
from service.contract.requests import ViaPoint
from service.core.frame import Records, Vector, structured
from service.core.intake.hand_estimator import STILL
from service.core.skill.model import COVARIANCE_ROUND_TO, Arrays, Motion, Seen
from service.core.skill.stages import (
    MOST_STAGES,
    OUTPUTS,
    PLACED,
    SEEN,
    along_both,
    expected,
    off_all,
    predicted,
    recognise,
    scatter,
    tools_at,
)
from service.core.skill.task import TASK_RANGES, TASK_UNITS, NamedViaPoints, Task, check_shapes
from service.core.skill.tuning import BELIEF_PERIODS, MOTION_STEP_S, STAGE_DISTANCE, STAGE_DISTANCE_BESIDE
from service.core.skill.via_points import bent

NO_PULLS = frozen(np.empty((0, 9)))  # where nothing else is taught
NO_ERRORS = frozen(np.empty((0, 6)))  # where no covariance is wanted


@dataclass(frozen=True, eq=False, repr=False)
class Placed(Immutable):
    """K stages where they are, R centres, M errors, X hands.

    rows: (R, 3 + 4) how far along each hand is, the stage, and weights. errors: (M, 3 + 3) the
    same and by how much [m] the tool was off. pulls: (X, 9) [m] hands around which the tool is
    moved besides, and weights, see `via_points.bent`.

    All arrays are read-only, wherever they come from: for others loops would be compiled once more,
    while they run.
    """

    stages: Records  # (K,) of STAGE
    sizes: Records  # (1,) of PLACED
    rows: Vector
    errors: Vector
    pulls: Vector

    def __post_init__(self) -> None:
        for part in (self.stages, self.sizes, self.rows, self.errors, self.pulls):
            frozen(part)

    @classmethod
    def of(cls, task: Task, at: NamedViaPoints, off: Vector, primitive: KMP, errors: Vector) -> Placed:
        """A task's via-points, how far hands (K, 2) are off their ways, a KMP and its errors."""
        sizes = structured(1, PLACED)
        sizes["scale"], sizes["likeness"] = scale_of(primitive), likeness(primitive)
        sizes["std"], sizes["prior"] = at.std, primitive.prior_offset
        along, stage = primitive.centres[:, :2], primitive.centres[:, 2:].argmax(axis=1)
        rows = np.column_stack([along, stage, primitive.weights.reshape(-1, OUTPUTS)])
        return cls(task.stages(at, off), sizes, rows, np.array(errors, order="C"), NO_PULLS)

    def belief(self, hands: Vector) -> Vector:
        """The belief (MOST_STAGES,) in each stage, of hands (6,) at rest and nothing before."""
        out, moving = np.zeros(MOST_STAGES), np.zeros((3, 6))
        out[: len(self.stages)] = 1.0 / len(self.stages)
        moving[0] = hands
        for _ in range(BELIEF_PERIODS):
            recognise(out, moving, 0.1, self.stages)
        return out

    def mean(self, hands: Vector, beliefs: Vector, stillness: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) that are so still (T, 2), or wholly, and beliefs (T,
        K or more).
        """
        out = np.empty((len(hands), 3))
        for t, (one, belief) in enumerate(zip(hands, beliefs, strict=True)):
            still = STILL if stillness is None else stillness[t]
            expected(belief, self._tools(one, still, belief, self.pulls), out[t])
        return out

    def _tools(self, hands: Vector, still: Vector, belief: Vector, pulls: Vector) -> Vector:
        """The tools (K, 3) [m] in the stages that are believed in, for hands (6,)."""
        out = np.empty((len(self.stages), 3))
        tools_at(np.ascontiguousarray(hands), still, belief, self.stages, self.sizes, self.rows, pulls, out)
        return out

    def gates_m(self, hands: Vector) -> Vector:
        """How far the farther one of hands (T, 6) is off all its ways, (T,) [m]."""
        return np.array([off_all(np.ascontiguousarray(one), self.stages) for one in hands])

    def covariance(self, hands: Vector, belief: Vector, still: Vector = STILL) -> Vector:
        """(3, 3) [m²] for hands (6,), a belief, and how still they are (2,): the scatter of errors
        near there, that of the stages' tools and that of the via-points.
        """
        out, hands = np.empty((3, 3)), np.ascontiguousarray(hands)
        tools = self._tools(hands, still, belief, NO_PULLS)
        scatter(hands, still, belief, self.stages, tools, self.errors, float(self.sizes["std"][0]), out)
        return np.asarray(np.rint(out * COVARIANCE_ROUND_TO) / COVARIANCE_ROUND_TO)


def scale_of(primitive: KMP) -> float:
    """Of its kernel exp(-scale |difference|²)."""
    return float(primitive.kernel.coordinates(1)[0])


def likeness(primitive: KMP) -> float:
    """What a centre of another stage counts, by how far stages are apart."""
    return math.exp(-2.0 * scale_of(primitive) * STAGE_DISTANCE**2)


@dataclass(frozen=True, eq=False)
class StagedKMP:
    """A model whose inputs are how far along a stage the left and the right hand are, and which of
    K stages it is (2 + K), whose outputs are how far along it the tool is, and an offset [m] (4).
    See `Model`.

    nominal: where the via-points were in the mean of the demonstrations. off: (K, 2) [m] how far
    hands are off their ways, root mean square. errors: (M, 6) by how much [m] the tool was off at
    some inputs when demonstrations were left out. delay_s: how late the teacher was.
    """

    primitive: KMP
    task: Task
    nominal: NamedViaPoints
    off: Vector
    errors: Vector
    delay_s: float
    via_points: tuple[ViaPoint, ...] = ()

    measure: ClassVar[str] = "a hand's distance from its ways between via-points"
    formats: ClassVar[tuple[int, ...]] = (5,)
    units: ClassVar[str] = TASK_UNITS
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = TASK_RANGES
    gripper_ell: ClassVar[float] = 20.0
    remembers: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        return 2 + len(self.off), OUTPUTS

    @property
    def names(self) -> tuple[str, ...]:
        return self.task.names

    @cached_property
    def hands(self) -> Vector:
        """Hands at every via-point."""
        begins, way = (self._unpulled.stages[name].reshape(-1, 6) for name in ("begins", "way"))
        return np.concatenate([begins, begins[-1:] + way[-1:]])

    @cached_property
    def placed(self) -> Placed:
        """The stages between the via-points in force; those of other names pull."""
        others = [point for point in self.via_points if point.name not in self.names]
        return replace(self._unpulled, pulls=np.hstack(bent(self._resting, self.hands, others)))

    @cached_property
    def _unpulled(self) -> Placed:
        at = self.nominal.moved(self.via_points)
        return Placed.of(self.task, at, self.off, self.primitive, self.errors)

    def _resting(self, hands: Vector) -> Vector:
        return self._unpulled.mean(hands, np.array([self._unpulled.belief(one) for one in hands]))

    def belief(self, hands: Vector) -> Vector:
        return self.placed.belief(hands)

    def predict(self, seen: Seen, known: Vector | None) -> Motion:
        """Equation (8) of Huang et al. 2019, differences along the motion, scatter of errors."""
        at, out, hands = self.placed, np.empty((6, 3)), np.zeros(1, SEEN)
        hands["moving"], hands["now"] = seen.moving, seen.now
        hands["stillness"], hands["period_s"] = seen.stillness, seen.period_s
        errors = at.errors if known is None else NO_ERRORS
        gate_m, torn = predicted(hands, seen.belief, at.stages, at.sizes, at.rows, at.pulls, errors, out)
        return Motion(out[0], out[1], out[2], out[3:] if known is None else known, gate_m, torn)

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        return self.placed.mean(hands, self._beliefs(hands, names))

    def covariances(self, hands: Vector) -> Vector:
        beliefs = self._beliefs(hands)
        return np.array([self.placed.covariance(*one) for one in zip(hands, beliefs, strict=True)]).reshape(-1, 3, 3)

    def gates_m(self, hands: Vector) -> Vector:
        return self.placed.gates_m(hands)

    def _beliefs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """The beliefs (T, MOST_STAGES) of hands that rest, at the via-points of these names."""
        out = np.array([self.placed.belief(one) for one in hands]).reshape(-1, MOST_STAGES)
        for row, name in zip(out, names, strict=bool(names)):
            if name in self.names:
                row[:] = 0.0
                row[max(self.names.index(name) - 1, 0)] = 1.0
        return out

    def inputs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        return np.array(
            [self._input(one, belief) for one, belief in zip(hands, self._beliefs(hands, names), strict=True)]
        ).reshape(-1, self.shape[0])

    def moving_inputs(self, seen: Seen) -> tuple[Vector, Vector]:
        hands, velocity = seen.moving[0], seen.moving[1]
        behind, now, ahead = (
            self._input(hands + step * velocity, seen.belief, seen.stillness)
            for step in (-MOTION_STEP_S, 0.0, MOTION_STEP_S)
        )
        return now, (ahead - behind) / (2.0 * MOTION_STEP_S)

    def _input(self, hands: Vector, belief: Vector, still: Vector = STILL) -> Vector:
        """How far along each hand is in the most probable stage; and the belief."""
        most = int(belief.argmax())
        stage, hands = self.placed.stages[most], np.ascontiguousarray(hands)
        along = along_both(hands, still, stage)
        return np.array([*along, *(STAGE_DISTANCE_BESIDE * belief[: len(self.off)])])

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> StagedKMP:
        """Nothing is solved: via-points of a known name are where the task is, others pull."""
        return replace(self, via_points=tuple(via_points))

    def unadapted(self) -> StagedKMP:
        return replace(self, via_points=())

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        return self.task.to_arrays() | {
            "nominal": self.nominal.at,
            "off_ways": self.off,
            "seen": np.ascontiguousarray(self.errors[:, :3]),
            "errors": np.ascontiguousarray(self.errors[:, 3:]),
            "delay": np.array(self.delay_s),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> StagedKMP:
        task = Task.from_arrays(arrays)
        count = len(task.names)
        shapes = {
            "nominal": (count, 9),
            "off_ways": (count - 1, 2),
            "seen": (len(arrays["errors"]), 3),
            "errors": (len(arrays["seen"]), 3),
        }
        check_shapes(arrays, shapes)
        errors = np.hstack([arrays["seen"], arrays["errors"]])
        off, delay_s = np.ascontiguousarray(arrays["off_ways"], np.float64), float(arrays["delay"])
        nominal = NamedViaPoints(task.names, arrays["nominal"])
        return cls(from_arrays(arrays), task, nominal, off, errors, delay_s, via_points)
