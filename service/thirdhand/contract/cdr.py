"""ROS 2 messages in CDR: the bytes of every stream on the wire and of every message in a recording.
They are written little endian, and read in each encoding of plain CDR (XTypes 1.3, 7.6.3.1).

Written by hand because the loop encodes and decodes several per tick, in a microsecond each.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from thirdhand.contract.messages import (
    GRIPPER,
    Attachment,
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    Transform,
    WireError,
    in_order,
)

CDR_HEADER = b"\x00\x01\x00\x00"
_NS = 1_000_000_000
_STAMP = struct.Struct("<II")  # seconds are signed in ROS 2; unsigned ones last until 2106
_LENGTH = struct.Struct("<I")
_BOOL = struct.Struct("<B")
_POSE = struct.Struct("<7d")
_TRANSFORM = struct.Struct("<III")  # stamp, and length of the parent's name
_COVARIANCE = struct.Struct("<36d")
_TICK = struct.Struct("<qII")
_ATTACHMENT = struct.Struct("<Qqq")
_STAMPED = 12  # bytes of header and stamp
_MOST_LAYOUTS = 16  # layouts of joint states that are remembered
MAX_BYTES = 8192  # bounds the time in which the loop reads a message
LONGEST_TRANSFORMS = 32768  # bytes of a TFMessage: of about 300 transforms
# Encodings by half of their number, with which a message begins; odd ones are little endian. CDR2
# has the number of RTPS, which implementations of DDS write, or that of XTypes.
_ENCODINGS = {0: "CDR", 1: "PL_CDR", 2: "XML", 3: "CDR2", 4: "DELIMITED_CDR2", 5: "PL_CDR2"}
_ENCODINGS |= {8: "CDR2", 9: "PL_CDR2", 10: "DELIMITED_CDR2"}


def _stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a stamp. Upper bits that do not fit are dropped, so that no clock,
    however wrong, stops the loop.
    """
    seconds, nanoseconds = divmod(stamp_ns, _NS)
    return seconds & 0xFFFFFFFF, nanoseconds


class Writer(bytearray):
    """A writer that assembles CDR bytes piece by piece."""

    def __init__(self) -> None:
        super().__init__(CDR_HEADER)

    def pack(self, layout: struct.Struct, *values: Any, align: int) -> None:
        self += bytes(-(len(self) - 4) % align)
        self += layout.pack(*values)

    def string(self, text: str) -> None:
        raw = text.encode() + b"\0"
        self.pack(_LENGTH, len(raw), align=4)
        self += raw

    def doubles(self, values: Sequence[float]) -> None:
        self.pack(_LENGTH, len(values), align=4)
        if values:
            self.pack(struct.Struct(f"<{len(values)}d"), *values, align=8)

    def header(self, stamp_ns: int, frame: str) -> None:
        self.pack(_STAMP, *_stamp(stamp_ns), align=4)
        self.string(frame)


@functools.lru_cache(maxsize=_MOST_LAYOUTS)
def _frame_bytes(frame_id: str) -> bytes:
    """The bytes between stamp and pose of a message in this frame."""
    out = Writer()
    out.header(0, frame_id)
    return bytes(out[_STAMPED:]) + bytes(-(len(out) - 4) % 8)


def encode_pose(message: PoseStamped | PoseWithCovarianceStamped) -> bytes:
    """CDR bytes of a PoseStamped, or of the begin of a message with a covariance."""
    stamp = _STAMP.pack(*_stamp(message.stamp_ns))
    pose = _POSE.pack(*message.position, *message.orientation)
    return CDR_HEADER + stamp + _frame_bytes(message.frame_id) + pose


def encode_pose_with_covariance(message: PoseWithCovarianceStamped) -> bytes:
    """CDR bytes of a PoseWithCovarianceStamped."""
    return encode_pose(message) + _COVARIANCE.pack(*message.covariance)


def encode_joints(message: JointState) -> bytes:
    """CDR bytes of a JointState."""
    out = Writer()
    out.header(message.stamp_ns, message.frame_id)
    out.pack(_LENGTH, len(message.names), align=4)
    for name in message.names:
        out.string(name)
    for values in (message.position, message.velocity, message.effort):
        out.doubles(values)
    return bytes(out)


