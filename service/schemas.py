"""What our MCAP files are made of: `ros2msg` schemas, the encodings of Tick, Skill and TFMessage, the arm's link frames, and the files themselves.

The definitions are the public ROS 2 ones reduced to their fields; those of Frame, Timing and State follow the layouts in `frame`.
"""

from __future__ import annotations

import contextlib
import math
import platform
import struct
from collections.abc import Iterator, Sequence
from importlib import metadata as packages
from pathlib import Path
from typing import IO, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from service import frame
from service.config import ExplainedError
from service.wire import CDR_HEADER, JOINT_NAMES, JOINTS, POSE, POSE_COV, Quaternion, Vector3, WireError

STRING, TF = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
TICK, FRAME, TIMING, STATE, SKILL = (f"thirdhand/msg/{name}" for name in ("Tick", "Frame", "Timing", "State", "Skill"))

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/String": "string data\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    "sensor_msgs/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "thirdhand/Tick": "int64 index\nuint32 lost\nuint8[] events\n",
    "thirdhand/Frame": frame.definition(frame.FRAME),
    "thirdhand/Timing": frame.definition(frame.TIMING),
    "thirdhand/State": frame.definition(frame.STATE),
    "thirdhand/Skill": "uint8[] data\n",
}


def schema(message_type: str) -> str:
    """The `ros2msg` schema of a message type like `geometry_msgs/msg/PoseStamped`, with all that it depends on."""
    name = message_type.replace("/msg/", "/")
    text, told, waiting = _DEFINITIONS[name], {name}, [name]
    while waiting:
        for line in _DEFINITIONS[waiting.pop(0)].splitlines():
            needed = line.split()[0].removesuffix("[]")
            if needed in _DEFINITIONS and needed not in told:
                told.add(needed)
                waiting.append(needed)
                text += f"{'=' * 80}\nMSG: {needed}\n{_DEFINITIONS[needed]}"
    return text


TYPES = (POSE, POSE_COV, JOINTS, STRING, TF, TICK, FRAME, TIMING, STATE, SKILL)

# --- Tick and Skill ---------------------------------------------------------------------------------------------------------

_TICK = struct.Struct("<qII")
_LENGTH = struct.Struct("<I")


def encode_tick(index: int, events: Sequence[int], lost: int) -> bytes:
    """CDR bytes of a Tick: its index, how many before it were lost, its events' kinds as places in EVENT_KINDS in inbox order."""
    return CDR_HEADER + _TICK.pack(index, lost, len(events)) + bytes(events)


def decode_tick(data: bytes) -> tuple[int, bytes, int]:
    """Index, event kinds and number of lost ticks in the CDR bytes of a Tick. Raises WireError."""
    if len(data) < 20 or data[:4] != CDR_HEADER:
        raise WireError(f"a Tick of {len(data)} bytes")
    index, lost, count = _TICK.unpack_from(data, 4)
    if len(data) - 20 < count or max(data[20 : 20 + count], default=0) >= len(frame.EVENT_KINDS):
        raise WireError(f"a Tick with {count} events in {len(data)} bytes, of kinds {list(data[20:36])}")
    return index, data[20 : 20 + count], lost


def encode_skill(data: bytes) -> bytes:
    """CDR bytes of a Skill: the bytes of its file."""
    return CDR_HEADER + _LENGTH.pack(len(data)) + data


def decode_skill(data: bytes) -> bytes:
    """The skill file's bytes in the CDR bytes of a Skill. Raises WireError."""
    if len(data) < 8 or data[:4] != CDR_HEADER or _LENGTH.unpack_from(data, 4)[0] > len(data) - 8:
        raise WireError(f"a Skill of {len(data)} bytes")
    return data[8 : 8 + _LENGTH.unpack_from(data, 4)[0]]


# --- transforms -------------------------------------------------------------------------------------------------------------


class Transform(NamedTuple):
    """Where a frame is in its parent: translation [m], rotation x y z w."""

    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion


