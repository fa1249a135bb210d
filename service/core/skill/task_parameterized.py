"""A skill between via-points, which holds wherever these are: a KMP from the hands' barycentric
weights of the positions that each goes between to the tool's.
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
from kmp.compiled import compiled
from kmp.kernel_row import add_weighted
from service.contract.requests import ViaPoint
from service.core.frame import Record, Records, Vector, structured
from service.core.geometry import nearest_between, round_to
from service.core.intake.hand_estimator import STILL
from service.core.skill.model import COVARIANCE_ROUND_TO, MOTION_ROUND_TO, Arrays, Motion
from service.core.skill.task import (
    TASK,
    TASK_RANGES,
    TASK_UNITS,
    VIA_POINT,
    NamedViaPoints,
    Task,
    TaskParameters,
    check_shapes,
)
from service.core.skill.via_points import NEAR, bent

SHARPNESS = 4.0  # power of the weights of a hand that rests
AT_M = 0.12  # in a task of full size, a hand that rests as near to a via-point belongs to it
AWAY_M = 0.17  # one that rests as far from all waits on its way
LEAST_WEIGHT = 1e-4  # that every via-point has, so that none is of an undefined power
STEP_S = 0.02  # of differences along the hands' motion


@compiled
def hand_weights(hands: Vector, stillness: Vector, task: Record, out: Vector) -> float:
    """The weights of both hands (6,) [m], which are so still (2,), into `out` (F,); how far the
    farther one is off its via-points [m].
    """
    corners, inputs = task["corners"], task["inputs"]
    out[:] = 0.0
    weight, farther = np.empty(3), 0.0
    for side in range(2):
        count = 0
        while count < 3 and inputs[side, count] >= 0:
            count += 1
        hand, nearest = hands[3 * side : 3 * side + 3], math.inf
        farther = max(farther, nearest_between(hand, corners[side], count, weight))
        for i in range(count):
            x, y, z = corners[side, i]
            nearest = min(nearest, (hand[0] - x) ** 2 + (hand[1] - y) ** 2 + (hand[2] - z) ** 2)
        near = min(max((AWAY_M - math.sqrt(nearest) / task["size"][side]) / (AWAY_M - AT_M), 0.0), 1.0)
        power = 1.0 + (SHARPNESS - 1.0) * near * stillness[side]
        total = 0.0
        for i in range(count):
            weight[i] = (weight[i] + LEAST_WEIGHT) ** power
            total += weight[i]
        for i in range(count):
            out[inputs[side, i]] += weight[i] / total
    return farther


@compiled
def all_hand_weights(hands: Vector, stillness: Vector, tasks: Records, out: Vector, off: Vector) -> None:
    """As `hand_weights`, for hands (T, 6): into `out` (T, F) and `off` (T,)."""
    for t in range(len(hands)):
        off[t] = hand_weights(hands[t], stillness[t], tasks[0], out[t])


@compiled
def moving_weights(hands: Vector, velocities: Vector, stillness: Vector, tasks: Records, out: Vector) -> None:
    """The weights of hands (6,) that move so (6,), and their velocity [1/s], into `out` (2, F)."""
    task, ahead = tasks[0], np.empty(out.shape[1])
    hand_weights(hands - STEP_S * velocities, stillness, task, out[1])
    hand_weights(hands + STEP_S * velocities, stillness, task, ahead)
    for i in range(len(ahead)):
        out[1, i] = (ahead[i] - out[1, i]) / (2.0 * STEP_S)
    hand_weights(hands, stillness, task, out[0])


FOLLOWED = 4  # power of the weight with which the tool goes with a hand
ALIKE = 0.25  # width, in weights, of what is near to a moment when errors are looked up
LEAST_STD_M = 0.003  # of a prediction, each axis
CALM_MPS = 0.2  # a slower hand trembles: its velocity says nothing of where the tool will be
MAX_MPS2 = 3.0  # of a target's acceleration


@dataclass(frozen=True, eq=False)
class TaskInstance:
    """R centres, F inputs, N via-points, M errors, X hands.

    rows: (R, F + N + 2) a centre and its weights each, of the tool's barycentric weights of all
    via-points but the first, then of its offset. errors: (M, F + 3) an input and by how much [m]
    the tool was off there. pulls: (X, 9) [m] hands around which the tool is moved besides, and
    weights, see `via_points.bent`.

    All arrays are copies: what came from elsewhere may be read-only, for which loops would be
    compiled once more, while they run.
    """

    tasks: Records  # (1,) of TASK
    via_points: Records  # (N,) of VIA_POINT
    rows: Vector
    errors: Vector
    pulls: Vector
    no_errors: Vector  # (0, F + 3) in place of errors, where no covariance is wanted

    @classmethod
    def of(
        cls, task: Task, parameters: TaskParameters, primitive: KMP | None = None, errors: Vector | None = None
    ) -> TaskInstance:
        """A KMP of a task's weights, and its errors; without those it knows inputs alone."""
        tasks, via_points = structured(1, TASK), structured(len(task.names), VIA_POINT)
        tasks["corners"], tasks["inputs"], tasks["std"] = parameters.hands, task.inputs, parameters.std
        tasks["size"] = parameters.size
        via_points["tool"], via_points["corners"], via_points["follow"] = parameters.tool, task.corners, task.follow
        rows, nothing = np.empty((0, task.width + len(task.names) + 2)), np.empty((0, task.width + 3))
        if primitive is not None:
            tasks["scale"] = primitive.kernel.coordinates(1)[0]
            via_points["prior"][1:], tasks["prior_offset"] = primitive.prior_offset[:-3], primitive.prior_offset[-3:]
            rows = np.hstack([primitive.centres, primitive.weights.reshape(-1, primitive.outputs)])
        known = nothing if errors is None else np.array(errors, order="C")
        return cls(tasks, via_points, rows, known, np.empty((0, 9)), nothing)

    def pulled(self, hands: Vector, weights: Vector) -> TaskInstance:
        """The same, that is moved around some hands (X, 6), by weights (X, 3)."""
        return replace(self, pulls=np.hstack([hands, weights]))

    def inputs(self, hands: Vector, stillness: Vector | None = None) -> tuple[Vector, Vector]:
        """Inputs (T, F) of hands (T, 6) that are so still (T, 2), or wholly, and by how much the
        farther one is off its via-points (T,) [m].
        """
        out, off = np.empty((len(hands), self.no_errors.shape[1] - 3)), np.empty(len(hands))
        all_hand_weights(np.ascontiguousarray(hands), _or_wholly(stillness, hands), self.tasks, out, off)
        return out, off

    def moving_inputs(self, moving: Vector, stillness: Vector) -> tuple[Vector, Vector]:
        """The input (F,) of hands that move so (3, 6), and its velocity (F,) [1/s], by differences
        along their motion.
        """
        out = np.empty((2, self.no_errors.shape[1] - 3))
        moving_weights(moving[0], moving[1], stillness, self.tasks, out)
        return out[0], out[1]

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) that are so still (T, 2), or wholly."""
        out = np.empty((len(hands), 3))
        known = self.tasks, self.via_points, self.rows, self.pulls
        _tools(np.ascontiguousarray(hands), _or_wholly(stillness, hands), *known, out)
        return out

    def covariances(self, inputs: Vector) -> Vector:
        """(T, 3, 3) [m²] at inputs (T, F): the scatter of errors near there, and that of the
        via-points.
        """
        out = np.empty((len(inputs), 3, 3))
        _scatters(np.ascontiguousarray(inputs), self.errors, self.tasks, out)
        return out

    def motion(self, moving: Vector, stillness: Vector, known: Vector | None) -> Motion:
        """The tool for hands that move (3, 6) and are still (2,) so, by differences along their
        motion. One that only trembles moves nothing.
        """
        out = np.empty((6, 3))
        errors = self.errors if known is None else self.no_errors
        gate_m = _motion(moving, stillness, self.tasks, self.via_points, self.rows, self.pulls, errors, out)
        return Motion(out[0], out[1], out[2], out[3:] if known is None else known, gate_m)

    def followed(self, hands: Vector, weights: Vector) -> Vector:
        """By how much the tool goes with the hands (T, 6), (T, 3) [m], where it has these weights
        (T, N).
        """
        out = np.zeros((len(hands), 3))
        for hand, weight, row in zip(np.ascontiguousarray(hands), weights, out, strict=True):
            _add_followed(hand, weight, self.tasks[0], self.via_points, row)
        return out


def _or_wholly(stillness: Vector | None, hands: Vector) -> Vector:
    return np.tile(STILL, (len(hands), 1)) if stillness is None else np.ascontiguousarray(stillness)


@compiled
def _add_followed(hands: Vector, weights: Vector, task: Record, via_points: Records, out: Vector) -> None:
    """Adds to `out` (3,) by how much the tool goes with the hands, for its weights (N,)."""
    for n in range(len(via_points)):
        side = via_points[n]["follow"]
        if side >= 0:
            share, corner = min(max(weights[n], 0.0), 1.0) ** FOLLOWED, via_points[n]["corners"][side]
            for i in range(3):
                out[i] += share * (hands[3 * side + i] - task["corners"][side, corner, i])


@compiled
def _tool(
    hands: Vector, query: Vector, task: Record, via_points: Records, rows: Vector, pulls: Vector, out: Vector
) -> None:
    """The tool into `out` (3,): equation (8) of Huang et al. 2019 of the hands' weights (F,), and
    back.
    """
    count = len(via_points)
    weights, found = np.empty(count), np.empty(count + 2)
    for n in range(1, count):
        found[n - 1] = via_points[n]["prior"]
    found[count - 1 :] = task["prior_offset"]
    add_weighted(query, rows, task["scale"], found)
    weights[0] = 1.0
    for n in range(1, count):
        weights[n] = found[n - 1]
        weights[0] -= found[n - 1]
    for i in range(3):
        out[i] = found[count - 1 + i]
        for n in range(count):
            out[i] += weights[n] * via_points[n]["tool"][i]
    _add_followed(hands, weights, task, via_points, out)
    add_weighted(hands, pulls, NEAR, out)


@compiled
def _tools(
    hands: Vector, stillness: Vector, tasks: Records, via_points: Records, rows: Vector, pulls: Vector, out: Vector
) -> None:
    """The tools into `out` (T, 3) of hands (T, 6) that are so still (T, 2)."""
    task, query = tasks[0], np.empty(rows.shape[1] - len(via_points) - 2)
    for t in range(len(hands)):
        hand_weights(hands[t], stillness[t], task, query)
        _tool(hands[t], query, task, via_points, rows, pulls, out[t])


@compiled
def _motion(
    moving: Vector,
    stillness: Vector,
    tasks: Records,
    via_points: Records,
    rows: Vector,
    pulls: Vector,
    errors: Vector,
    out: Vector,
) -> float:
    """Tool, velocity, acceleration and covariance, rounded, into `out` (6, 3); how far the farther
    hand is off its via-points [m]. Without errors the covariance is left out.
    """
    task, query, tools, off = tasks[0], np.empty(errors.shape[1] - 3), np.empty((3, 3)), 0.0
    hands = np.empty((3, 6))  # a step behind, now, a step ahead
    for side in range(2):
        square = 0.0
        for i in range(3 * side, 3 * side + 3):
            square += moving[1, i] * moving[1, i]
        goes = 1.0 - math.exp(-((math.sqrt(square) / CALM_MPS) ** 4))
        for i in range(3 * side, 3 * side + 3):
            step, bend = STEP_S * goes * moving[1, i], 0.5 * STEP_S**2 * goes * moving[2, i]
            hands[0, i], hands[1, i], hands[2, i] = moving[0, i] - step + bend, moving[0, i], moving[0, i] + step + bend
    for k in (0, 2, 1):
        off = hand_weights(hands[k], stillness, task, query)
        _tool(hands[k], query, task, via_points, rows, pulls, tools[k])
    for i in range(3):
        bent = (tools[2, i] - 2.0 * tools[1, i] + tools[0, i]) / STEP_S**2
        out[0, i] = tools[1, i]
        out[1, i] = (tools[2, i] - tools[0, i]) / (2.0 * STEP_S)
        out[2, i] = min(max(bent, -MAX_MPS2), MAX_MPS2)
    round_to(out[:3], MOTION_ROUND_TO)
    if len(errors):
        _scatter(query, errors, task["std"], out[3:])
        round_to(out[3:], COVARIANCE_ROUND_TO)
    return float(np.rint(off * MOTION_ROUND_TO) / MOTION_ROUND_TO)


@compiled
def _scatters(inputs: Vector, errors: Vector, tasks: Records, out: Vector) -> None:
    """As `_scatter`, for inputs (T, F)."""
    for t in range(len(inputs)):
        _scatter(inputs[t], errors, tasks[0]["std"], out[t])


@compiled
def _scatter(query: Vector, errors: Vector, std: float, out: Vector) -> None:
    """The mean square (3, 3) of errors, weighted by how near their inputs are to one (F,)."""
    inputs = len(query)
    squares, least = np.empty(len(errors)), math.inf
    for m in range(len(errors)):
        squares[m] = 0.0
        for i in range(inputs):
            squares[m] += (query[i] - errors[m, i]) ** 2
        least = min(least, squares[m])
    out[:] = 0.0
    total = 0.0
    for m in range(len(errors)):
        weight = math.exp(-0.5 * (squares[m] - least) / ALIKE**2)
        total += weight
        for i in range(3):
            for j in range(3):
                out[i, j] += weight * errors[m, inputs + i] * errors[m, inputs + j]
    for i in range(3):
        for j in range(3):
            out[i, j] /= total
        out[i, i] += std**2 + LEAST_STD_M**2


@dataclass(frozen=True, eq=False)
class TaskParameterized:
    """A model whose inputs are the weights of a task's positions (F), whose outputs are those of
    the tool's named via-points but the first, and an offset [m] (N + 2). See `Model`.

    nominal: where the via-points were in the mean of the demonstrations. errors: (M, F + 3) by how
    much [m] the tool was off at some inputs when demonstrations were left out.
    """

    primitive: KMP
    task: Task
    nominal: NamedViaPoints
    errors: Vector
    via_points: tuple[ViaPoint, ...] = ()

    measure: ClassVar[str] = "a hand's distance from its via-points"
    formats: ClassVar[tuple[int, ...]] = (3,)
    units: ClassVar[str] = TASK_UNITS
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = TASK_RANGES
    gripper_ell: ClassVar[float] = 60.0

    @property
    def shape(self) -> tuple[int, int]:
        return self.task.width, len(self.task.names) + 2

    @cached_property
    def hands(self) -> Vector:
        """Hands at every pair of their positions."""
        counts, at = (self.task.inputs >= 0).sum(axis=1), self._unpulled.tasks["corners"][0]
        return np.array([[*one, *other] for one in at[0, : counts[0]] for other in at[1, : counts[1]]])

    @property
    def names(self) -> tuple[str, ...]:
        return self.task.names

    @cached_property
    def instance(self) -> TaskInstance:
        """The task among the via-points in force; those of other names pull."""
        others = [point for point in self.via_points if point.name not in self.names]
        return self._unpulled.pulled(*bent(self._unpulled.mean, self.hands, others))

    @cached_property
    def _unpulled(self) -> TaskInstance:
        parameters = self.task.parameters(self.nominal.moved(self.via_points))
        return TaskInstance.of(self.task, parameters, self.primitive, self.errors)

    def predict(self, moving: Vector, stillness: Vector, known: Vector | None, past: Vector) -> Motion:
        """Equation (8) of Huang et al. 2019, differences along the motion, scatter of errors."""
        return self.instance.motion(moving, stillness, known)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.instance.mean(hands, stillness)

    def covariances(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.instance.covariances(self.instance.inputs(hands, stillness)[0])

    def gates_m(self, hands: Vector) -> Vector:
        return self.instance.inputs(hands)[1]

    def inputs(self, hands: Vector) -> Vector:
        return self.instance.inputs(hands)[0]

    def moving_inputs(self, moving: Vector, stillness: Vector, past: Vector) -> tuple[Vector, Vector]:
        return self.instance.moving_inputs(moving, stillness)

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> TaskParameterized:
        """Nothing is solved: via-points of a known name are where the task is, others pull."""
        return replace(self, via_points=tuple(via_points))

    def unadapted(self) -> TaskParameterized:
        return replace(self, via_points=())

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        width = self.task.width
        return self.task.to_arrays() | {
            "nominal": self.nominal.at,
            "seen": np.ascontiguousarray(self.errors[:, :width]),
            "errors": np.ascontiguousarray(self.errors[:, width:]),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> TaskParameterized:
        task = Task.from_arrays(arrays)
        shapes = {
            "nominal": (len(task.names), 9),
            "seen": (len(arrays["errors"]), task.width),
            "errors": (len(arrays["seen"]), 3),
        }
        check_shapes(arrays, shapes)
        errors = np.hstack([arrays["seen"], arrays["errors"]])
        return cls(KMP.from_arrays(arrays), task, NamedViaPoints(task.names, arrays["nominal"]), errors, via_points)
