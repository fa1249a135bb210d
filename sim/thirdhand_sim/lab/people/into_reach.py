"""Recorded takes moved into the arm's reach by one rigid map for all takes of a task.

The map turns by a quarter turn about the vertical and shifts, and nothing is scaled:

    x' = R(k) (x - m) + c

with the mean m of the tool in the takes that are learned from. The quarter turns k and the centre c
are those with which the tool is best inside the reach: of all on a grid, they have the largest 2 %
quantile of the tool's depth, its distance from the nearest boundary (negative beyond it). Left-out
takes do not determine the map, but are moved by it too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from thirdhand.settings.config import Reach
from thirdhand.skills.demonstration import Demonstration
from thirdhand_sim.lab.people.left_out import LeftOut
from thirdhand_sim.lab.results import Array

SHALLOW_SHARE = 0.02  # this share of the tool's samples may be less deep
GRID_M = 0.05  # grid spacing of the candidates for the centre
PLACED_SAMPLES = 20  # samples of a take


def depth_m(points: Array, reach: Reach) -> Array:
    """The distances [m] of points (..., 3) from the nearest boundary of the reach, negative
    outside.
    """
    radius = np.linalg.norm(points - np.array(reach.centre), axis=-1)
    boundaries = (
        radius - reach.inner,
        reach.outer - radius,
        points[..., 0] - reach.min_x,
        points[..., 2] - reach.min_z,
    )
    return np.asarray(np.min(boundaries, axis=0))


class RigidMap(NamedTuple):
    """Quarter turns about the vertical, and a centre [m] for the mean [m] of the tool."""

    quarter_turns: int
    mean: tuple[float, ...]
    centre: tuple[float, ...]

    @property
    def rotation(self) -> Array:
        """The rotation matrix (3, 3)."""
        return np.rint(
            Rotation.from_euler("z", 90.0 * self.quarter_turns, degrees=True).as_matrix()
        )

    @staticmethod
    def of(shown: Sequence[LeftOut], reach: Reach) -> RigidMap:
        """The map with which the tools of these takes are deepest in the reach."""
        tool = np.concatenate(
            [take.tool[:: max(1, len(take.tool) // PLACED_SAMPLES)] for take in shown]
        )
        mean = tool.mean(axis=0)
        low = np.array(reach.centre) - reach.outer
        high = np.array(reach.centre) + reach.outer
        low = np.maximum(low, (reach.min_x, low[1], reach.min_z))
        axes = [np.arange(a, b, GRID_M) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[depth_m(grid, reach) > 0]
        best = (-np.inf, RigidMap(0, (0.0,) * 3, (0.0,) * 3))
        for turns in range(4):
            turn_map = RigidMap(turns, tuple(mean.tolist()), (0.0,) * 3)
            offsets_m = turn_map.positions(tool)
            depths = [
                float(np.quantile(depth_m(offsets_m + centre, reach), SHALLOW_SHARE))
                for centre in grid
            ]
            deepest = int(np.argmax(depths))
            candidate = turn_map._replace(centre=tuple(np.round(grid[deepest], 3).tolist()))
            best = max(best, (depths[deepest], candidate), key=lambda one: one[0])
        return best[1]

    def positions(self, points: Array) -> Array:
        """Positions (..., 3) [m], moved."""
        return np.asarray((points - np.array(self.mean)) @ self.rotation.T + np.array(self.centre))

    def moved(self, take: LeftOut) -> LeftOut:
        """A take, moved."""
        turn = Rotation.from_matrix(self.rotation)

        def pose(x: Array) -> Array:
            return np.hstack(
                [self.positions(x[:, :3]), (turn * Rotation.from_quat(x[:, 3:])).as_quat()]
            )

        d: Demonstration = take.demonstration
        via_points = tuple(
            msgspec.structs.replace(
                point,
                **{
                    part: tuple(self.positions(np.array(getattr(point, part))).tolist())
                    for part in ("left", "right", "tool")
                },
            )
            for point in d.via_points
        )
        return take._replace(
            demonstration=d._replace(
                left=pose(d.left), right=pose(d.right), tool=pose(d.tool), via_points=via_points
            ),
            hands=self.positions(take.hands.reshape(-1, 2, 3)).reshape(-1, 6),
            velocities=(take.velocities.reshape(-1, 2, 3) @ self.rotation.T).reshape(-1, 6),
            tool=self.positions(take.tool),
        )
