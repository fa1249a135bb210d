"""Where targets may be: inside the skill's box and inside the arm's reach.

Plain geometry, without a model of the arm.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from kmp.compiled import compiled
from service.config import Reach
from service.core.record import Vector

LARGEST_M = 1e3  # beyond it a target is as good as there


class Target(NamedTuple):
    """Where the tool is to go [m, m/s, m/s²], and whether that is not quite what was asked for."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    clamped: bool


def clamp(position: Vector, velocity: Vector, acceleration: Vector, *, box: Vector, reach: Reach) -> Target:
    """The target (3,) [m], [m/s], [m/s²] brought into the box (2, 3) [m] and the reach.

    Where it was outside, the parts of velocity and acceleration that lead out are removed.
    """
    if _is_inside(position, box, _numbers(reach)):
        return Target(position, velocity, acceleration, clamped=False)
    boxed = np.minimum(np.maximum(position, box[0]), box[1])
    inside = boxed == position
    velocity, acceleration = velocity * inside, acceleration * inside
    reached, outward = _nearest(np.minimum(np.maximum(boxed, -LARGEST_M), LARGEST_M), reach)
    if not outward:
        return Target(boxed, velocity, acceleration, not inside.all())
    return Target(reached, _without(velocity, outward), _without(acceleration, outward), clamped=True)


@functools.cache
def _numbers(reach: Reach) -> Vector:
    """A reach (7,) for `_is_inside`: centre, inner and outer radius, least x and z [m]."""
    return np.array([*reach.centre, reach.inner, reach.outer, reach.min_x, reach.min_z])


@compiled
def _is_inside(position: Vector, box: Vector, reach: Vector) -> bool:
    """Whether a position (3,) [m] lies inside the box (2, 3) and the reach, whose `numbers` are
    given.
    """
    square = 0.0
    for i in range(3):
        if not box[0, i] <= position[i] <= box[1, i]:
            return False
        square += (position[i] - reach[i]) ** 2
    near, far = reach[3] * reach[3], reach[4] * reach[4]
    return bool(near <= square <= far and position[0] >= reach[5] and position[2] >= reach[6])


def is_reachable(position: Vector, reach: Reach) -> bool:
    """Whether a position (3,) [m] lies inside the reach."""
    return not _nearest(position, reach)[1]


def _nearest(point: Vector, reach: Reach) -> tuple[Vector, list[Vector]]:
    """A reachable point near a point, (3,) [m], and the outward normals (3,) of the boundaries that
    it was moved to.
    """
    x, y, z = (point - reach.centre).tolist()
    inner, outer, min_x, floor = reach.inner, reach.outer, reach.min_x - reach.centre[0], reach.min_z - reach.centre[2]
    moved_x, moved_z = x < min_x, z < floor
    x, z = max(x, min_x), max(z, floor)
    distance = math.hypot(x, y, z)
    moved_out = distance > outer
    if moved_out:
        x, y, z = x * outer / distance, y * outer / distance, z * outer / distance
        if x < min_x:
            moved_x = True
            x = min_x
            shrink = math.sqrt(max(outer**2 - x**2, 0.0)) / max(math.hypot(y, z), 1e-12)
            y, z = y * min(shrink, 1.0), z * min(shrink, 1.0)
    distance = math.hypot(x, y, z)
    moved_in = distance < inner
    if moved_in:
        grow = inner / max(distance, 1e-12)
        x, y, z = x * grow, y * grow, z * grow
        if z < floor:
            moved_z = True
            z = floor
            grow = math.sqrt(max(inner**2 - z**2, 0.0)) / max(math.hypot(x, y), 1e-12)
            x, y = x * max(grow, 1.0), y * max(grow, 1.0)
    if not (moved_x or moved_z or moved_out or moved_in):
        return point, []
    radial = np.array([x, y, z]) / max(math.hypot(x, y, z), 1e-12)
    boundaries = (
        (moved_x, np.array([-1.0, 0.0, 0.0])),
        (moved_z, np.array([0.0, 0.0, -1.0])),
        (moved_out, radial),
        (moved_in, -radial),
    )
    return np.array([x, y, z]) + reach.centre, [normal for moved, normal in boundaries if moved]


def _without(vector: Vector, normals: list[Vector]) -> Vector:
    """A vector (3,) without its parts along the outward normals; where two meet, alternating until
    none is left.
    """
    for _ in range(20 if len(normals) > 1 else 1):
        for normal in normals:
            vector = vector - max(float(vector @ normal), 0.0) * normal
    return vector
