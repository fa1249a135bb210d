"""ROS 2 messages in CDR, little endian: the bytes of every stream on the wire and of every message in a recording.

Written by hand because the loop encodes and decodes several a tick, in a microsecond each.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

BASE = "base"
JOINT_NAMES = (
    "wam/base_yaw_joint",
    "wam/shoulder_pitch_joint",
    "wam/shoulder_yaw_joint",
    "wam/elbow_pitch_joint",
    "wam/wrist_yaw_joint",
    "wam/wrist_pitch_joint",
    "wam/palm_yaw_joint",
)


class WireError(ValueError):
    """Bytes that are not the message they should be."""


CDR_HEADER = b"\x00\x01\x00\x00"
Vector7: TypeAlias = tuple[float, ...]
Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]  # x y z w
_NS = 1_000_000_000
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_POSE = struct.Struct("<7d")
_COMMAND = struct.Struct("<7dII7dI")
_COVARIANCE = struct.Struct("<36d")


class PoseStamped(NamedTuple):
    """`geometry_msgs/msg/PoseStamped`: position [m], quaternion x y z w."""

    stamp_ns: int
    frame: str
    position: Vector3
    orientation: Quaternion


class PoseWithCovarianceStamped(NamedTuple):
    """`geometry_msgs/msg/PoseWithCovarianceStamped`; covariance is 6 x 6 row-major [m², rad²]."""

    stamp_ns: int
    frame: str
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...]


class JointState(NamedTuple):
    """`sensor_msgs/msg/JointState`: position [rad], velocity [rad/s], effort [N m]; each as long as names, or empty."""

    stamp_ns: int
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...] = ()
    frame: str = ""


def _header(stamp_ns: int, frame: str) -> bytearray:
    sec, nanosec = divmod(stamp_ns, _NS)
    out = bytearray(CDR_HEADER)
    out += _STAMP.pack(sec, nanosec)
    _put_string(out, frame)
    return out


def _align(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - 4) % size)


def _put_string(out: bytearray, text: str) -> None:
    raw = text.encode() + b"\0"
    _align(out, 4)
    out += _LENGTH.pack(len(raw))
    out += raw


def _put_doubles(out: bytearray, values: tuple[float, ...]) -> None:
    _align(out, 4)
    out += _LENGTH.pack(len(values))
    if values:
        _align(out, 8)
        out += struct.pack(f"<{len(values)}d", *values)


def encode_pose(message: PoseStamped) -> bytes:
    """CDR bytes of a PoseStamped."""
    out = _header(message.stamp_ns, message.frame)
    _align(out, 8)
    out += _POSE.pack(*message.position, *message.orientation)
    return bytes(out)


def encode_pose_with_covariance(message: PoseWithCovarianceStamped) -> bytes:
    """CDR bytes of a PoseWithCovarianceStamped."""
    out = _header(message.stamp_ns, message.frame)
    _align(out, 8)
    out += _POSE.pack(*message.position, *message.orientation)
    out += _COVARIANCE.pack(*message.covariance)
    return bytes(out)


def encode_joints(message: JointState) -> bytes:
    """CDR bytes of a JointState."""
    out = _header(message.stamp_ns, message.frame)
    _align(out, 4)
    out += _LENGTH.pack(len(message.names))
    for name in message.names:
        _put_string(out, name)
    for values in (message.position, message.velocity, message.effort):
        _put_doubles(out, values)
    return bytes(out)


@functools.cache
def _command_prefix() -> bytes:
    """What follows the stamp in every joint command, up to its first number."""
    empty = encode_joints(JointState(0, JOINT_NAMES, (0.0,) * 7, ()))
    return empty[12 : len(empty) - 8 - 7 * 8]


def encode_command(stamp_ns: int, position: Sequence[float], velocity: Sequence[float]) -> bytes:
    """CDR bytes of the JointState that commands the seven joints [rad, rad/s]; as `encode_joints`, in a tenth of its time."""
    return b"".join((CDR_HEADER, _STAMP.pack(*divmod(stamp_ns, _NS)), _command_prefix(), _COMMAND.pack(*position, 7, 0, *velocity, 0)))


def encode_string(text: str) -> bytes:
    """CDR bytes of a `std_msgs/msg/String`."""
    out = bytearray(CDR_HEADER)
    _put_string(out, text)
    return bytes(out)


class _Reader:
    """A cursor over CDR bytes; every read is checked against the end."""

    def __init__(self, data: bytes) -> None:
        if data[:4] != CDR_HEADER:
            raise WireError(f"header {data[:4].hex(' ') or 'missing'}, little-endian CDR {CDR_HEADER.hex(' ')} needed")
        self._data = data
        self._at = 4

    def unpack(self, layout: struct.Struct, align: int) -> tuple[Any, ...]:
        at = self._at + (-(self._at - 4) % align)
        self._at = at + layout.size
        try:
            return layout.unpack_from(self._data, at)
        except struct.error:
            raise WireError(f"{len(self._data)} bytes end before byte {self._at} of the message") from None

    def length(self) -> int:
        count: int = self.unpack(_LENGTH, 4)[0]
        if count > len(self._data) - self._at:
            raise WireError(f"a length of {count} with {len(self._data) - self._at} bytes left")
        return count

    def string(self) -> str:
        count = self.length()
        raw = self._data[self._at : self._at + count]
        self._at += count
        try:
            return raw.rstrip(b"\0").decode()
        except UnicodeDecodeError:
            raise WireError("a string that is not UTF-8") from None

    def doubles(self) -> tuple[float, ...]:
        count = self.length()
        return self.unpack(struct.Struct(f"<{count}d"), 8) if count else ()

    def header(self) -> tuple[int, str]:
        sec, nanosec = self.unpack(_STAMP, 4)
        return sec * _NS + nanosec, self.string()

    def end(self) -> None:
        if len(self._data) - self._at > 3:  # some writers pad to four bytes
            raise WireError(f"{len(self._data) - self._at} bytes follow the message")


def decode_pose(data: bytes) -> PoseStamped:
    """The PoseStamped in CDR bytes. Raises WireError."""
    reader = _Reader(data)
    stamp, frame = reader.header()
    values = reader.unpack(_POSE, 8)
    reader.end()
    return PoseStamped(stamp, frame, values[:3], values[3:])


def decode_pose_with_covariance(data: bytes) -> PoseWithCovarianceStamped:
    """The PoseWithCovarianceStamped in CDR bytes. Raises WireError."""
    reader = _Reader(data)
    stamp, frame = reader.header()
    values = reader.unpack(_POSE, 8)
    covariance = reader.unpack(_COVARIANCE, 8)
    reader.end()
    return PoseWithCovarianceStamped(stamp, frame, values[:3], values[3:], covariance)


def decode_joints(data: bytes) -> JointState:
    """The JointState in CDR bytes. Raises WireError."""
    reader = _Reader(data)
    stamp, frame = reader.header()
    names = tuple(reader.string() for _ in range(reader.length()))
    position, velocity, effort = reader.doubles(), reader.doubles(), reader.doubles()
    reader.end()
    return JointState(stamp, names, position, velocity, effort, frame)


def decode_string(data: bytes) -> str:
    """The text of a `std_msgs/msg/String`. Raises WireError."""
    return _Reader(data).string()


def in_chain_order(message: JointState) -> tuple[Vector7, Vector7]:
    """Position and velocity of the seven joints in chain order, whatever order they came in. Raises WireError."""
    found = {name: i for i, name in enumerate(message.names)}
    missing = [name for name in JOINT_NAMES if name not in found]
    if missing:
        raise WireError(f"joints {missing} missing among {list(message.names)}")
    if len(message.position) != len(message.names) or len(message.velocity) not in (0, len(message.names)):
        raise WireError(f"{len(message.names)} names, {len(message.position)} positions, {len(message.velocity)} velocities")
    order = [found[name] for name in JOINT_NAMES]
    velocity = message.velocity or (0.0,) * len(message.names)
    return tuple(message.position[i] for i in order), tuple(velocity[i] for i in order)


def finite(values: tuple[float, ...]) -> bool:
    """Whether no value is NaN or infinite."""
    return all(map(math.isfinite, values))
