"""A task: the order of its named via-points, and their positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.requests import Name, ViaPoint
from thirdhand.core.frame import Records, Vector, structured
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M
from thirdhand.core.skill.segments import MOST_SEGMENTS, NONE, RIGHT, SEGMENT, STAYS
from thirdhand.core.skill.tuning import LEAST_PATH_M

MOST_NAMES = MOST_SEGMENTS + 1  # largest number of via-points of a task
TASK_UNITS = (
    "inputs: how far along the left and the right hand are, the segment; outputs: how far along "
    "the tool is, its deviation x y z [m]; frame base"
)
TASK_RANGES = {
    "corners": (0, MOST_NAMES, ""),
    "follow": (NONE, RIGHT, ""),
    "leads": (NONE, RIGHT, ""),
    "nominal": (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
    "off_ways": (1e-3, MAX_SKILL_DISTANCE_M, "m"),
    "seen": (-0.001, MOST_SEGMENTS, ""),
    "errors": (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
    "delay": (0.0, 1.0, "s"),
    "levers": (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
    "unknown_std": (0.0, MAX_SKILL_DISTANCE_M, "m"),
    "scatters": (-(MAX_SKILL_DISTANCE_M**2), MAX_SKILL_DISTANCE_M**2, "m²"),
}
"""Minimum, maximum and unit of the numbers in the arrays of a task's model."""
Indices = NDArray[np.int64]


class Task(NamedTuple):
    """Order of the N via-points of a task, between which there are N - 1 segments.

    * `corners` (N, 2): index of the position of the left and the right hand at each via-point. A
      hand that returns to a position has the same index.
    * `follow` (N,): the hand that the tool follows at each via-point: NONE, LEFT or RIGHT.
    * `levers` (N, 3) [m]: the tool there in the frame of that hand, with which it turns; None if
      the tool moves with the hand but does not turn with it.
    * `leads`: the hand whose share alone counts in all segments in which it moves: LEFT, RIGHT, or
      NONE if both count.
    """

    names: tuple[str, ...]
    corners: Indices
    follow: Indices
    levers: Vector | None = None
    leads: int = NONE

    def segments(self, points: NamedViaPoints, off: Vector) -> Records:
        """Segments (N - 1,) of SEGMENT between these via-points. `off` (N - 1, 2) [m] is its field.

        A position that a hand shares between via-points is the mean over those that are known in
        the scene, or over all if none is. A hand whose via-points are nearer than LEAST_PATH_M
        rests.
        """
        rows = [points.names.index(name) for name in self.names]
        positions = points.at[rows]
        is_known = np.array([not points.known or name in points.known for name in self.names])
        hands = np.empty((len(rows), 2, 3))
        for side in (0, 1):
            for corner in range(int(self.corners[:, side].max()) + 1):
                at_corner = self.corners[:, side] == corner
                averaged = at_corner & is_known if (at_corner & is_known).any() else at_corner
                hands[at_corner, side] = positions[averaged, 3 * side : 3 * side + 3].mean(axis=0)

        out = structured(len(rows) - 1, SEGMENT)
        out["begins"] = hands[:-1]
        out["way"] = np.diff(hands, axis=0)
        square = (out["way"] ** 2).sum(axis=2)
        out["square"] = np.where(square > LEAST_PATH_M**2, square, STAYS)
        out["way"] *= (out["square"] > STAYS)[:, :, None]
        out["off"] = off
        out["tool"] = positions[:-1, 6:]
        out["tool_way"] = np.diff(positions[:, 6:], axis=0)
        out["leads"] = (
            NONE
            if self.leads == NONE
            else np.where(out["square"][:, self.leads] > STAYS, self.leads, NONE)
        )
        out["follow"] = np.stack([self.follow[:-1], self.follow[1:]], axis=1)
        if self.levers is not None:
            out["turned"] = 1
            out["levers"] = np.stack([self.levers[:-1], self.levers[1:]], axis=1)
        return out

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of the task in a skill's file."""
        names = np.array(msgspec.json.encode(self.names).decode())
        levers = {} if self.levers is None else {"levers": self.levers}
        leads = {} if self.leads == NONE else {"leads": np.array(self.leads)}
        return {"names": names, "corners": self.corners, "follow": self.follow, **levers, **leads}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Task:
        """Task stored in the arrays of a skill's file. Raises ValueError, KeyError."""
        names = msgspec.json.decode(str(arrays["names"]), type=tuple[Name, ...])
        count = len(names)
        check_shapes(arrays, {"corners": (count, 2), "follow": (count,)})
        if not 2 <= count <= MOST_NAMES or len(set(names)) < count:
            raise ValueError(
                f"via-points {', '.join(names)}: 2 to {MOST_NAMES} different names needed"
            )
        corners, follow = (
            np.ascontiguousarray(arrays[name], np.int64) for name in ("corners", "follow")
        )
        for side in (0, 1):
            if not np.array_equal(
                np.unique(corners[:, side]), np.arange(corners[:, side].max() + 1)
            ):
                raise ValueError(
                    f"the hands' positions {corners.tolist()} are not numbered through"
                )
        levers = None
        leads = int(arrays["leads"]) if "leads" in arrays else NONE
        if "levers" in arrays:
            check_shapes(arrays, {"levers": (count, 3)})
            levers = np.ascontiguousarray(arrays["levers"], np.float64)
        return Task(names, corners, follow, levers, leads)


def check_shapes(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError if an array is empty or has another shape."""
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not shape[0]:
            raise ValueError(f"{name} has shape {arrays[name].shape}, {shape} needed")


class NamedViaPoints(NamedTuple):
    """Via-points by name: hands and tool `at` (N, 9) [m], standard deviation `std` [m] on each
    axis, and the names `known` in this scene; an empty `known` makes no difference between them.
    """

    names: tuple[str, ...]
    at: Vector
    std: float = 0.0
    known: tuple[str, ...] = ()

    @staticmethod
    def of(points: Sequence[ViaPoint]) -> NamedViaPoints:
        """Via-points of a list, with the largest of their standard deviations."""
        positions = np.array(
            [[*point.left, *point.right, *point.tool] for point in points]
        ).reshape(-1, 9)
        return NamedViaPoints(
            tuple(point.name for point in points),
            positions,
            max((point.std for point in points), default=0.0),
        )

    def moved(self, points: Sequence[ViaPoint]) -> NamedViaPoints:
        """These via-points, each replaced by the given one of the same name, if there is one."""
        other = NamedViaPoints.of([point for point in points if point.name in self.names])
        positions = self.at.copy()
        positions[[self.names.index(name) for name in other.names]] = other.at
        return NamedViaPoints(self.names, positions, other.std, other.names)
