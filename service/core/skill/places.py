"""Named places of a task: how they belong together, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract.requests import ViaPoint
from service.core.record import Vector

MOST_CORNERS = 3  # places that a hand may go between
NONE, LEFT, RIGHT = -1, 0, 1  # which hand the tool goes with at a place

Indices = NDArray[np.int64]


class Task(NamedTuple):
    """How the places of a task belong together, wherever they are. N named places.

    corners: (N, 2) which of its own places the left and the right hand is at. inputs: (2, 3) which
    input of the skill the share of a hand's place adds to; -1 where it has no such place. follow:
    (N,) the hand that the tool goes with there, NONE, LEFT or RIGHT.
    """

    names: tuple[str, ...]
    corners: Indices
    inputs: Indices
    follow: Indices

    @property
    def width(self) -> int:
        """The number of inputs."""
        return int(self.inputs.max()) + 1

    def layout(self, places: Places) -> Layout:
        """Where this task's places are: those of a hand that are one at the mean of the known."""
        rows = [places.names.index(name) for name in self.names]
        at, told = places.at[rows], np.array([not places.known or name in places.known for name in self.names])
        hands = np.zeros((2, MOST_CORNERS, 3))
        for side in (0, 1):
            for corner in range(int(self.corners[:, side].max()) + 1):
                here = self.corners[:, side] == corner
                here &= told if (here & told).any() else True
                hands[side, corner] = at[here, 3 * side : 3 * side + 3].mean(axis=0)
        return Layout(hands, at[:, 6:].copy(), places.std)


class Layout(NamedTuple):
    """Where the places are [m]: those of both hands (2, 3, 3), the tool's (N, 3); and how sure that
    is, of each axis [m].
    """

    hands: Vector
    tool: Vector
    std: float


class Places(NamedTuple):
    """Named places: hands and tool (N, 9) [m] at each; how sure that is, of each axis [m]; and
    which were told in this scene, none: all alike.
    """

    names: tuple[str, ...]
    at: Vector
    std: float = 0.0
    known: tuple[str, ...] = ()

    @staticmethod
    def of(points: Sequence[ViaPoint]) -> Places:
        """Those of via-points."""
        at = np.array([[*point.left, *point.right, *point.tool] for point in points]).reshape(-1, 9)
        return Places(tuple(point.name for point in points), at, max((point.std for point in points), default=0.0))

    def told(self, points: Sequence[ViaPoint]) -> Places:
        """These places, those at the via-points that have the name of one."""
        other = Places.of([point for point in points if point.name in self.names])
        at = self.at.copy()
        at[[self.names.index(name) for name in other.names]] = other.at
        return Places(self.names, at, other.std, other.names)