def _joint_numbers(counts: tuple[int, int, int]) -> struct.Struct:
    """The layout of positions, velocities and efforts with these counts. The count of velocities
    and of efforts precedes them; that of positions precedes the layout.
    """
    layout = f"<{counts[0]}d"
    offset = 0
    for count in counts[1:]:
        layout = layout + "I"
        offset = offset + 4
        if count:
            layout = layout + ("4x" if offset % 8 else "") + f"{count}d"
            offset = 0
    return struct.Struct(layout)


@functools.cache
def _command_layout(names: tuple[str, ...]) -> tuple[bytes, struct.Struct]:
    """For commands to these joints: bytes between stamp and first number, layout of the rest."""
    n = len(names)
    empty = encode_joints(JointState(0, names, (0.0,) * n, (0.0,) * n))
    layout = _joint_numbers((n, n, 0))
    return empty[_STAMPED : len(empty) - layout.size], layout


def encode_command(
    stamp_ns: int, names: tuple[str, ...], position: Sequence[float], velocity: Sequence[float]
) -> bytes:
    """CDR bytes of the JointState that commands the joints [rad, rad/s]; the same as
    `encode_joints`, in a tenth of the time.
    """
    prefix, layout = _command_layout(names)
    head = CDR_HEADER + _STAMP.pack(*_stamp(stamp_ns)) + prefix
    return head + layout.pack(*position, len(names), *velocity, 0)


def encode_numbers(values: Sequence[float]) -> bytes:
    """CDR bytes of a `std_msgs/msg/Float64MultiArray` without a layout."""
    out = Writer()
    out.pack(_STAMP, 0, 0, align=4)  # no dimensions, and where data begins
    out.doubles(values)
    return bytes(out)


def encode_trajectory(
    names: tuple[str, ...], position: Sequence[float], velocity: Sequence[float], within_ns: int
) -> bytes:
    """CDR bytes of a `trajectory_msgs/msg/JointTrajectory` that starts on arrival: one point [rad,
    rad/s], reached after a time [ns].
    """
    out = Writer()
    out.header(0, "")
    out.pack(_LENGTH, len(names), align=4)
    for name in names:
        out.string(name)
    out.pack(_LENGTH, 1, align=4)
    for values in (position, velocity, (), ()):
        out.doubles(values)
    out.pack(_STAMP, *_stamp(within_ns), align=4)
    return bytes(out)


def encode_diagnostics(
    stamp_ns: int, level: int, name: str, message: str, values: Mapping[str, str]
) -> bytes:
    """CDR bytes of a `diagnostic_msgs/msg/DiagnosticArray` of one status."""
    out = Writer()
    out.header(stamp_ns, "")
    out.pack(_LENGTH, 1, align=4)
    out.append(level)
    for text in (name, message, name):  # the third is the hardware
        out.string(text)
    out.pack(_LENGTH, len(values), align=4)
    for text in (text for pair in values.items() for text in pair):
        out.string(text)
    return bytes(out)


def encode_string(text: str) -> bytes:
    """CDR bytes of a `std_msgs/msg/String`."""
    out = Writer()
    out.string(text)
    return bytes(out)


def encode_bool(value: bool) -> bytes:
    """CDR bytes of a `std_msgs/msg/Bool`."""
    return CDR_HEADER + bytes([value])


def encode_transforms(stamp_ns: int, transforms: Sequence[Transform]) -> bytes:
    """CDR bytes of a `tf2_msgs/msg/TFMessage`."""
    out = Writer()
    out.pack(_LENGTH, len(transforms), align=4)
    for item in transforms:
        out.header(stamp_ns, item.parent)
        out.string(item.child)
        out.pack(_POSE, *item.translation, *item.rotation, align=8)
    return bytes(out)


def encode_tick(index: int, events: Sequence[int], lost: int, checksum: int | None = None) -> bytes:
    """CDR bytes of a `thirdhand/msg/Tick`: its index, the number of lost ticks before it, and the
    numbers of its events' kinds in inbox order. With the checksum of its frame they are those of a
    `thirdhand/msg/CheckedTick`.
    """
    tick = CDR_HEADER + _TICK.pack(index, lost, len(events)) + bytes(events)
    return tick if checksum is None else tick + bytes(-len(events) % 4) + _LENGTH.pack(checksum)


def encode_skill(data: bytes) -> bytes:
    """CDR bytes of a `thirdhand/msg/Skill`: the bytes of its file."""
    return CDR_HEADER + _LENGTH.pack(len(data)) + data


