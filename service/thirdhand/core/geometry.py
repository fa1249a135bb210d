"""Quaternions x y z w, and distances of segments and boxes; arrays in and out, [m], frame base.

Functions of two shapes write to `near` (9,): the nearest point of the first shape, the nearest
point of the second, and the unit normal from the first to the second.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import atan2, sin_cos
from thirdhand.core.frame import Records, Vector
from thirdhand.core.vectors import add_product, cross, dot, norm, rounded, transform

_TINY = 1e-12  # a smaller sine is rounding


def rotation(quaternion: tuple[float, float, float, float]) -> Vector:
    """Rotation matrix (3, 3) of a quaternion x y z w, which is normalised first."""
    x, y, z, w = (v / math.hypot(*quaternion) for v in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def angles(a: Vector, b: Vector) -> Vector:
    """Angles (...) [rad] between quaternions (..., 4) of norm 1: 2 arccos |a · b|."""
    return np.asarray(2.0 * np.arccos(np.clip(np.abs((a * b).sum(axis=-1)), 0.0, 1.0)))


def off_target(tool: Vector, target: Vector, *, direction: bool) -> Vector:
    """Angles (...) [rad] between tools and their targets, quaternions (..., 4) of norm 1.

    With `direction`, only the angle between their +z axes.
    """
    if not direction:
        return angles(tool, target)
    cosines = (_axes(tool) * _axes(target)).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))


def _axes(quaternions: Vector) -> Vector:
    """Directions (..., 3) of +z after the rotation by quaternions (..., 4) of norm 1."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)


@compiled
def quaternion_of(matrix: Vector, out: Vector) -> None:
    """Write into out (4,) the quaternion of a rotation matrix (3, 3), rounded.

    The largest component is computed first (Shepperd 1978).
    """
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    largest = 3
    largest_term = trace
    for i in range(3):
        if matrix[i, i] > largest_term:
            largest = i
            largest_term = matrix[i, i]
    if largest == 3:
        out[0] = matrix[2, 1] - matrix[1, 2]
        out[1] = matrix[0, 2] - matrix[2, 0]
        out[2] = matrix[1, 0] - matrix[0, 1]
        out[3] = 1.0 + trace
    else:
        i = largest
        j = (i + 1) % 3
        k = (i + 2) % 3
        out[i] = 1.0 - trace + 2.0 * matrix[i, i]
        out[j] = matrix[j, i] + matrix[i, j]
        out[k] = matrix[k, i] + matrix[i, k]
        out[3] = matrix[k, j] - matrix[j, k]
    normalise(out)


@compiled
def normalise(quaternion: Vector) -> None:
    """Scale a quaternion (4,) to norm 1 with w >= 0, and round it, in place."""
    length = 0.0
    for i in range(4):
        length += quaternion[i] * quaternion[i]
    length = math.copysign(math.sqrt(length), quaternion[3])
    for i in range(4):
        quaternion[i] = rounded(quaternion[i] / length)


@compiled
def axis_of(quaternion: Vector, out: Vector) -> None:
    """Write into out (3,) the direction of +z after the rotation by a quaternion (4,).

    The result is 0 if the quaternion is 0 or not finite.
    """
    largest = max(abs(quaternion[0]), abs(quaternion[1]), abs(quaternion[2]), abs(quaternion[3]))
    out[:] = 0.0
    if not 0.0 < largest < math.inf:
        return
    x = quaternion[0] / largest
    y = quaternion[1] / largest
    z = quaternion[2] / largest
    w = quaternion[3] / largest
    square = x * x + y * y + z * z + w * w
    out[0] = 2.0 * (x * z + y * w) / square
    out[1] = 2.0 * (y * z - x * w) / square
    out[2] = 1.0 - 2.0 * (x * x + y * y) / square


@compiled
def swing(start: Vector, quaternion: Vector, out: Vector) -> None:
    """Write into out (3,) [rad] the shortest rotation from a direction (3,) to a quaternion's +z.

    The direction has norm 1. The result is a rotation vector; it is 0 if one of the two has no
    length, or if they are opposite, where no direction is shorter.
    """
    end = np.empty(3)
    axis_of(quaternion, end)
    cross(start, end, out)
    sine = norm(out)
    if sine > 1e-9:
        size = atan2(sine, dot(start, end)) / sine
        for i in range(3):
            out[i] *= size
    else:
        out[:] = 0.0


