"""Quaternions x y z w: as rotation matrices and from them, the turn from one to another and its
angle, and one that was turned on.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.record import Vector

ROUND_TO = 1e9  # of quaternions: machines that differ in the last bits agree
_TINY = 1e-12


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


def angles(a: Vector, b: Vector) -> Vector:
    """Angles (...) [rad] of the turns between quaternions (..., 4) of norm 1."""
    return np.asarray(2.0 * np.arccos(np.clip(np.abs((a * b).sum(axis=-1)), 0.0, 1.0)))


def off_target(tool: Vector, target: Vector, *, direction: bool) -> Vector:
    """By how much tools (..., 4) are turned from their targets [rad]; only of where +z points, if
    that `direction` alone is followed.
    """
    if not direction:
        return angles(tool, target)
    cosines = (_axes(tool) * _axes(target)).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))


def _axes(quaternions: Vector) -> Vector:
    """Where quaternions (..., 4) of norm 1 turn +z, (..., 3)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)


@compiled
def quaternion_of(matrix: Vector, out: Vector) -> None:
    """Into out (4,) the quaternion of a rotation matrix (3, 3), rounded; by its largest component
    (Shepperd 1978).
    """
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    largest, most = 3, trace
    for i in range(3):
        if matrix[i, i] > most:
            largest, most = i, matrix[i, i]
    if largest == 3:
        out[0], out[1] = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0]
        out[2], out[3] = matrix[1, 0] - matrix[0, 1], 1.0 + trace
    else:
        i = largest
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = 1.0 - trace + 2.0 * matrix[i, i]
        out[j], out[k] = matrix[j, i] + matrix[i, j], matrix[k, i] + matrix[i, k]
        out[3] = matrix[k, j] - matrix[j, k]
    normalise(out)


@compiled
def normalise(quaternion: Vector) -> None:
    """Gives a quaternion (4,) norm 1, w at least 0, and rounds it, in place."""
    length = 0.0
    for i in range(4):
        length += quaternion[i] * quaternion[i]
    length = math.copysign(math.sqrt(length), quaternion[3])
    for i in range(4):
        quaternion[i] = np.rint(quaternion[i] / length * ROUND_TO) / ROUND_TO


@compiled
def axis_of(quaternion: Vector, out: Vector) -> None:
    """Into out (3,) where a quaternion (4,) turns +z; nowhere (0) where it has no length."""
    largest = max(abs(quaternion[0]), abs(quaternion[1]), abs(quaternion[2]), abs(quaternion[3]))
    out[:] = 0.0
    if not 0.0 < largest < math.inf:
        return
    x, y, z, w = quaternion[0] / largest, quaternion[1] / largest, quaternion[2] / largest, quaternion[3] / largest
    square = x * x + y * y + z * z + w * w
    out[0], out[1] = 2.0 * (x * z + y * w) / square, 2.0 * (y * z - x * w) / square
    out[2] = 1.0 - 2.0 * (x * x + y * y) / square


@compiled
def swing(start: Vector, end: Vector, out: Vector) -> None:
    """Into out (3,) [rad] the shortest turn from one direction (3,) to another, both of norm 1; 0
    where one has no length, or where they are opposite and no way is nearer.
    """
    x = start[1] * end[2] - start[2] * end[1]
    y = start[2] * end[0] - start[0] * end[2]
    z = start[0] * end[1] - start[1] * end[0]
    sine = math.sqrt(x * x + y * y + z * z)
    out[:] = 0.0
    if sine > 1e-9:
        size = math.atan2(sine, start[0] * end[0] + start[1] * end[1] + start[2] * end[2]) / sine
        out[0], out[1], out[2] = size * x, size * y, size * z


@compiled
def turn_between(start: Vector, end: Vector, out: Vector) -> None:
    """Into out (3,) [rad] the shortest turn from one quaternion (4,) to another; 0 where one has no
    length.
    """
    ax, ay, az, aw = start[0], start[1], start[2], start[3]
    bx, by, bz, bw = end[0], end[1], end[2], end[3]
    x = bw * -ax + aw * bx - (by * az - bz * ay)
    y = bw * -ay + aw * by - (bz * ax - bx * az)
    z = bw * -az + aw * bz - (bx * ay - by * ax)
    w = bw * aw + bx * ax + by * ay + bz * az
    sine = math.sqrt(x * x + y * y + z * z)
    size = 2.0 * math.atan2(sine, abs(w)) / max(sine, _TINY)
    if w < 0.0:
        size = -size
    out[0], out[1], out[2] = size * x, size * y, size * z


@compiled
def turn_on(quaternion: Vector, turn: Vector) -> None:
    """Turns a quaternion (4,) by a rotation vector (3,) [rad] of the world, in place."""
    angle = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    size = 0.5 if angle < 1e-6 else math.sin(0.5 * angle) / angle
    ax, ay, az, aw = size * turn[0], size * turn[1], size * turn[2], math.cos(0.5 * angle)
    bx, by, bz, bw = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    quaternion[0] = aw * bx + bw * ax + ay * bz - az * by
    quaternion[1] = aw * by + bw * ay + az * bx - ax * bz
    quaternion[2] = aw * bz + bw * az + ax * by - ay * bx
    quaternion[3] = aw * bw - ax * bx - ay * by - az * bz
    normalise(quaternion)
