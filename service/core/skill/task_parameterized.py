"""A skill between via-points, which holds wherever these are: a KMP from the hands' barycentric
weights of the positions that each goes between to the tool's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from service.contract.records import Layout
from service.contract.requests import Name, ViaPoint
from service.core.record import Record, Vector
from service.core.skill.model import FARTHEST_M, Arrays, Motion
from service.core.skill.task import MOST_CORNERS, NamedViaPoints, Task
from service.core.skill.task_instance import TaskInstance
from service.core.skill.via_points import bent

MOST_NAMES = 100


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
    units: ClassVar[str] = (
        "inputs: shares of the left hand's places, of the right hand's; outputs: the tool's shares of all named places "
        "but the first, deviation x y z [m]; frame base"
    )
    ranges: ClassVar[Mapping[str, tuple[float, float, str]]] = {
        "corners": (0, MOST_CORNERS - 1, ""),
        "shares": (-1, MOST_CORNERS * 2 - 1, ""),
        "follow": (-1, 1, ""),
        "nominal": (-FARTHEST_M, FARTHEST_M, "m"),
        "seen": (-0.001, 1.001, ""),
        "errors": (-FARTHEST_M, FARTHEST_M, "m"),
    }
    state_fields: ClassVar[Layout] = ()
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

    def predict(self, moving: Vector, stillness: Vector, known: Vector | None, memory: Record | None) -> Motion:
        """Equation (8) of Huang et al. 2019, its differences along the motion, and the scatter of
        errors.
        """
        return self.instance.motion(moving, stillness, known)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.instance.mean(hands, stillness)

    def covariances(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        return self.instance.covariances(self.instance.inputs(hands, stillness)[0])

    def gates_m(self, hands: Vector) -> Vector:
        return self.instance.inputs(hands)[1]

    def inputs(self, hands: Vector) -> Vector:
        return self.instance.inputs(hands)[0]

    def moving_inputs(self, moving: Vector, stillness: Vector) -> tuple[Vector, Vector]:
        return self.instance.moving_inputs(moving, stillness)

    def through(self, via_points: Sequence[ViaPoint], *, tolerance: float, weight: float) -> TaskParameterized:
        """Nothing is solved: via-points of a known name are where the task is, others pull."""
        return replace(self, via_points=tuple(via_points))

    def unadapted(self) -> TaskParameterized:
        return replace(self, via_points=())

    def own_arrays(self) -> dict[str, NDArray[Any]]:
        width = self.task.width
        return {
            "names": np.array(msgspec.json.encode(self.task.names).decode()),
            "corners": self.task.corners,
            "shares": self.task.inputs,
            "follow": self.task.follow,
            "nominal": self.nominal.at,
            "seen": np.ascontiguousarray(self.errors[:, :width]),
            "errors": np.ascontiguousarray(self.errors[:, width:]),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, via_points: tuple[ViaPoint, ...]) -> TaskParameterized:
        primitive = KMP.from_arrays(arrays)
        names = msgspec.json.decode(str(arrays["names"]), type=tuple[Name, ...])
        count, width = len(names), int(arrays["shares"].max()) + 1
        shapes = {
            "corners": (count, 2),
            "shares": (2, MOST_CORNERS),
            "follow": (count,),
            "nominal": (count, 9),
            "seen": (len(arrays["errors"]), width),
            "errors": (len(arrays["seen"]), 3),
        }
        for name, shape in shapes.items():
            if arrays[name].shape != shape or not shape[0]:
                raise ValueError(f"{name} has shape {arrays[name].shape}, {shape} needed")
        if not 2 <= count <= MOST_NAMES or len(set(names)) < count:
            raise ValueError(f"via-points {', '.join(names)}: 2 to {MOST_NAMES} different names needed")
        corners, inputs, follow = (
            np.ascontiguousarray(arrays[name], np.int64) for name in ("corners", "shares", "follow")
        )
        for side in (0, 1):
            has = int((inputs[side] >= 0).sum())
            numbered = np.array_equal(np.unique(corners[:, side]), np.arange(has))
            if not has or (inputs[side, :has] < 0).any() or not numbered:
                raise ValueError(
                    f"the hands' positions {corners.tolist()} and inputs {inputs.tolist()} do not fit each other"
                )
        if not np.array_equal(np.unique(inputs[inputs >= 0]), np.arange(width)):
            raise ValueError(f"the inputs {inputs.tolist()} are not numbered through")
        task, nominal = Task(names, corners, inputs, follow), NamedViaPoints(names, arrays["nominal"])
        return cls(primitive, task, nominal, np.hstack([arrays["seen"], arrays["errors"]]), via_points)