@compiled
def turn_between(start: Vector, end: Vector, out: Vector) -> None:
    """Write into out (3,) [rad] the shortest rotation vector between two quaternions (4,).

    The result is 0 if one of them is 0.
    """
    ax = start[0]
    ay = start[1]
    az = start[2]
    aw = start[3]
    bx = end[0]
    by = end[1]
    bz = end[2]
    bw = end[3]
    x = bw * -ax + aw * bx - (by * az - bz * ay)
    y = bw * -ay + aw * by - (bz * ax - bx * az)
    z = bw * -az + aw * bz - (bx * ay - by * ax)
    w = bw * aw + bx * ax + by * ay + bz * az
    sine = math.sqrt(x * x + y * y + z * z)
    size = 2.0 * atan2(sine, abs(w)) / max(sine, _TINY)
    if w < 0.0:
        size = -size
    out[0] = size * x
    out[1] = size * y
    out[2] = size * z


@compiled
def turn_on(quaternion: Vector, turn: Vector) -> None:
    """Rotate a quaternion (4,) by a rotation vector (3,) [rad] of the base frame, in place."""
    angle = norm(turn)
    sine, cosine = sin_cos(0.5 * angle)
    size = 0.5 if angle < 1e-6 else sine / angle
    ax = size * turn[0]
    ay = size * turn[1]
    az = size * turn[2]
    aw = cosine
    bx = quaternion[0]
    by = quaternion[1]
    bz = quaternion[2]
    bw = quaternion[3]
    quaternion[0] = aw * bx + bw * ax + ay * bz - az * by
    quaternion[1] = aw * by + bw * ay + az * bx - ax * bz
    quaternion[2] = aw * bz + bw * az + ax * by - ay * bx
    quaternion[3] = aw * bw - ax * bx - ay * by - az * bz
    normalise(quaternion)


# [m] segments at a smaller distance intersect; [m²] a segment of smaller squared length is a point
LEAST = 1e-9
# bisection steps along a segment, for the point nearest to a box: 1e-12 of its length
HALVINGS = 40
CAPSULE = np.dtype(
    [
        ("link", np.int64),
        ("ends", np.float64, (2, 3)),
        ("radius", np.float64),
        ("max_speed", np.float64),
    ]
)


@compiled
def place(q: Vector, frames: Vector, axes: Vector, capsules: Records, out: Vector) -> None:
    """Write into out (N, 2, 3) the ends of a `Body`'s capsules at joints q (J,) [rad, m].

    The capsules are ordered by link.
    """
    turn = np.eye(3)
    origin = np.zeros(3)
    joint_turn = np.empty((3, 3))
    moved = np.empty((3, 3))
    next_origin = np.empty(3)
    capsule = 0
    for link in range(len(q) + 1):
        # the link's pose (turn, origin) from that of the link before
        if link > 0:
            frame = frames[link - 1]
            axis = axes[link - 1]
            slides = axis[3] != 0.0
            transform(turn, origin, frame[:, 3], next_origin)
            rotate_about(axis, 0.0 if slides else q[link - 1], joint_turn)
            moved[:] = 0.0
            add_product(turn, frame[:, :3], moved)
            if slides:
                for i in range(3):
                    for k in range(3):
                        next_origin[i] += moved[i, k] * axis[k] * q[link - 1]
            origin[:] = next_origin
            turn[:] = 0.0
            add_product(moved, joint_turn, turn)

        while capsule < len(capsules) and capsules[capsule].link == link:
            for end in range(2):
                transform(turn, origin, capsules[capsule].ends[end], out[capsule, end])
            capsule += 1


@compiled
def rotate_about(axis: Vector, angle: float, out: Vector) -> None:
    """Write into out (3, 3) the rotation about a unit axis (3,) by an angle [rad]."""
    x = axis[0]
    y = axis[1]
    z = axis[2]
    s, c = sin_cos(angle)
    v = 1.0 - c
    out[0, 0] = c + v * x * x
    out[0, 1] = v * x * y - s * z
    out[0, 2] = v * x * z + s * y
    out[1, 0] = v * x * y + s * z
    out[1, 1] = c + v * y * y
    out[1, 2] = v * y * z - s * x
    out[2, 0] = v * x * z - s * y
    out[2, 1] = v * y * z + s * x
    out[2, 2] = c + v * z * z


