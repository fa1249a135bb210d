"""The positions that an arm's tool can have, by its kinematics, and the spherical shell around its
shoulder that it reaches.

For N postures, drawn evenly over the joints' limits, the position of the tool is

    p = T_1 R_1(q_1) T_2 R_2(q_2) ... T_plate p_tool.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from thirdhand.settings.urdf import UrdfJoint

Vectors = NDArray[np.float64]
POSTURES = 30_000  # with more the shell's radii change by less than 1 %
TEST_POINTS = 8_000  # points in space are tested for being reached
# a reached point is within 0.03 of the arm's extent of the tool in one of the postures
NEAR_SHARE = 0.03
RAIL_STEPS = 9  # positions of a prismatic joint below the first joint that turns
NEAR_POSTURES = 12  # this many of the nearest postures are compared for each point
MORE_NEAR_POSTURES = 64  # compared for a point that is near none of NEAR_POSTURES
# distance / extent of points out of reach; measured for reached points: at most 0.072
BEYOND_SHARE = 0.08
REACHED = 0.95  # a layer is reached if this share of the best layer's share of points is reached
LAYERS = 40  # distances from the shoulder that are tested
# min. inner radius / outer radius: nearer to its shoulder an arm is folded onto itself
FOLDED = 0.4
STRETCHED = 0.96  # max. outer radius / maximum distance: farther out an arm is singular


class Shell(NamedTuple):
    """The points between two distances from a centre [m]."""

    centre: tuple[float, float, float]
    inner: float
    outer: float


class Workspace:
    """Positions of an arm's tool (N, 3) [m], frame of the root link."""

    def __init__(
        self,
        chain: Sequence[UrdfJoint],
        lower: Sequence[float],
        upper: Sequence[float],
        plate_from_tool: Sequence[float],
    ) -> None:
        moving = [joint for joint in chain if joint.kind != "fixed"]
        ends = np.array([_turns(low, high) for low, high in zip(lower, upper, strict=True)])
        shares = _spread(POSTURES, len(moving))
        self.postures = ends[:, 0] + shares * (ends[:, 1] - ends[:, 0])

        # The rails, prismatic joints below the first one that turns, only shift what is above them.
        rails = next((i for i, joint in enumerate(moving) if joint.kind != "prismatic"), 0)
        unmoved = self.postures.copy()
        unmoved[:, :rails] = 0.0
        from_rails, self.directions, axes = _placed(chain, unmoved, plate_from_tool)
        along = np.array([axis for _, axis in axes[:rails]]).reshape(rails, 3)
        self.positions = from_rails + self.postures[:, :rails] @ along

        self._turns = moving[rails].kind != "prismatic"
        self._axis = axes[rails][1]
        self._centre = _shoulder(axes[rails:])
        self._first = ends[rails]
        self.shoulder = self._centre + ends[:rails].mean(axis=1) @ along
        self._reach = float(np.linalg.norm(from_rails - self._centre, axis=1).max())
        self.extent = float(np.linalg.norm(self.positions - self.shoulder, axis=1).max())

        # displacements by the rails, and the tree of the positions that the other joints reach
        steps = [np.linspace(low, high, RAIL_STEPS) for low, high in ends[:rails]]
        self._stops = (
            [np.array(stop) @ along for stop in itertools.product(*steps)]
            if rails
            else [np.zeros(3)]
        )
        flat, angles = self._flattened(from_rails)
        self._tree = cKDTree(flat)
        self._starts = angles - self.postures[:, rails]

    def reaches(self, points: Vectors) -> NDArray[np.bool_]:
        """A mask (M,) of the points (M, 3) that are near the tool in one of the postures."""
        return np.asarray(self._nearest(points, NEAR_POSTURES) <= NEAR_SHARE * self._reach)

    def beyond(self, points: Vectors) -> Vectors:
        """Distances (M,) [m] of points (M, 3) from the reached positions; 0 for reached points."""
        out = np.where(self.reaches(points), 0.0, math.inf)
        out[out > 0.0] = self._nearest(points[out > 0.0], MORE_NEAR_POSTURES)
        return np.where(out > BEYOND_SHARE * self.extent, out, 0.0)

    def _nearest(self, points: Vectors, neighbours: int) -> Vectors:
        """Distances (M,) [m] of points (M, 3) from the tool in the nearest posture, over all stops
        of the rails below the first joint that turns.
        """
        return np.asarray(
            np.min([self._distances(points - stop, neighbours) for stop in self._stops], axis=0)
        )

    def _distances(self, points: Vectors, neighbours: int) -> Vectors:
        """Distances (M,) [m] of points (M, 3) from the tool in the nearest posture with the rails
        at 0.

        The first joint turns the tool on a circle of radius r about its axis. A point that is d
        from the circle, and turned by an angle a beyond the joint's limits, is at
        sqrt(d² + (2 r sin(a / 2))²).
        """
        flat, angles = self._flattened(points)
        distances, indices = map(np.asarray, self._tree.query(flat, k=neighbours))
        if not self._turns:
            return np.asarray(distances.min(axis=1))
        lower, upper = self._first
        turn = (angles[:, None] - self._starts[indices] - lower) % (2 * math.pi)
        excess = np.where(
            turn <= upper - lower, 0.0, np.minimum(turn - (upper - lower), 2 * math.pi - turn)
        )
        return np.asarray(np.hypot(distances, 2.0 * flat[:, :1] * np.sin(excess / 2.0)).min(axis=1))

    def _flattened(self, points: Vectors) -> tuple[Vectors, Vectors]:
        """Distances of points (M, 3) from the first axis and heights along it (M, 2), and angles
        about it (M,). Without a joint that turns: the points themselves, and 0.
        """
        if not self._turns:
            return points, np.zeros(len(points))
        across = np.linalg.svd(self._axis[None])[2][1]  # any direction across the axis
        away = points - self._centre
        x = away @ across
        y = away @ np.cross(self._axis, across)
        return np.column_stack((np.hypot(x, y), away @ self._axis)), np.arctan2(y, x)

    def shell(self, min_x: float, min_z: float) -> Shell:
        """The widest shell around the shoulder that the arm reaches nearly whole where z >= `min_z`
        and x >= `min_x`.
        """
        points, distances = _ball(self.shoulder, self.extent, min_x, min_z)
        edges = np.linspace(0.0, self.extent, LAYERS + 1)
        layer = np.digitize(distances, edges) - 1
        reached = self.reaches(points)
        counts = np.bincount(layer, minlength=LAYERS)[:LAYERS]
        shares = np.bincount(layer, weights=reached, minlength=LAYERS)[:LAYERS] / np.maximum(
            counts, 1
        )
        first, last = _longest((shares >= REACHED * shares.max(initial=0.0)) & (counts > 0))
        outer = min(edges[last], STRETCHED * self.extent)
        inner = max(edges[first], FOLDED * outer)
        x, y, z = self.shoulder.tolist()
        return Shell(
            (round(x, 4), round(y, 4), round(z, 4)), round(float(inner), 4), round(float(outer), 4)
        )

    def share(self, shell: Shell, min_x: float, min_z: float) -> float:
        """Reached share of the part of a shell where z >= `min_z` and x >= `min_x`; 0 if that part
        is empty.
        """
        points, distances = _ball(np.array(shell.centre), shell.outer, min_x, min_z)
        points = points[distances >= shell.inner]
        return float(self.reaches(points).mean()) if len(points) else 0.0