_POSE = struct.Struct("<7d")
_STAMP = struct.Struct("<iI")


def encode_transforms(stamp_ns: int, transforms: Sequence[Transform]) -> bytes:
    """CDR bytes of a TFMessage."""
    out = bytearray(CDR_HEADER + _LENGTH.pack(len(transforms)))
    stamp = _STAMP.pack(*divmod(stamp_ns, 1_000_000_000))
    for item in transforms:
        out += bytes(-len(out) % 4) + stamp
        for text in (item.parent, item.child):
            raw = text.encode() + b"\0"
            out += bytes(-len(out) % 4) + _LENGTH.pack(len(raw)) + raw
        out += bytes(-(len(out) - 4) % 8) + _POSE.pack(*item.translation, *item.rotation)
    return bytes(out)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b followed by the rotation a; x y z w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def about(axis: Sequence[float], angle: float) -> Quaternion:
    """The rotation by `angle` [rad] about a unit axis; x y z w."""
    half = math.sin(angle / 2)
    return (axis[0] * half, axis[1] * half, axis[2] * half, math.cos(angle / 2))


class _Joint(NamedTuple):
    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion
    axis: Vector3
    place: int  # in chain order; -1: fixed


def _three(element: ElementTree.Element | None, name: str, default: str) -> Vector3:
    text = default if element is None else element.get(name, default)
    x, y, z = (float(number) for number in text.split())
    return x, y, z


class ArmFrames:
    """The link frames of the arm that a URDF describes."""

    def __init__(self, urdf: str) -> None:
        self._joints: list[_Joint] = []
        for joint in ElementTree.fromstring(urdf).iter("joint"):
            name, parent, child = joint.get("name", ""), joint.find("parent"), joint.find("child")
            if parent is None or child is None:
                continue
            origin = joint.find("origin")
            roll, pitch, yaw = _three(origin, "rpy", "0 0 0")
            rotation = multiply(about((0, 0, 1), yaw), multiply(about((0, 1, 0), pitch), about((1, 0, 0), roll)))
            x, y, z = _three(joint.find("axis"), "xyz", "1 0 0")
            norm = math.sqrt(x * x + y * y + z * z)
            place = JOINT_NAMES.index(name) if name in JOINT_NAMES else -1
            at = _three(origin, "xyz", "0 0 0")
            self._joints.append(_Joint(parent.get("link", ""), child.get("link", ""), at, rotation, (x / norm, y / norm, z / norm), place))
        self.links = tuple(joint.child for joint in self._joints)

    def transforms(self, joints: Sequence[float]) -> list[Transform]:
        """Each link in its parent link, for joint positions in chain order (7,) [rad]."""
        return [
            Transform(j.parent, j.child, j.translation, j.rotation if j.place < 0 else multiply(j.rotation, about(j.axis, joints[j.place])))
            for j in self._joints
        ]


# --- MCAP files -------------------------------------------------------------------------------------------------------------

CHUNK_BYTES = 128 * 1024  # what a kill can lose between two flushes, and what a reader must hold
_CUT = (McapError, zstandard.ZstdError, struct.error, UnicodeDecodeError, ValueError, KeyError, IndexError, OverflowError, MemoryError)


class RecordingError(ExplainedError, ValueError):
    """A file that is not the recording it should be: says which, why, and what would do."""


def machine() -> dict[str, str]:
    """What the result of a tick may depend on besides its input: versions, CPU, BLAS."""
    found = {"python": platform.python_version(), "system": platform.platform(), "cpu": platform.processor() or platform.machine()}
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        found["cpu"] = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), found["cpu"])
    build: Any = np.show_config(mode="dicts")
    blas = build["Build Dependencies"]["blas"]
    found["blas"] = f"{blas['name']} {blas['version']}"
    for name in ("thirdhand", "numpy", "scipy", "pin", "ruckig", "msgspec", "mcap", "eclipse-zenoh"):
        with contextlib.suppress(packages.PackageNotFoundError):
            found[name] = packages.version(name)
    return found


