"""Distances by Coal, another implementation than the service's and the tests'."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from thirdhand.core.frame import Vector

RADIUS_M = 0.01


def capsule(segment: Vector) -> tuple[Any, Any]:
    """A capsule of `RADIUS_M` around a segment (2, 3), and its placement."""
    way = segment[1] - segment[0]
    along = way if way.any() else np.array([0.0, 0.0, 1.0])
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return coal.Capsule(RADIUS_M, float(np.linalg.norm(way))), coal.Transform3s(turn, segment.mean(axis=0))


def distance(first: tuple[Any, Any], second: tuple[Any, Any]) -> float:
    """The distance of two shapes with their placements [m]."""
    return float(coal.distance(*first, *second, coal.DistanceRequest(), coal.DistanceResult()))