@compiled
def _unit(share: float) -> float:
    """Limit a share to 0 ... 1."""
    return min(max(share, 0.0), 1.0)


@compiled
def between_segments(one: Vector, other: Vector, near: Vector) -> float:  # noqa: C901, PLR0912 - a case for each side
    """Distance [m] between two segments (2, 3), and their nearest points and normal.

    After Ericson, Real-Time Collision Detection, 5.1.9. If the segments intersect, the normal
    points from the middle of the first to the middle of the second; downward if these coincide.
    """
    a = b = c = d = e = 0.0
    for i in range(3):
        u = one[1, i] - one[0, i]
        v = other[1, i] - other[0, i]
        w = one[0, i] - other[0, i]
        a += u * u
        b += u * v
        c += u * w
        d += v * v
        e += v * w

    # s and t, the shares of the segments at their nearest points
    if a <= LEAST and d <= LEAST:
        s = t = 0.0
    elif a <= LEAST:
        s = 0.0
        t = _unit(e / d)
    elif d <= LEAST:
        s = _unit(-c / a)
        t = 0.0
    else:
        slant = a * d - b * b
        s = _unit((b * e - c * d) / slant) if slant > 1e-9 * a * d else 0.0
        t = (b * s + e) / d
        if t < 0.0:
            s = _unit(-c / a)
            t = 0.0
        elif t > 1.0:
            s = _unit((b - c) / a)
            t = 1.0

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

    # they intersect: from middle to middle
    square = 0.0
    for i in range(3):
        near[6 + i] = other[0, i] + other[1, i] - one[0, i] - one[1, i]
        square += near[6 + i] * near[6 + i]
    length = math.sqrt(square)
    for i in range(3):
        near[6 + i] = near[6 + i] / length if length > LEAST else 0.0
    if length <= LEAST:
        near[8] = -1.0
    return distance


@compiled
def carry_back(near: Vector, then: Vector, now: Vector) -> None:
    """Move the first point of `near` from the segment `then` (2, 3) to the same share of `now`."""
    along = square = 0.0
    for i in range(3):
        extent = then[1, i] - then[0, i]
        along += extent * (near[i] - then[0, i])
        square += extent * extent
    share = along / square if square > 0.0 else 0.0
    for i in range(3):
        near[i] = now[0, i] + share * (now[1, i] - now[0, i])


@compiled
def nearest_to_box(segment: Vector, box: Vector) -> float:
    """Share, 0 to 1, of a segment (2, 3) at its point nearest to a box (2, 3).

    The box is given by its lower and upper corner. The slope of the squared distance grows along
    the segment; bisection finds its root.
    """
    if _slope(segment, box, 0.0) >= 0.0:
        return 0.0
    if _slope(segment, box, 1.0) <= 0.0:
        return 1.0
    low = 0.0
    high = 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _slope(segment, box, middle) > 0.0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@compiled
def _slope(segment: Vector, box: Vector, share: float) -> float:
    """Half the slope of the squared distance from a box, at the point p at a share of a segment.

    (p - nearest point of the box) · (end - start)
    """
    total = 0.0
    for i in range(3):
        extent = segment[1, i] - segment[0, i]
        point = segment[0, i] + share * extent
        total += (point - min(max(point, box[0, i]), box[1, i])) * extent
    return total


@compiled
def to_box(segment: Vector, share: float, box: Vector, near: Vector) -> float:
    """Signed distance [m] of the point at a share of a segment (2, 3) from a box (2, 3).

    Inside of the box it is negative, minus the distance to the nearest face, and the normal points
    from that face inward.
    """
    square = 0.0
    depth = math.inf
    face = 2
    side = -1.0
    for i in range(3):
        point = segment[0, i] + share * (segment[1, i] - segment[0, i])
        near[i] = point
        near[3 + i] = min(max(point, box[0, i]), box[1, i])
        near[6 + i] = near[3 + i] - point
        square += near[6 + i] * near[6 + i]
        if point - box[0, i] < depth:
            depth = point - box[0, i]
            face = i
            side = 1.0
        if box[1, i] - point < depth:
            depth = box[1, i] - point
            face = i
            side = -1.0
    distance = math.sqrt(square)
    if distance > LEAST:
        for i in range(3):
            near[6 + i] /= distance
        return distance
    for i in range(3):
        near[6 + i] = side if i == face else 0.0
    return -depth
