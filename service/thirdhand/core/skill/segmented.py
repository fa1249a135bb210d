"""Skill between named via-points, which moves with them: a KMP from the share of a segment that
each hand has covered to the share that the tool covers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, GaussianKernel
from kmp.arrays.immutable import Immutable, frozen
from kmp.loops.mean import table_of
from kmp.named_arrays import from_arrays
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Records, Vector, structured
from thirdhand.core.intake.hand_estimator import STILL
from thirdhand.core.numerics import BELIEF_PERIODS, MOTION_STEP_S
from thirdhand.core.skill.model import COVARIANCE_ROUND_TO, Arrays, Motion, Seen
from thirdhand.core.skill.segments import (
    MOST_SEGMENTS,
    OUTPUTS,
    PLACED,
    along_both,
    elsewhere,
    expected,
    off_all,
    predicted,
    recognise,
    scatter,
    tools_at,
)
from thirdhand.core.skill.support import error_table
from thirdhand.core.skill.task import TASK_RANGES, TASK_UNITS, NamedViaPoints, Task, check_shapes
from thirdhand.core.skill.task_clock import TaskClock
from thirdhand.core.skill.tuning import (
    ERROR_SEGMENT_DISTANCE,
    FIRST_SEGMENT_ODDS,
    PULL_SHARPNESS_PER_M2,
    SEGMENT_DISTANCE_BESIDE,
)
from thirdhand.core.skill.via_points import pulls_through, sharpness_between

NO_PULLS = frozen(np.empty((0, 9)))  # without via-points of other names
NO_ERRORS = frozen(np.empty((0, 6)))  # to leave out the covariance; as rows and as a table
RESTING_TEMPO = np.array([*STILL, 0.0])  # tempo of two hands that rest and have not begun


class Unknown(NamedTuple):
    """Scatter of the tool's position where nothing was demonstrated.

    * `std_m`: standard deviation on each axis [m], away from all demonstrations.
    * `scatters` (N, 3, 3) [m²]: covariances of the tool at the N via-points over the
      demonstrations, for via-points that are not known in a scene.
    """

    std_m: float
    scatters: Vector


@dataclass(frozen=True, eq=False, repr=False)
class Placed(Immutable):
    """Segments of a task at their via-points in a scene, with the primitive as plain arrays: K
    segments, R centres, M errors, X pulls.

    * `centres`: the primitive's centres and weights as a table of `kmp.loops.mean`, see
      `segments.tools_at`.
    * `errors`: the tool's errors in held-out demonstrations as a table, see `segments.scatter`.
    * `pulls` (X, 9): hands (6,) [m] and weight (3,) [m] of the kernels by which other via-points
      move the tool, see `via_points.pulls_through`.

    All arrays are read-only: for writable ones, the compiled functions would be compiled once more
    while the loop runs.
    """

    segments: Records  # (K,) of SEGMENT
    sizes: Records  # (1,) of PLACED
    centres: Vector
    errors: Vector
    pulls: Vector

    def __post_init__(self) -> None:
        for part in (self.segments, self.sizes, self.centres, self.errors, self.pulls):
            frozen(part)

    @classmethod
    def of(
        cls,
        task: Task,
        at: NamedViaPoints,
        off: Vector,
        primitive: KMP,
        errors: Vector,
        clock: TaskClock | None = None,
        unknown: Unknown | None = None,
    ) -> Placed:
        """Segments of a task at these via-points. `off` (K, 2) [m] are the distances of the hands
        from their paths, root mean square; `errors` (M, 3 + 3) the tool's errors [m], after the
        hands' shares and the segment. The primitive's last input is the `clock`, if there is one.
        """
        sizes = structured(1, PLACED)
        segments = task.segments(at, off)
        if unknown is not None:
            sizes["unknown_std"] = unknown.std_m
            scatters = np.where(np.isin(task.names, at.known)[:, None, None], 0.0, unknown.scatters)
            segments["scatter"] = np.stack([scatters[:-1], scatters[1:]], axis=1)

        sizes["scale"], _ = cast(GaussianKernel, primitive.kernel).coordinates(1)
        sizes["std"] = at.std
        solution = primitive.inner.solution
        sizes["prior"] = solution.hyperparameters.prior_offset

        # compiled functions always have a clock as the last input
        inputs = solution.centres
        count = len(off)
        if clock is None or not clock.weight:
            inputs = np.column_stack([inputs, np.zeros(len(inputs))])
        else:
            sizes["clock_weight"] = clock.weight
        centres = table_of(inputs, solution.weights.reshape(-1, OUTPUTS))

        columns = ERROR_SEGMENT_DISTANCE * np.eye(count)[errors[:, 2].astype(int)]
        rows = (
            error_table(np.hstack([errors[:, :2], columns]), errors[:, 3:])
            if len(errors)
            else NO_ERRORS
        )
        return cls(segments, sizes, centres, rows, NO_PULLS)

    def pulled(self, pulls: Vector) -> Placed:
        """These segments with pulls (X, 9) that act in all of them."""
        sizes = self.sizes.copy()
        sizes["pulls"] = len(pulls)
        return replace(self, sizes=sizes, pulls=pulls)

    def pulled_in(self, segment: int, ends: Vector, via_points: Sequence[ViaPoint]) -> Placed:
        """These segments with pulls through via-points in one segment, which leave the tool as it
        is at the hands `ends` (2, 6) of the segment.
        """
        belief = np.zeros(MOST_SEGMENTS)
        belief[segment] = 1.0
        sharpness = sharpness_between(ends, via_points)
        segments = self.segments.copy()
        more = np.hstack(
            pulls_through(
                lambda hands: self.mean(hands, np.tile(belief, (len(hands), 1))),
                ends,
                via_points,
                sharpness,
            )
        )
        segments["pulled"][segment] = len(self.pulls), len(self.pulls) + len(more)
        segments["sharpness"][segment] = sharpness
        return replace(self, segments=segments, pulls=np.concatenate([self.pulls, more]))

    def belief(self, hands: Vector) -> Vector:
        """Belief (MOST_SEGMENTS,) in each segment for hands (6,) that have always been at rest."""
        out = np.zeros(MOST_SEGMENTS)
        moving = np.zeros((3, 6))
        out[: len(self.segments)] = 1.0 / len(self.segments)
        moving[0] = hands
        for _ in range(BELIEF_PERIODS):
            recognise(out, moving, 0.1, self.segments, FIRST_SEGMENT_ODDS)
        return out

    def mean(self, hands: Vector, beliefs: Vector, tempos: Vector | None = None) -> Vector:
        """Expected tool positions (T, 3) [m] for hands (T, 6), or with their rotation matrices (T,
        24), with these beliefs (T, K or more) and tempos (T, 3), as in `segments.tools_at`; without
        tempos, the hands are at rest.
        """
        out = np.empty((len(hands), 3))
        for t, (sample, belief) in enumerate(zip(hands, beliefs, strict=True)):
            tempo = RESTING_TEMPO if tempos is None else tempos[t]
            expected(belief, self._tools(sample, tempo, belief, self.pulls), out[t])
        return out

    def _tools(self, hands: Vector, tempo: Vector, belief: Vector, pulls: Vector) -> Vector:
        """Tool positions (K, 3) [m] for hands (6 or 24,) in all segments with at least
        LEAST_SEGMENT_PROBABILITY.
        """
        out = np.empty((1, len(self.segments), 3))
        now = np.array(hands[None], order="C")
        tempos = np.array(tempo[None], order="C")
        tools_at(now, tempos, belief, self.segments, self.sizes, self.centres, pulls, out)
        return np.asarray(out[0])

    def gates_m(self, hands: Vector) -> Vector:
        """Distances (T,) [m] of hands (T, 6) from the task, see `segments.off_all`."""
        return np.array([off_all(np.ascontiguousarray(sample), self.segments) for sample in hands])

    def covariance(self, hands: Vector, belief: Vector, tempo: Vector = RESTING_TEMPO) -> Vector:
        """Covariance (3, 3) [m²] of the tool, rounded, for hands (6 or 24,), a belief and a tempo
        (3,), see `segments.scatter`: errors near these hands, spread of the segments' tools, and
        the via-points' variance.
        """
        out = np.empty((3, 3))
        hands = np.ascontiguousarray(hands)
        tools = self._tools(hands, tempo, belief, NO_PULLS)
        scatter(hands, tempo, belief, self.segments, tools, self.errors, self.sizes[0], out)
        return np.asarray(np.rint(out * COVARIANCE_ROUND_TO) / COVARIANCE_ROUND_TO)


@dataclass(frozen=True, eq=False)
class SegmentedKMP:
    """Model with the inputs share of a segment that the left and the right hand have covered, the
    segment and, if there is a clock, that of the segment times its weight (2 + K or 2 + K + 1); and
    the outputs share that the tool covers, and its offset [m] (4). See `Model`.

    * `nominal`: mean via-points of the demonstrations.
    * `off` (K, 2) [m]: distances of the hands from their paths, root mean square.
    * `errors` (M, 6): inputs and the tool's errors [m] in held-out demonstrations, see `Placed`.
    * `delay_s`: delay of the demonstrated tool behind the hands.
    * `clock`: of each segment, if it is an input.
    * `unknown`: scatter of what was not shown; None: as where it was shown.

    Where the hands' orientation is unknown, a tool that turns with them only moves with them.
    """

    primitive: KMP
    task: Task
    nominal: NamedViaPoints
    off: Vector
    errors: Vector
    delay_s: float
    via_points: tuple[ViaPoint, ...] = ()
    clock: TaskClock | None = None
    unknown: Unknown | None = None

    measure: ClassVar[str] = "the distance of a hand from its paths"
    units: ClassVar[str] = TASK_UNITS
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = TASK_RANGES
    gripper_ell: ClassVar[float] = 20.0
    remembers: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        return 2 + len(self.off) + self.is_timed, OUTPUTS

    @property
    def is_timed(self) -> bool:
        """True if the clock is an input."""
        return self.clock is not None and self.clock.weight > 0.0

    @cached_property
    def clock_rows(self) -> Vector | None:
        return (
            None
            if self.clock is None
            else self.clock.rows(self._unpulled.segments["begins"].reshape(-1, 6))
        )

    @property
    def names(self) -> tuple[str, ...]:
        return self.task.names

    @property
    def turned(self) -> bool:
        return self.task.levers is not None

    @cached_property
    def hands(self) -> Vector:
        """Hands (K + 1, 6) [m] at the via-points."""
        begins, paths = (self._unpulled.segments[name].reshape(-1, 6) for name in ("begins", "way"))
        return np.concatenate([begins, begins[-1:] + paths[-1:]])

    @cached_property
    def placed(self) -> Placed:
        """Segments between the via-points in force; via-points of other names pull the tool."""
        others = [point for point in self.via_points if point.name not in self.names]
        everywhere = [point for point in others if point.segment not in self.names[:-1]]
        pulls = np.hstack(
            pulls_through(self._resting, self.hands, everywhere, PULL_SHARPNESS_PER_M2)
        )
        placed = self._unpulled.pulled(pulls)
        for k, name in enumerate(self.names[:-1]):
            if of_segment := [point for point in others if point.segment == name]:
                placed = placed.pulled_in(k, self.hands[k : k + 2], of_segment)
        return placed

    @cached_property
    def _unpulled(self) -> Placed:
        """Segments between the via-points in force, without pulls."""
        points = self.nominal.moved(self.via_points)
        return Placed.of(
            self.task, points, self.off, self.primitive, self.errors, self.clock, self.unknown
        )

    def _resting(self, hands: Vector) -> Vector:
        """Tool positions (T, 3) [m], without pulls, for hands (T, 6) always at rest."""
        return self._unpulled.mean(
            hands,
            np.array([self._unpulled.belief(sample) for sample in hands]),
            self._tempos(hands),
        )

    def belief(self, hands: Vector) -> Vector:
        return self.placed.belief(hands)

    def predict(self, seen: Seen, known: Vector | None) -> Motion:
        """Motion of the tool: equation (8) of Huang et al. 2019, differences along the hands'
        motion, and the covariance of errors in held-out demonstrations, see `segments.predicted`.
        """
        placed = self.placed
        out = np.empty((6, 3))
        errors = placed.errors if known is None else NO_ERRORS
        gate_m, ambiguity = predicted(
            seen,
            self.turned,
            placed.segments,
            placed.sizes,
            placed.centres,
            placed.pulls,
            errors,
            out,
        )
        return Motion(
            out[0], out[1], out[2], out[3:] if known is None else known, gate_m, ambiguity
        )

    def elsewhere(
        self, now: Vector, stillness: Vector, period_s: float, belief: Vector, unprimed: Vector
    ) -> float:
        placed = self.placed
        return elsewhere(
            now,
            stillness,
            period_s,
            belief,
            unprimed,
            placed.segments,
            placed.sizes,
            placed.centres,
        )

    def mean(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        return self.placed.mean(hands, self._beliefs(hands, names), self._tempos(hands, names))

    def covariances(self, hands: Vector) -> Vector:
        rows = zip(hands, self._beliefs(hands), self._tempos(hands), strict=True)
        return np.array([self.placed.covariance(*row) for row in rows]).reshape(-1, 3, 3)

    def gates_m(self, hands: Vector) -> Vector:
        return self.placed.gates_m(hands)

    def _beliefs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """Beliefs (T, MOST_SEGMENTS) for hands (T, 6) at rest. At a via-point named in `names`, the
        belief is the segment that ends there; at the first one, the segment that begins there.
        """
        out = np.array([self.placed.belief(sample) for sample in hands]).reshape(-1, MOST_SEGMENTS)
        for row, name in zip(out, names, strict=bool(names)):
            if name in self.names:
                row[:] = 0.0
                row[max(self.names.index(name) - 1, 0)] = 1.0
        return out

    def _tempos(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        """Tempos (T, 3) of hands (T, 6) at rest: when the clock ends, or for hands at the first
        via-point, when it begins.
        """
        out = np.tile(RESTING_TEMPO, (len(hands), 1))
        if self.clock is not None:
            out[:, 2] = self.clock.longest_s
            out[[row for row, name in enumerate(names) if name == self.names[0]], 2] = 0.0
        return out

    def inputs(self, hands: Vector, names: Sequence[str] = ()) -> Vector:
        rows = zip(
            hands, self._beliefs(hands, names), self._tempos(hands, names)[:, 2], strict=True
        )
        return np.array(
            [
                self._input(sample, belief, clock_s=float(clock_s))
                for sample, belief, clock_s in rows
            ]
        ).reshape(-1, self.shape[0])

    def moving_inputs(self, seen: Seen) -> tuple[Vector, Vector]:
        hands = seen.moving[0]
        velocity = seen.moving[1]
        behind, now, ahead = (
            self._input(
                hands + step * velocity,
                seen.belief,
                seen.stillness,
                seen.clock[0] + step * seen.clock[1],
            )
            for step in (-MOTION_STEP_S, 0.0, MOTION_STEP_S)
        )
        return now, (ahead - behind) / (2.0 * MOTION_STEP_S)

    def _input(
        self, hands: Vector, belief: Vector, still: Vector = STILL, clock_s: float = 0.0
    ) -> Vector:
        """Input (2 + K,) of orientation and gripper: shares of the most probable segment, and the
        belief times SEGMENT_DISTANCE_BESIDE; with a clock, also that times its weight.
        """
        most = int(belief.argmax())
        segment = self.placed.segments[most]
        hands = np.ascontiguousarray(hands)
        along = along_both(hands, still, segment)
        time = [self.clock.weight * clock_s] if self.clock is not None and self.clock.weight else []
        return np.array([*along, *(SEGMENT_DISTANCE_BESIDE * belief[: len(self.off)]), *time])

    def through(
        self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float
    ) -> SegmentedKMP:
        """Model in a scene with these via-points. Nothing is solved: those of a known name move the
        segments, the others pull the tool.
        """
        return replace(self, via_points=tuple(via_points))

    def unadapted(self) -> SegmentedKMP:
        return replace(self, via_points=())

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        out = self.task.to_arrays()
        if self.clock is not None:
            out |= {"task_clock": self.clock.numbers}
        if self.unknown is not None:
            out |= {"unknown_std": np.array(self.unknown.std_m), "scatters": self.unknown.scatters}
        return out | {
            "nominal": self.nominal.at,
            "off_ways": self.off,
            "seen": np.ascontiguousarray(self.errors[:, :3]),
            "errors": np.ascontiguousarray(self.errors[:, 3:]),
            "delay": np.array(self.delay_s),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> SegmentedKMP:
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
        distances_m = np.ascontiguousarray(arrays["off_ways"], np.float64)
        delay_s = float(arrays["delay"])
        nominal = NamedViaPoints(task.names, arrays["nominal"])
        unknown = None
        clock = TaskClock.of(arrays["task_clock"].ravel()) if "task_clock" in arrays else None
        if "unknown_std" in arrays:
            check_shapes(arrays, {"scatters": (count, 3, 3)})
            unknown = Unknown(
                float(arrays["unknown_std"]), np.ascontiguousarray(arrays["scatters"], np.float64)
            )
        return cls(
            from_arrays(arrays),
            task,
            nominal,
            distances_m,
            errors,
            delay_s,
            via_points,
            clock,
            unknown,
        )
