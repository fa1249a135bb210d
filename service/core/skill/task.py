"""A task between named via-points: how they belong together, and where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.contract.requests import Name, ViaPoint
from service.core.frame import Vector
from service.core.skill.model import FARTHEST_M

MOST_CORNERS = 3  # positions of one hand that it may go between
APART_M = 0.3  # a task whose positions of a hand are all nearer to each other is so many times smaller ...
LEAST_SIZE = 0.1  # ... down to this share
MOST_NAMES = 100  # via-points of a task: more are a mistake in the file
NONE, LEFT, RIGHT = -1, 0, 1  # which hand the tool goes with at a via-point
TASK_UNITS = (
    "inputs: shares of the left hand's places, of the right hand's; outputs: the tool's shares of all named places "
    "but the first, deviation x y z [m]; frame base"
)
TASK_RANGES = {
    "corners": (0, MOST_CORNERS - 1, ""),
    "shares": (-1, MOST_CORNERS * 2 - 1, ""),
    "follow": (-1, 1, ""),
    "nominal": (-FARTHEST_M, FARTHEST_M, "m"),
    "seen": (-0.001, 1.001, ""),
    "errors": (-FARTHEST_M, FARTHEST_M, "m"),
}
"""Least, greatest and unit of the numbers in the arrays of a task's model."""

Indices = NDArray[np.int64]

# Of a task in compiled loops: where both hands' positions are, and what is of one size in all.
TASK = np.dtype(
    [
        ("corners", np.float64, (2, 3, 3)),  # [m] positions of the left and the right hand
        ("inputs", np.int64, (2, 3)),  # as `Task.inputs`
        ("size", np.float64, (2,)),  # of what is near to a position of each hand; 1 but where these lie close together
        ("scale", np.float64),  # of the kernel exp(-scale |difference|²) over inputs
        ("std", np.float64),  # [m] how sure the positions are, of each axis
        ("prior_offset", np.float64, (3,)),  # [m] the tool's offset far from all data
    ]
)

# One of the named via-points, in compiled loops.
VIA_POINT = np.dtype(
    [
        ("tool", np.float64, (3,)),  # [m]
        ("prior", np.float64),  # the tool's weight here, far from all data; 0 at the first, which has what is left
        ("corners", np.int64, (2,)),  # as a row of `Task.corners`
        ("follow", np.int64),  # as `Task.follow`
    ]
)


class Task(NamedTuple):
    """How the via-points of a task belong together, wherever they are. N named via-points.

    corners: (N, 2) at which of its own positions the left and the right hand is. inputs: (2, 3) to
    which input of the skill the weight of a hand's position is added; -1 where it has no such
    position. follow: (N,) the hand that the tool goes with there, NONE, LEFT or RIGHT.
    """

    names: tuple[str, ...]
    corners: Indices
    inputs: Indices
    follow: Indices

    @property
    def width(self) -> int:
        """The number of inputs."""
        return int(self.inputs.max()) + 1

    def parameters(self, points: NamedViaPoints) -> TaskParameters:
        """Where this task's via-points are: a position of a hand that several share is the mean of
        those that are known.
        """
        rows = [points.names.index(name) for name in self.names]
        at, known = points.at[rows], np.array([not points.known or name in points.known for name in self.names])
        hands, size = np.zeros((2, MOST_CORNERS, 3)), np.ones(2)
        for side in (0, 1):
            for corner in range(int(self.corners[:, side].max()) + 1):
                here = self.corners[:, side] == corner
                here &= known if (here & known).any() else True
                hands[side, corner] = at[here, 3 * side : 3 * side + 3].mean(axis=0)
            apart = np.linalg.norm(hands[side, : corner + 1, None] - hands[side, : corner + 1], axis=2)
            size[side] = min(max(apart.max() / APART_M, LEAST_SIZE), 1.0)
        return TaskParameters(hands, at[:, 6:].copy(), points.std, size)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """What a skill's file has of it."""
        names = np.array(msgspec.json.encode(self.names).decode())
        return {"names": names, "corners": self.corners, "shares": self.inputs, "follow": self.follow}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Task:
        """What was stored in these arrays. Raises ValueError, KeyError."""
        names = msgspec.json.decode(str(arrays["names"]), type=tuple[Name, ...])
        count, width = len(names), int(arrays["shares"].max()) + 1
        check_shapes(arrays, {"corners": (count, 2), "shares": (2, MOST_CORNERS), "follow": (count,)})
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
        return Task(names, corners, inputs, follow)


def check_shapes(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raises ValueError where an array has another shape, or nothing in it."""
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not shape[0]:
            raise ValueError(f"{name} has shape {arrays[name].shape}, {shape} needed")


class TaskParameters(NamedTuple):
    """Where the via-points are [m]: the positions of both hands (2, 3, 3), the tool's (N, 3); how
    sure that is, of each axis [m]; and how large the task is for each hand (2,), 1 or less.
    """

    hands: Vector
    tool: Vector
    std: float
    size: Vector


class NamedViaPoints(NamedTuple):
    """Via-points by their names: hands and tool (N, 9) [m] at each; how sure that is, of each axis
    [m]; and which of them are known in this scene, none: all alike.
    """

    names: tuple[str, ...]
    at: Vector
    std: float = 0.0
    known: tuple[str, ...] = ()

    @staticmethod
    def of(points: Sequence[ViaPoint]) -> NamedViaPoints:
        """Those of a list."""
        at = np.array([[*point.left, *point.right, *point.tool] for point in points]).reshape(-1, 9)
        return NamedViaPoints(
            tuple(point.name for point in points), at, max((point.std for point in points), default=0.0)
        )

    def moved(self, points: Sequence[ViaPoint]) -> NamedViaPoints:
        """These via-points, each where one of the same name is, if there is one."""
        other = NamedViaPoints.of([point for point in points if point.name in self.names])
        at = self.at.copy()
        at[[self.names.index(name) for name in other.names]] = other.at
        return NamedViaPoints(self.names, at, other.std, other.names)