class McapFile:
    """An MCAP file being written: profile `ros2`, zstd, small chunks, channels made as they are needed."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._stream: IO[bytes] = path.open("wb")
        self.writer = Writer(self._stream, chunk_size=CHUNK_BYTES)
        self.writer.start(profile="ros2", library="thirdhand")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def put(self, topic: str, kind: str, data: bytes, time_ns: int, sequence: int, *, qos: str = "") -> None:
        """Writes one CDR message of the type `kind`."""
        channel = self._channels.get(topic)
        if channel is None:
            if kind not in self._schemas:
                self._schemas[kind] = self.writer.register_schema(kind, "ros2msg", schema(kind).encode())
            channel = self.writer.register_channel(topic, "cdr", self._schemas[kind], {"offered_qos_profiles": qos})
            self._channels[topic] = channel
        self.writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)

    def flush(self) -> None:
        """Ends the chunk in progress: what was written so far survives a kill of the process."""
        self.writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Ends the file; it is closed even if its end cannot be written."""
        if not self._stream.closed:
            try:
                self.writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self._stream.close()


def existing(path: str | Path) -> Path:
    """The path of a recording that is there. Raises RecordingError with the names of those that are."""
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is a folder, a recording needed")
    if not path.is_file():
        there = sorted(found.name for found in path.parent.glob("*.mcap"))
        names = f" There are: {', '.join(there)}." if there else ""
        raise RecordingError(f"no recording {path}.{names}")
    with path.open("rb") as stream:
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"{path} is not an MCAP file")
    return path


def ends_early(path: Path) -> bool:
    """Whether an MCAP file was cut: its closing bytes are missing."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MCAP0_MAGIC)))
        return stream.read() != MCAP0_MAGIC or size < 2 * len(MCAP0_MAGIC)


class Messages:
    """The schema, channel and message of every message of an MCAP file in file order, up to the end or the cut; `.cut` tells which it was."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.cut = ""
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def __iter__(self) -> Iterator[tuple[Schema | None, Channel, Message]]:
        found: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self._path.open("rb") as stream:
            records = iter(StreamReader(stream, record_size_limit=self._path.stat().st_size, validate_crcs=True).records)
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except _CUT as error:
                    self.cut = f"{type(error).__name__} {error}".strip()
                    return
                if isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    yield found.get(channel.schema_id), channel, record
                elif isinstance(record, Schema):
                    found[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data
                elif isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                elif isinstance(record, DataEnd):
                    return


def next_whole(messages: Iterator[tuple[Schema | None, Channel, Message]], path: Path) -> tuple[Schema | None, Channel, Message] | None:
    """The next message of an indexed file, None at its end. Raises RecordingError where the file is damaged."""
    try:
        return next(messages, None)
    except _CUT as error:
        raise RecordingError(f"{path} is damaged: {type(error).__name__} {error}".strip()) from None


class PoseStreams:
    """Which topics of a file are the wanted streams of poses; one topic each, whatever the cell."""

    def __init__(self, path: Path, names: tuple[str, ...]) -> None:
        self._path, self._names = path, names
        self._found: dict[str, str] = {}
        self._seen: set[str] = set()

    def name(self, schema: Any, channel: Any) -> str:
        """The stream that a message belongs to; empty: none of them."""
        topic = channel.topic
        self._seen.add(topic)
        name = next((name for name in self._names if f"/{topic}".endswith(f"/{name}")), "")
        if not name or schema is None or schema.name.replace("/msg/", "/") != POSE.replace("/msg/", "/") or channel.message_encoding != "cdr":
            return ""
        if self._found.setdefault(name, topic) != topic:
            raise RecordingError(f"{self._path} has two streams of {name}: {self._found[name]} and {topic}")
        return name

    def missing(self, name: str) -> RecordingError:
        """The error that says that a stream is not there, and what is."""
        topics = ", ".join(sorted(self._seen)) or "none"
        return RecordingError(f"{self._path} has no topic ending in {name} with {POSE}; its topics: {topics}")