def encode_record(data: bytes) -> bytes:
    """CDR bytes of a record of fixed layout (see `records`): the header and the record."""
    return CDR_HEADER + data


def _stamp_ns(sec: int, nanosec: int) -> int:
    if nanosec >= _NS:
        raise WireError(f"a stamp of {nanosec} ns beside its seconds, less than {_NS} needed")
    return sec * _NS + nanosec


def _text(raw: bytes) -> str:
    try:
        return raw.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        raise WireError("a string that is not UTF-8") from None


@functools.cache
def _big_endian(layout: struct.Struct) -> struct.Struct:
    return struct.Struct(f">{layout.format.lstrip('<')}")


class Reader:
    """A cursor over CDR bytes; reads beyond the end raise WireError.

    The options, which follow the number of the encoding, count padding bytes at the end. They are
    not needed, because up to three bytes may follow each message.
    """

    def __init__(self, data: bytes, most: int | None = None) -> None:
        if most is not None and len(data) > most:
            raise WireError(f"a message of {len(data)} bytes, at most {most} accepted")
        # MAX_BYTES is no encoding's number
        number = data[1] if len(data) >= 4 and not data[0] else MAX_BYTES
        encoding = _ENCODINGS.get(number >> 1, "")
        if encoding not in ("CDR", "CDR2"):
            named = f"encoding {encoding}, " if encoding else ""
            raise WireError(
                f"{named}header {data[:4].hex(' ') or 'missing'}; plain CDR or CDR2 needed"
            )
        self._is_big_endian = not number & 1
        self._max_align = 8 if encoding == "CDR" else 4
        self._data = data
        self.at = 4

    def unpack(self, layout: struct.Struct, align: int) -> tuple[Any, ...]:
        if self._is_big_endian:
            layout = _big_endian(layout)
        offset = self.at + (-(self.at - 4) % min(align, self._max_align))
        self.at = offset + layout.size
        try:
            return layout.unpack_from(self._data, offset)
        except struct.error:
            raise WireError(
                f"{len(self._data)} bytes end before byte {self.at} of the message"
            ) from None

    def length(self) -> int:
        count: int = self.unpack(_LENGTH, 4)[0]
        if count > len(self._data) - self.at:
            raise WireError(f"a length of {count} with {len(self._data) - self.at} bytes left")
        return count

    def items(self) -> int:
        """Length of a sequence of strings or structures; CDR2 has its size in bytes before it."""
        if self._max_align == 4:
            self.length()
        return self.length()

    def string(self) -> str:
        return _text(self._raw_string())

    def _raw_string(self) -> bytes:
        count = self.length()
        raw = self._data[self.at : self.at + count]
        self.at += count
        return raw

    def doubles(self) -> tuple[float, ...]:
        count = self.length()
        return self.unpack(struct.Struct(f"<{count}d"), 8) if count else ()

    def skip(self, layout: struct.Struct, align: int) -> None:
        """Skip a sequence of items of one layout: numbers, or structures of them."""
        if count := self.length() if layout.size == align else self.items():
            self.unpack(struct.Struct(f"{count * layout.size}x"), align)

    def header(self) -> tuple[int, str]:
        return _stamp_ns(*self.unpack(_STAMP, 4)), self.string()

    def transform(self) -> tuple[tuple[int, int], bytes, bytes, Any]:
        """Seconds and nanoseconds, parent, child, and pose of a TransformStamped, in a quarter of
        the time of single reads: messages hold many, of which the loop needs two.
        """
        if self._is_big_endian or self._max_align == 4:
            stamp: Any = self.unpack(_STAMP, 4)
            return stamp, self._raw_string(), self._raw_string(), self.unpack(_POSE, 8)
        data = self._data
        parent_at = self.at + -self.at % 4 + _TRANSFORM.size
        try:
            seconds, nanoseconds, parent_size = _TRANSFORM.unpack_from(
                data, parent_at - _TRANSFORM.size
            )
            child_at = parent_at + parent_size + -(parent_at + parent_size) % 4 + _LENGTH.size
            (child_size,) = _LENGTH.unpack_from(data, child_at - _LENGTH.size)
            pose_at = child_at + child_size + (4 - child_at - child_size) % 8
            self.at = pose_at + _POSE.size
            pose = _POSE.unpack_from(data, pose_at)
        except struct.error:
            raise WireError(f"{len(data)} bytes end within a transform") from None
        parent = data[parent_at : parent_at + parent_size]
        child = data[child_at : child_at + child_size]
        return (seconds, nanoseconds), parent, child, pose

    def end(self) -> None:
        if len(self._data) - self.at > 3:  # some writers pad to four bytes
            raise WireError(f"{len(self._data) - self.at} bytes follow the message")