@functools.cache
def workspace_of(
    chain: tuple[UrdfJoint, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
    plate_from_tool: tuple[float, ...],
) -> Workspace:
    """A workspace, cached by its arguments."""
    return Workspace(chain, lower, upper, plate_from_tool)


def _spread(count: int, dimensions: int) -> Vectors:
    """Points (N, D) spread evenly over a unit cube, by an additive recurrence of low discrepancy:
    (1/2 + n g^-d) mod 1 with g^(D + 1) = g + 1.
    """
    g = 2.0
    for _ in range(50):
        g = (1.0 + g) ** (1.0 / (dimensions + 1))
    return np.asarray(
        (0.5 + np.arange(1, count + 1)[:, None] * g ** -np.arange(1.0, dimensions + 1)) % 1.0
    )


def _turns(lower: float, upper: float) -> tuple[float, float]:
    """Limits of at most one turn [rad]."""
    return (lower, upper) if upper - lower <= 2 * math.pi else (-math.pi, math.pi)


def _ball(centre: Vectors, radius: float, min_x: float, min_z: float) -> tuple[Vectors, Vectors]:
    """Points (M, 3) spread evenly over the part of a ball where x >= `min_x` and z >= `min_z`, and
    their distances from its centre (M,).
    """
    points = centre + radius * (2.0 * _spread(TEST_POINTS, 3) - 1.0)
    distances = np.linalg.norm(points - centre, axis=1)
    is_inside = (distances <= radius) & (points[:, 0] >= min_x) & (points[:, 2] >= min_z)
    return points[is_inside], distances[is_inside]


def _longest(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """Begin and end of the longest run of true flags; all flags if none is true."""
    runs = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0])).reshape(-1, 2)
    begin, end = max(runs.tolist(), key=lambda run: run[1] - run[0], default=(0, len(flags)))
    return begin, end


