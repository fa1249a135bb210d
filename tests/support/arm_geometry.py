"""Kinematics and distances of an arm, independent of the service's code and for many postures at
once: T postures, J joints, N capsules.

The chain comes from the URDF. Capsules, the pairs of them that are kept apart, and boxes come from
the settings; `tests/core/test_separation.py` checks that the capsules cover the links.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from thirdhand.core.frame import Vector
from thirdhand.core.separation import TABLE_DEPTH_M
from thirdhand.core.separation.body import body_of
from thirdhand.settings.config import Settings
from thirdhand.settings.urdf import Urdf

STEP_S = 1e-5  # step of difference quotients
SEARCH_STEPS = 30  # each step of a golden-section search narrows the interval to 0.62
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


class ArmGeometry:
    """The arm of one cell.

    `links` (N,): number of joints that move each capsule; `radii` (N,) [m]; `pairs` (P, 2) of
    capsules that are kept apart; `boxes` (B, 2, 3) [m]: lower and upper corners, the table first;
    `forearm` (3,) [m]: vector from a tracked hand toward its elbow.
    """

    def __init__(self, settings: Settings, urdf: str) -> None:
        body = body_of(settings, urdf)
        self.links = np.array(body.capsules["link"])
        self.radii = np.array(body.capsules["radius"])
        self.pairs = body.pairs
        self.joints = len(settings.joints.names)
        self._ends = np.array(body.capsules["ends"])
        self._names = settings.joints.names
        self._chain = Urdf(urdf).chain(settings.arm.plate)
        self._tool = np.array(settings.tool.plate_from_tool[:3])
        centre = np.array(settings.table.centre)
        half = np.array([*settings.table.half_size, 0.0])
        boxes = [(centre - half - (0.0, 0.0, TABLE_DEPTH_M), centre + half)]
        boxes += [
            (np.subtract(b.centre, b.half_size), np.add(b.centre, b.half_size))
            for b in settings.obstacles.boxes
        ]
        self.boxes = np.array(boxes)
        toward = np.array(settings.people.toward_elbow)
        self.forearm = settings.people.length * toward / np.linalg.norm(toward)

    def place(self, postures: Vector) -> tuple[Vector, Vector]:
        """Ends of the capsules (T, N, 2, 3) and positions of the tool (T, 3) [m] at postures
        (T, J) [rad].
        """
        turned = np.tile(np.eye(3), (len(postures), 1, 1))
        origins = np.zeros((len(postures), 3))
        capsules = np.empty((len(postures), len(self.links), 2, 3))
        capsules[:, self.links == 0] = self._ends[self.links == 0]
        for joint in self._chain:
            origins = origins + turned @ np.array(joint.translation)
            turned = turned @ Rotation.from_quat(joint.rotation).as_matrix()
            if joint.name in self._names:
                number = self._names.index(joint.name)
                turned = (
                    turned
                    @ Rotation.from_rotvec(np.outer(postures[:, number], joint.axis)).as_matrix()
                )
                for k in np.flatnonzero(self.links == number + 1):
                    capsules[:, k] = origins[:, None] + self._ends[k] @ turned.transpose(0, 2, 1)
        return capsules, origins + turned @ self._tool

    def tool_speeds(self, postures: Vector, velocities: Vector) -> Vector:
        """Speeds (T,) [m/s] of the tool at postures (T, J) and joint velocities (T, J) [rad/s]."""
        before, after = (self.place(postures + step * velocities)[1] for step in (-STEP_S, STEP_S))
        return np.linalg.norm(after - before, axis=1) / (2.0 * STEP_S)


def between_points_and_segments(points: Vector, segments: Vector) -> Vector:
    """Distances (T,) of points (T, 3) and segments (T, 2, 3)."""
    along = segments[:, 1] - segments[:, 0]
    offset = points - segments[:, 0]
    share = np.einsum("ti,ti->t", offset, along) / np.maximum(
        np.einsum("ti,ti->t", along, along), 1e-300
    )
    return np.linalg.norm(offset - np.clip(share, 0.0, 1.0)[:, None] * along, axis=1)


def between_segments(first: Vector, second: Vector) -> Vector:
    """Distances (T,) of segments (T, 2, 3): from an end to the other segment, or between inner
    points.
    """
    ends = [between_points_and_segments(first[:, k], second) for k in (0, 1)]
    ends += [between_points_and_segments(second[:, k], first) for k in (0, 1)]
    u = first[:, 1] - first[:, 0]
    v = second[:, 1] - second[:, 0]
    w = first[:, 0] - second[:, 0]
    uu, uv, vv, uw, vw = (
        np.einsum("ti,ti->t", a, b) for a, b in ((u, u), (u, v), (v, v), (u, w), (v, w))
    )
    determinant = uu * vv - uv * uv
    crosses = determinant > 1e-12 * uu * vv
    divisor = np.where(crosses, determinant, 1.0)
    s = (uv * vw - vv * uw) / divisor
    t = (uu * vw - uv * uw) / divisor
    inside = crosses & (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    between = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    return np.minimum(np.min(ends, axis=0), np.where(inside, between, np.inf))


def points_to_box(points: Vector, box: Vector) -> Vector:
    """Distances (T,) of points (T, 3) from a box (2, 3) of two corners; negative inside."""
    outside = np.linalg.norm(points - np.clip(points, *box), axis=1)
    return np.where(
        outside > 0.0, outside, -np.minimum(points - box[0], box[1] - points).min(axis=1)
    )


def segments_to_box(segments: Vector, box: Vector) -> Vector:
    """Least distances (T,) along segments (T, 2, 3) from a box (2, 3).

    The signed distance from a convex body is convex along a line, so a golden-section search finds
    its minimum.
    """
    begin = segments[:, 0]
    along = segments[:, 1] - segments[:, 0]
    low = np.zeros(len(segments))
    high = np.ones(len(segments))
    for _ in range(SEARCH_STEPS):
        first = high - GOLDEN * (high - low)
        second = low + GOLDEN * (high - low)
        nearer = points_to_box(begin + first[:, None] * along, box) < points_to_box(
            begin + second[:, None] * along, box
        )
        low = np.where(nearer, low, first)
        high = np.where(nearer, second, high)
    return points_to_box(begin + (0.5 * (low + high))[:, None] * along, box)


def at_least(segments: Vector, centres: Vector, reach: Vector | float) -> Vector:
    """Lower bounds (T,) of the distances of segments (T, 2, 3) from anything within `reach` [m] of
    the centres (T, 3).
    """
    half = 0.5 * np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    return np.linalg.norm(segments.mean(axis=1) - centres, axis=1) - half - reach
