"""Where capsules are and how far apart, compiled: arrays in, arrays out; [m], frame base.

What is found of a pair is written to `near` (9,): the point on the first, the point on the second,
and the unit normal from the first to the second.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.record import Records, Vector

LEAST = 1e-9  # [m] segments nearer than this meet; [m²] shorter ones are points
HALVINGS = 40
CAPSULE = np.dtype(
    [("link", np.int64), ("ends", np.float64, (2, 3)), ("radius", np.float64), ("max_speed", np.float64)]
)


@compiled
def place(q: Vector, frames: Vector, axes: Vector, capsules: Records, out: Vector) -> None:
    """Into out (N, 2, 3) the ends of a `Body`'s capsules at joints q (J,) [rad]; its capsules are
    ordered by link.
    """
    turn, at = np.eye(3), np.zeros(3)
    own, moved, there = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    capsule, count = 0, len(capsules)
    for link in range(len(q) + 1):
        if link > 0:
            frame = frames[link - 1]
            for i in range(3):
                there[i] = at[i]
                for k in range(3):
                    there[i] += turn[i, k] * frame[k, 3]
            _about(axes[link - 1], q[link - 1], own)
            for i in range(3):
                for j in range(3):
                    moved[i, j] = 0.0
                    for k in range(3):
                        moved[i, j] += turn[i, k] * frame[k, j]
            for i in range(3):
                at[i] = there[i]
                for j in range(3):
                    turn[i, j] = 0.0
                    for k in range(3):
                        turn[i, j] += moved[i, k] * own[k, j]
        while capsule < count and capsules[capsule].link == link:
            for end in range(2):
                for i in range(3):
                    out[capsule, end, i] = at[i]
                    for k in range(3):
                        out[capsule, end, i] += turn[i, k] * capsules[capsule].ends[end, k]
            capsule += 1


@compiled
def _about(axis: Vector, angle: float, out: Vector) -> None:
    """Into out (3, 3) the rotation about a unit axis [rad]."""
    x, y, z = axis[0], axis[1], axis[2]
    s, c = math.sin(angle), math.cos(angle)
    v = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + v * x * x, v * x * y - s * z, v * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = v * x * y + s * z, c + v * y * y, v * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = v * x * z - s * y, v * y * z + s * x, c + v * z * z


@compiled
def _unit(share: float) -> float:
    return min(max(share, 0.0), 1.0)


@compiled
def between_segments(one: Vector, other: Vector, near: Vector) -> float:
    """Distance of two segments (2, 3), after Ericson, Real-Time Collision Detection, 5.1.9.

    Where they meet the normal is that between their middles.
    """
    a = b = c = d = e = 0.0
    for i in range(3):
        u, v, w = one[1, i] - one[0, i], other[1, i] - other[0, i], one[0, i] - other[0, i]
        a += u * u
        b += u * v
        c += u * w
        d += v * v
        e += v * w
    if a <= LEAST and d <= LEAST:
        s = t = 0.0
    elif a <= LEAST:
        s, t = 0.0, _unit(e / d)
    elif d <= LEAST:
        s, t = _unit(-c / a), 0.0
    else:
        slant = a * d - b * b
        s = _unit((b * e - c * d) / slant) if slant > 1e-9 * a * d else 0.0
        t = (b * s + e) / d
        if t < 0.0:
            s, t = _unit(-c / a), 0.0
        elif t > 1.0:
            s, t = _unit((b - c) / a), 1.0
    square = 0.0
    for i in range(3):
        near[i] = one[0, i] + s * (one[1, i] - one[0, i])
        near[3 + i] = other[0, i] + t * (other[1, i] - other[0, i])
        near[6 + i] = near[3 + i] - near[i]
        square += near[6 + i] * near[6 + i]
    distance = math.sqrt(square)
    if distance > LEAST:
        for i in range(3):
            near[6 + i] /= distance
        return distance
    square = 0.0
    for i in range(3):
        near[6 + i] = other[0, i] + other[1, i] - one[0, i] - one[1, i]
        square += near[6 + i] * near[6 + i]
    length = math.sqrt(square)
    for i in range(3):
        near[6 + i] = near[6 + i] / length if length > LEAST else (-1.0 if i == 2 else 0.0)
    return distance


@compiled
def nearest_to_box(segment: Vector, box: Vector) -> float:
    """Where along a segment (2, 3), 0 to 1, it is nearest to a box (2, 3) of lower and upper
    corner: the root of the distance's slope, which grows along the segment.
    """
    if _slope(segment, box, 0.0) >= 0.0:
        return 0.0
    if _slope(segment, box, 1.0) <= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _slope(segment, box, middle) > 0.0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@compiled
def _slope(segment: Vector, box: Vector, share: float) -> float:
    total = 0.0
    for i in range(3):
        way = segment[1, i] - segment[0, i]
        at = segment[0, i] + share * way
        total += (at - min(max(at, box[0, i]), box[1, i])) * way
    return total


@compiled
def to_box(segment: Vector, share: float, box: Vector, near: Vector) -> float:
    """Distance of the point at a share of a segment (2, 3) from a box (2, 3); below 0 inside, where
    the nearest face is the way out.
    """
    square, least, face, side = 0.0, math.inf, 2, -1.0
    for i in range(3):
        at = segment[0, i] + share * (segment[1, i] - segment[0, i])
        near[i] = at
        near[3 + i] = min(max(at, box[0, i]), box[1, i])
        near[6 + i] = near[3 + i] - at
        square += near[6 + i] * near[6 + i]
        if at - box[0, i] < least:
            least, face, side = at - box[0, i], i, 1.0
        if box[1, i] - at < least:
            least, face, side = box[1, i] - at, i, -1.0
    distance = math.sqrt(square)
    if distance > LEAST:
        for i in range(3):
            near[6 + i] /= distance
        return distance
    for i in range(3):
        near[6 + i] = side if i == face else 0.0
    return -least
