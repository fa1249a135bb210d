"""Poses of the tool: x y z [m], quaternion x y z w."""

import math
from collections.abc import Sequence

POSE = ("tool.x", "tool.y", "tool.z", "tool.qx", "tool.qy", "tool.qz", "tool.qw")
MIN_NORM = 1e-3  # shorter quaternions have no direction


def dot(p: Sequence[float], q: Sequence[float]) -> float:
    """The scalar product of two quaternions."""
    return math.fsum(a * b for a, b in zip(p, q, strict=True))


def unit(quaternion: Sequence[float], near: Sequence[float] = ()) -> list[float]:
    """The unit quaternion (4,) on the side of `near`; without that, its largest number is positive.
    Raises ValueError for zeros.
    """
    norm = math.hypot(*quaternion)
    if norm < MIN_NORM:
        raise ValueError(f"quaternion {list(quaternion)} given; a norm of 1 needed (x y z w)")
    side = dot(quaternion, near) if near else max(quaternion, key=abs)
    return [value / math.copysign(norm, side) for value in quaternion]


def limited(
    pose: Sequence[float], present: Sequence[float], max_step_m: float, max_step_rad: float
) -> list[float]:
    """The pose (7,) between `present` and `pose` that is at most one step away from `present`."""
    step_m = math.dist(pose[:3], present[:3])
    share = min(1.0, max_step_m / step_m) if step_m else 1.0
    position = [p + share * (q - p) for p, q in zip(present[:3], pose[:3], strict=True)]

    # spherical interpolation over the angle 2 * half_rad
    turned = unit(pose[3:], present[3:])
    half_rad = math.acos(min(dot(turned, present[3:]), 1.0))
    if 2.0 * half_rad > max_step_rad:
        before = math.sin(half_rad - 0.5 * max_step_rad)
        after = math.sin(0.5 * max_step_rad)
        mixed = [before * p + after * q for p, q in zip(present[3:], turned, strict=True)]
        turned = unit(mixed, mixed)
    return [*position, *turned]
