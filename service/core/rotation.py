"""Quaternions x y z w as rotation matrices."""

from __future__ import annotations

import math

import numpy as np

from service.core.frame import Vector


def rotation(quaternion: tuple[float, float, float, float]) -> Vector:
    """The rotation matrix (3, 3) of a quaternion x y z w, normalised first."""
    x, y, z, w = (v / math.hypot(*quaternion) for v in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
