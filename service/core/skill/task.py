"""A task between named via-points: how they belong together, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract.requests import ViaPoint
from service.core.record import Vector

MOST_CORNERS = 3  # positions of one hand that it may go between
NONE, LEFT, RIGHT = -1, 0, 1  # which hand the tool goes with at a via-point

Indices = NDArray[np.int64]


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
        hands = np.zeros((2, MOST_CORNERS, 3))
        for side in (0, 1):
            for corner in range(int(self.corners[:, side].max()) + 1):
                here = self.corners[:, side] == corner
                here &= known if (here & known).any() else True
                hands[side, corner] = at[here, 3 * side : 3 * side + 3].mean(axis=0)
        return TaskParameters(hands, at[:, 6:].copy(), points.std)


class TaskParameters(NamedTuple):
    """Where the via-points are [m]: the positions of both hands (2, 3, 3), the tool's (N, 3); and
    how sure that is, of each axis [m].
    """

    hands: Vector
    tool: Vector
    std: float


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