def _read_pose(data: bytes, *layouts: struct.Struct) -> tuple[Any, ...]:
    reader = Reader(data, MAX_BYTES)
    stamp, frame = reader.header()
    pose, *more = (reader.unpack(layout, 8) for layout in layouts)
    reader.end()
    return stamp, frame, pose[:3], pose[3:], *more


_frames: dict[bytes, str] = {}  # by the bytes between stamp and pose


def decode_pose(data: bytes) -> PoseStamped:
    """The PoseStamped in CDR bytes. Raises WireError.

    A source repeats the name of its frame, so that is read only once.
    """
    known = data[_STAMPED : -_POSE.size]
    frame = _frames.get(known)
    if frame is not None and data.startswith(CDR_HEADER):
        pose = _POSE.unpack_from(data, len(data) - _POSE.size)
        return PoseStamped(_stamp_ns(*_STAMP.unpack_from(data, 4)), frame, pose[:3], pose[3:])

    message = PoseStamped(*_read_pose(data, _POSE))
    if encode_pose(message) == data:  # not another writer's padding
        if len(_frames) >= _MOST_LAYOUTS:
            _frames.clear()
        _frames[known] = message.frame_id
    return message


def decode_pose_with_covariance(data: bytes) -> PoseWithCovarianceStamped:
    """The PoseWithCovarianceStamped in CDR bytes. Raises WireError."""
    return PoseWithCovarianceStamped(*_read_pose(data, _POSE, _COVARIANCE))


def decode_wish(data: bytes) -> PoseStamped | PoseWithCovarianceStamped:
    """The PoseWithCovarianceStamped or PoseStamped in CDR bytes; one of a frame with a long name is
    taken as the former. Raises WireError.
    """
    if len(data) > _POSE.size + _COVARIANCE.size:
        return decode_pose_with_covariance(data)
    return decode_pose(data)


class _JointLayout(NamedTuple):
    """The common part of messages of one length from one source."""

    fixed: bytes  # bytes between the stamp and the first position
    numbers: struct.Struct  # layout from the first position on
    counts: tuple[int, int, int]  # numbers of positions, velocities, efforts
    names: tuple[str, ...]
    frame_id: str


_joint_layouts: dict[int, _JointLayout] = {}  # by the length of the message


def decode_joints(data: bytes) -> JointState:
    """The JointState in CDR bytes. Raises WireError.

    A source repeats the same names, so their place in the message is found only once.
    """
    layout = _joint_layouts.get(len(data))
    if (
        layout is not None
        and data.startswith(layout.fixed, _STAMPED)
        and data.startswith(CDR_HEADER)
    ):
        # positions, number of velocities, velocities, number of efforts, efforts
        numbers = layout.numbers.unpack_from(data, _STAMPED + len(layout.fixed))
        n = layout.counts[0]
        v = layout.counts[0] + 1 + layout.counts[1]
        if numbers[n] == layout.counts[1] and numbers[v] == layout.counts[2]:
            return JointState(
                _stamp_ns(*_STAMP.unpack_from(data, 4)),
                layout.names,
                numbers[:n],
                numbers[n + 1 : v],
                numbers[v + 1 :],
                layout.frame_id,
            )

    reader = Reader(data, MAX_BYTES)
    stamp, frame = reader.header()
    names = tuple(reader.string() for _ in range(reader.items()))
    position = reader.doubles()
    velocity = reader.doubles()
    effort = reader.doubles()
    reader.end()
    message = JointState(stamp, names, position, velocity, effort, frame)
    _learn_layout(message, data)
    return message


def _learn_layout(message: JointState, data: bytes) -> None:
    counts = len(message.position), len(message.velocity), len(message.effort)
    if not message.position or encode_joints(message) != data:
        return  # another writer's padding; such messages are read field by field
    numbers = _joint_numbers(counts)
    if len(_joint_layouts) >= _MOST_LAYOUTS:
        _joint_layouts.clear()
    fixed = data[_STAMPED : len(data) - numbers.size]
    _joint_layouts[len(data)] = _JointLayout(
        fixed, numbers, counts, message.names, message.frame_id
    )