def _placed(
    chain: Sequence[UrdfJoint], postures: Vectors, plate_from_tool: Sequence[float]
) -> tuple[Vectors, Vectors, list[tuple[Vectors, Vectors]]]:
    """The tool's positions and the directions of its +z (N, 3), and each joint's origin and axis
    with the joints before it at 0.
    """
    x, y, z, *quaternion = plate_from_tool
    toward = Rotation.from_quat(quaternion).as_matrix()[:, 2]
    positions = np.tile((x, y, z), (len(postures), 1))
    along = np.tile(toward, (len(postures), 1))
    columns = iter(postures.T[::-1, :, None])
    for joint in reversed(chain):  # from the plate to the root
        axis = np.array(joint.axis)
        if joint.kind == "prismatic":
            positions = positions + next(columns) * axis
        elif joint.kind != "fixed":  # R(q) v = v + sin q (a x v) + (1 - cos q) a x (a x v)
            cross = np.cross(axis, np.eye(3))
            q = next(columns)
            first = np.sin(q)
            second = 1.0 - np.cos(q)
            positions, along = (
                v + first * (v @ cross) + second * (v @ (cross @ cross)) for v in (positions, along)
            )
        joint_turn = Rotation.from_quat(joint.rotation).as_matrix().T
        positions = positions @ joint_turn + joint.translation
        along = along @ joint_turn

    # from the root to the plate, with all joints at 0
    rest_turn = np.eye(3)
    rest_at = np.zeros(3)
    axes = []
    for joint in chain:
        rest_at = rest_at + rest_turn @ np.array(joint.translation)
        rest_turn = rest_turn @ Rotation.from_quat(joint.rotation).as_matrix()
        if joint.kind != "fixed":
            axes.append((rest_at, rest_turn @ np.array(joint.axis)))
    return positions, along, axes


def _shoulder(axes: Sequence[tuple[Vectors, Vectors]]) -> Vectors:
    """The point of the first axis that is nearest to the second. For parallel axes, or one alone:
    the projection of the second's origin onto the first axis.
    """
    origin, along = axes[0]
    other, across = axes[min(1, len(axes) - 1)]
    between = other - origin
    cosine = float(along @ across)
    if 1.0 - cosine * cosine > 1e-6:
        between = between - across * ((between @ across) - cosine * (between @ along)) / (
            1.0 - cosine * cosine
        )
    return np.asarray(origin + along * (between @ along))
