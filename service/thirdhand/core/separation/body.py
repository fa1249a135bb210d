"""The arm's body: capsules around the shapes of its links, and the pairs that can collide.

Each capsule covers one shape. That of a cylinder, and that of a box along its longest side, has the
least volume; that of a mesh is given by the description. A link without a shape gets a capsule from
its joint to the next one, with a configured radius.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from thirdhand.core.frame import Records, Vector, structured
from thirdhand.core.geometry import CAPSULE, between_segments, place, rotation
from thirdhand.core.numerics import CAPSULE_FITS, TOLERANCE
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings
from thirdhand.settings.urdf import Shape, Urdf, UrdfJoint


def own_clearance(settings: Settings, tuning: Tuning = TUNING) -> float:
    """Distance [m] kept between parts of the arm; more would keep it from folding."""
    return min(settings.obstacles.clearance, tuning.separation.planned_margin_m)


class Body(NamedTuple):
    """Capsules of an arm of J joints, and how the joints move them.

    `frames` (J, 3, 4): pose of each joint in the frame of the joint before it, at position 0.
    `axes` (J, 4): axis of each joint in its own frame, then 1 for a prismatic and 0 for a revolute
    joint. `capsules` (N,): `link`, the number of joints that move the capsule; `ends` (2, 3) [m] in
    the frame of the last of these joints, or in base for none; `radius` [m]; `max_speed` [m/s], an
    upper bound of the speed of every point of its axis. `pairs` (P, 2): numbers of the capsules
    that are kept apart.
    """

    frames: Vector
    axes: Vector
    capsules: Records
    pairs: Any


def body_of(settings: Settings, description: str, tuning: Tuning = TUNING) -> Body:
    """Body of the arm that a URDF describes, with the tool on its plate.

    Capsules of links that do not follow each other are kept apart. Left out are pairs that the
    joints cannot move against each other, and pairs that belong together: in the configured posture
    they are nearer than the arm's own clearance or, around meshes with one link between them, than
    this clearance and planned_margin_m, as capsules exceed meshes by about as much.
    """
    urdf = Urdf(description)
    names = settings.joints.names
    chain = [joint for joint in urdf.chain(settings.arm.plate) if joint.name in names]
    frames = np.array([_in_joint(urdf, names, joint.parent, _origin(joint))[1] for joint in chain])
    parts = sorted(_parts(settings, urdf, chain, frames), key=lambda part: part.link)
    capsules = structured(len(parts), CAPSULE)
    capsules[:] = [(*part, _max_speed(settings, frames, part.link, part.ends)) for part in parts]
    axes = np.array([[*joint.axis, float(joint.kind == "prismatic")] for joint in chain])
    body = Body(np.ascontiguousarray(frames), axes, capsules, np.empty((0, 2), np.int64))
    has_meshes = any(shape.kind == "mesh" for shape in urdf.shapes)
    pairs = _pairs(settings, body, has_meshes, tuning)
    return body._replace(pairs=np.array(pairs, np.int64).reshape(-1, 2))


class _Part(NamedTuple):
    """A capsule: the number of joints that move it, its ends (2, 3) [m], and its radius [m]."""

    link: int
    ends: Vector
    radius: float


def _parts(
    settings: Settings, urdf: Urdf, chain: Sequence[UrdfJoint], frames: Vector
) -> list[_Part]:
    """The capsules of shapes, of links without a shape, and of the tool."""
    names = settings.joints.names
    parts: list[_Part] = []
    for shape in urdf.shapes:
        if shape.size:
            ends, radius = _capsule(shape)
            link, placed = _in_joint(urdf, names, shape.link, np.eye(3, 4))
            parts.append(_Part(link, ends @ placed[:, :3].T + placed[:, 3], radius))

    radius = settings.arm.link_radius
    plate_link, plate = _in_joint(urdf, names, settings.arm.plate, np.eye(3, 4))
    covered = {part.link for part in parts}
    for link in range(len(chain) + 1):
        if link in covered:
            continue
        end = frames[link][:, 3] if link < len(chain) else plate[:, 3]
        parts.append(_Part(link, np.array([np.zeros(3), end]), radius))
        if link < len(chain) and chain[link].kind == "prismatic":  # the guide of the next link
            joint = chain[link]
            travel = np.outer([joint.lower, joint.upper], frames[link][:, :3] @ joint.axis)
            parts.append(_Part(link, end + travel, radius))

    tool = np.array(settings.tool.plate_from_tool[:3])
    if math.hypot(*tool) > TOLERANCE:
        ends = np.array([plate[:, 3], plate[:, :3] @ tool + plate[:, 3]])
        parts.append(_Part(plate_link, ends, settings.tool.radius))
    return parts


def _pairs(
    settings: Settings, body: Body, has_meshes: bool, tuning: Tuning
) -> list[tuple[int, int]]:
    """The pairs of capsules that are kept apart, see `body_of`."""
    postures = np.array([settings.arm.posture, *_ends_of_motion(settings)])
    placed = np.empty((len(postures), len(body.capsules), 2, 3))
    near = np.empty(9)
    for q, ends in zip(postures, placed, strict=True):
        place(q, body.frames, body.axes, body.capsules, ends)

    links = body.capsules["link"]
    radii = body.capsules["radius"]
    clearance_m = own_clearance(settings, tuning)
    pairs = []
    for i, j in itertools.combinations(range(len(links)), 2):
        between = links[j] - links[i]
        if between <= 1:
            continue
        gaps_m = [between_segments(ends[i], ends[j], near) - radii[i] - radii[j] for ends in placed]
        is_coarse = has_meshes and between == 2  # capsules exceed meshes
        least_m = clearance_m + (tuning.separation.planned_margin_m if is_coarse else 0.0)
        if gaps_m[0] > least_m and np.ptp(gaps_m) > TOLERANCE:
            pairs.append((i, j))
    return pairs


def _max_speed(settings: Settings, frames: Vector, link: int, ends: Vector) -> float:
    """Upper bound of the speed [m/s] of all points between the ends (2, 3) [m] of a link.

        sum of velocity_j lever_j over the joints before the link

    lever_j is 1 for a prismatic joint. For a revolute joint it is the largest distance from joint j
    that the link lengths, and the travel of prismatic joints, allow.
    """
    lever = float(np.linalg.norm(ends, axis=1).max())
    speed = 0.0
    joints = settings.joints
    for joint in range(link - 1, -1, -1):
        if joints.every_kind[joint] == "prismatic":
            speed += joints.velocity[joint]
            lever += max(abs(joints.lower[joint]), abs(joints.upper[joint]))
        else:
            speed += joints.velocity[joint] * lever
        lever += float(np.linalg.norm(frames[joint][:, 3]))
    return speed


def _ends_of_motion(settings: Settings) -> tuple[Vector, Vector]:
    """Two postures (J,) [rad, m] on both sides of the configured one: lower and upper limits.

    A continuous joint turns by a part of a turn only, because its limits can be the same posture.
    """
    posture = np.array(settings.arm.posture)
    is_continuous = np.array(settings.joints.every_kind) == "continuous"
    lower = np.array(settings.joints.lower)
    upper = np.array(settings.joints.upper)
    return (
        np.where(is_continuous, np.maximum(posture - 1.9, lower), lower),
        np.where(is_continuous, np.minimum(posture + 2.3, upper), upper),
    )


def _origin(joint: UrdfJoint) -> Vector:
    """Pose (3, 4) of a joint in its parent link."""
    return np.column_stack((rotation(joint.rotation), joint.translation))


def _in_joint(urdf: Urdf, names: tuple[str, ...], link: str, placed: Vector) -> tuple[int, Vector]:
    """Express a pose (3, 4), given in a link, in the frame of the joint that moves the link.

    Joints that are not among `names` stay at 0. Also returns the joint's number from 1, or 0 for
    base.
    """
    while (joint := urdf.above(link)) is not None:
        if joint.name in names:
            return names.index(joint.name) + 1, placed
        origin = _origin(joint)
        placed = np.column_stack(
            (origin[:, :3] @ placed[:, :3], origin[:, :3] @ placed[:, 3] + origin[:, 3])
        )
        link = joint.parent
    return 0, placed


def _capsule(shape: Shape) -> tuple[Vector, float]:
    """Ends (2, 3) in the link's frame and radius [m] of the capsule that covers a shape."""
    if shape.kind == "mesh":
        ends = np.reshape(shape.size[:6], (2, 3))
        return ends @ rotation(shape.rotation).T + shape.translation, shape.size[6]
    axis = 2
    half = 0.0
    radius = shape.size[0]
    if shape.kind == "box":
        axis = int(np.argmax(shape.size))
        radius = 0.5 * math.hypot(*(size for i, size in enumerate(shape.size) if i != axis))
        half, radius = _around(0.5 * shape.size[axis], radius)
    elif shape.kind == "cylinder":
        half, radius = _around(0.5 * shape.size[1], radius)
    elif shape.kind == "capsule":
        half = 0.5 * shape.size[1]
    along = rotation(shape.rotation)[:, axis] * half
    return np.array([shape.translation - along, shape.translation + along]), radius


def _around(half: float, radius: float) -> tuple[float, float]:
    """Half length of the axis and radius [m] of the smallest capsule around a cylinder.

    With `half` and `radius` of the cylinder, the capsule has

        R(h) = sqrt(radius² + (half - h)²),    volume = π R² (2 h + 4 R / 3),

    and the best of CAPSULE_FITS values of h in [0, half] is taken.
    """
    axes = np.linspace(0.0, half, CAPSULE_FITS)
    radii = np.hypot(radius, half - axes)
    best = int(np.argmin(radii**2 * (2.0 * axes + 4.0 / 3.0 * radii)))
    return float(axes[best]), float(radii[best])