def decode_string(data: bytes) -> str:
    """The text of a `std_msgs/msg/String`. Raises WireError."""
    return Reader(data).string()


def decode_bool(data: bytes) -> bool:
    """The value of a `std_msgs/msg/Bool`. Raises WireError."""
    reader = Reader(data)
    (value,) = reader.unpack(_BOOL, 1)
    reader.end()
    if value > 1:
        raise WireError(f"a bool of {value}; 0 or 1 needed")
    return bool(value)


def decode_closure(data: bytes) -> float:
    """The position, 0 (open) to 1 (closed), of the joint `gripper` in the CDR bytes of a
    JointState. Raises WireError.
    """
    (closure,), _ = in_order(decode_joints(data), (GRIPPER,))
    if not 0.0 <= closure <= 1.0:
        raise WireError(f"{GRIPPER} at {closure:g}; 0 (open) to 1 (closed) needed")
    return closure


def bytes_of_frame(frame: str) -> bytes:
    """The name of a frame as a TFMessage has it, with a zero byte at its end; a slash may precede
    it.
    """
    return frame.encode() + b"\0"


@functools.cache
def _spellings(frames: tuple[str, ...]) -> frozenset[bytes]:
    return frozenset(slash + bytes_of_frame(frame) for frame in frames for slash in (b"", b"/"))


def decode_transforms(
    data: bytes,
    frames: tuple[str, ...] = (),
    *,
    longest: int = LONGEST_TRANSFORMS,
    rejected: list[str] | None = None,
) -> list[tuple[str, PoseStamped]]:
    """The child frames in the CDR bytes of a TFMessage, each with its pose in its parent; with
    `frames` only these. Names have no leading slash.

    Raises WireError; mistakes of single transforms are appended to `rejected` instead, if given.
    """
    reader = Reader(data, longest)
    spellings = _spellings(frames)
    transforms = []
    for _ in range(reader.items()):
        stamp, parent, child, pose = reader.transform()
        if frames and child not in spellings:
            continue
        try:
            frame, name = (_text(raw).lstrip("/") for raw in (parent, child))
            transforms.append((name, PoseStamped(_stamp_ns(*stamp), frame, pose[:3], pose[3:])))
        except WireError as error:
            if rejected is None:
                raise
            rejected.append(str(error))
    reader.end()
    return transforms


def decode_tick(data: bytes) -> tuple[int, bytes, int, int | None]:
    """Index, numbers of the event kinds, count of lost ticks and checksum of the frame in the CDR
    bytes of a Tick, which has no checksum (None), or of a CheckedTick.

    Raises WireError.
    """
    if len(data) < 20 or data[:4] != CDR_HEADER:
        raise WireError(f"a Tick of {len(data)} bytes")
    index, lost, count = _TICK.unpack_from(data, 4)
    if len(data) - 20 < count:
        raise WireError(f"a Tick with {count} events in {len(data)} bytes")
    offset = 20 + count + -count % 4
    is_checked = len(data) >= offset + _LENGTH.size
    return (
        index,
        data[20 : 20 + count],
        lost,
        _LENGTH.unpack_from(data, offset)[0] if is_checked else None,
    )


def decode_skill(data: bytes) -> bytes:
    """The skill file's bytes in the CDR bytes of a Skill. Raises WireError."""
    if len(data) < 8 or data[:4] != CDR_HEADER or _LENGTH.unpack_from(data, 4)[0] > len(data) - 8:
        raise WireError(f"a Skill of {len(data)} bytes")
    return data[8 : 8 + _LENGTH.unpack_from(data, 4)[0]]


def decode_record(data: bytes, size: int) -> bytes:
    """The `size` bytes of a record of fixed layout. Raises WireError."""
    if len(data) != 4 + size or data[:4] != CDR_HEADER:
        raise WireError(
            f"{len(data)} bytes, {4 + size} of little-endian CDR needed: was it made by another "
            "version?"
        )
    return data[4:]


def encode_attachment(value: Attachment) -> bytes:
    """24 bytes, little endian."""
    return _ATTACHMENT.pack(*value)


def decode_attachment(data: bytes) -> Attachment:
    """The attachment in 24 bytes. Raises WireError."""
    if len(data) != _ATTACHMENT.size:
        raise WireError(f"an attachment of {len(data)} bytes, {_ATTACHMENT.size} needed")
    return Attachment(*_ATTACHMENT.unpack(data))
