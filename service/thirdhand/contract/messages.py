"""The messages of the streams as values: ROS 2 messages, and the attachment of outputs."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple, TypeAlias

BASE = "base"
GRIPPER = "gripper"  # the name of its joint: position 0 is open, 1 closed
Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]  # x y z w


class WireError(ValueError):
    """Bytes that are not a valid message of their type."""


class PoseStamped(NamedTuple):
    """`geometry_msgs/msg/PoseStamped`: position [m], quaternion x y z w."""

    stamp_ns: int
    frame_id: str
    position: Vector3
    orientation: Quaternion


class PoseWithCovarianceStamped(NamedTuple):
    """`geometry_msgs/msg/PoseWithCovarianceStamped`; covariance is 6 x 6 row-major [m², rad²]."""

    stamp_ns: int
    frame_id: str
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...]


class JointState(NamedTuple):
    """`sensor_msgs/msg/JointState` [rad, rad/s, N m]; each as long as names, or empty."""

    stamp_ns: int
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...] = ()
    frame_id: str = ""


class Transform(NamedTuple):
    """`geometry_msgs/msg/TransformStamped` without its stamp: pose of a frame in its parent,
    translation [m], rotation x y z w.
    """

    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion


class SceneObject(NamedTuple):
    """An object on the bench, as viewers draw it: a `box`, `ball` or `cylinder` (along z), its pose
    in a frame, size x y z [m] and colour (red, green, blue and opacity, 0 to 1).
    """

    name: str
    shape: str
    frame_id: str
    position: Vector3
    orientation: Quaternion
    size: Vector3
    colour: tuple[float, float, float, float]


class Attachment(NamedTuple):
    """The attachment of every output: tick index, publish time [ns], stamp of the newest hand
    sample that the output answers [ns] (0: none).
    """

    tick: int
    published_ns: int
    hand_stamp_ns: int


def in_order(
    message: JointState, names: tuple[str, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position [rad] and velocity [rad/s] of the named joints, in the order of the names. Raises
    WireError.
    """
    order = _order(message.names, names)
    if len(message.position) != len(message.names) or len(message.velocity) not in (
        0,
        len(message.names),
    ):
        raise WireError(
            f"{len(message.names)} names, {len(message.position)} positions, "
            f"{len(message.velocity)} velocities"
        )
    velocity = message.velocity or (0.0,) * len(message.names)
    return tuple(message.position[i] for i in order), tuple(velocity[i] for i in order)


@functools.lru_cache(maxsize=64)
def _order(given: tuple[str, ...], names: tuple[str, ...]) -> tuple[int, ...]:
    """The index of each name among those given. Raises WireError."""
    indices = {name: i for i, name in enumerate(given)}
    missing = [name for name in names if name not in indices]
    if missing:
        raise WireError(
            f"joints {missing} missing among {len(given)}, {', '.join(given[:10])[:200]}"
        )
    repeated = [name for name in names if given.count(name) > 1]
    if repeated:
        raise WireError(
            f"joints {repeated} named more than once among {len(given)}; one position each needed"
        )
    return tuple(indices[name] for name in names)


def finite(values: tuple[float, ...]) -> bool:
    """True if no value is NaN or infinite."""
    return all(map(math.isfinite, values))
