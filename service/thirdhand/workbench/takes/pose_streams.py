"""Streams of poses in recordings of this and other systems: MCAP files, bag folders, `.db3`,
`.bag`, and motion capture files.
"""

from __future__ import annotations

import contextlib
import functools
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_args

import msgspec
import numpy as np
import zstandard
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from thirdhand.contract import cdr
from thirdhand.contract.channels import (
    JOINTS,
    POSE,
    POSE_WITH_COVARIANCE,
    STRING,
    TAKE_KEYS,
    TRANSFORMS,
)
from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.contract.joint_states import JointStates, measured
from thirdhand.contract.messages import BASE, JointState, PoseStamped, WireError
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.printable import printable
from thirdhand.contract.requests import Add, Hands, ViaPoint, decode_request
from thirdhand.core.frame import Vector
from thirdhand.core.intake.stage import UNIT_M
from thirdhand.recordings.mcap_file import RecordingError, begin_of, existing
from thirdhand.recordings.mcap_reader import FileFault, Messages, full_name
from thirdhand.settings.config import Settings
from thirdhand.workbench.takes.motion_capture import CAPTURE_FRAME, Captured, read_c3d, read_motive
from thirdhand.workbench.takes.tool_poses import tool_poses
from thirdhand.workbench.takes.track import Track, clock_parts

Value = TypeVar("Value")
StampedJoints = tuple[int, int, tuple[float, ...]]
"""Time of recording [ns], stamp [ns] and positions of a joint state."""
TRACK_NAMES = ("left", "right", "tool")
JOINT_STATES = "joints/state"
GRIPPER_STATE = "gripper/state"
VIA_POINTS_TOPIC = "via_points"
BEGIN_TOPIC = "begin"
STATE_PARTS_TIMEOUT_S = 0.1  # an arm's state may arrive in several messages within this time
FROM_ARRAYS = "A few lines of Python make a take from arrays: docs/arrays.md"
NOT_READ = {
    **dict.fromkeys(
        (".zst", ".zstd", ".lz4", ".gz", ".zip"),
        "decompress it first, or give the folder of the bag",
    ),
    **dict.fromkeys(
        (
            ".parquet",
            ".npz",
            ".npy",
            ".h5",
            ".hdf5",
            ".json",
            ".txt",
            ".tsv",
            ".trc",
            ".bvh",
            ".fbx",
            ".tak",
        ),
        FROM_ARRAYS,
    ),
}
MAX_MESSAGE_BYTES = 1 << 24  # limit of a message after decompression
POSE_ARRAY = "geometry_msgs/msg/PoseArray"
TF_MESSAGE = TRANSFORMS.type
TRANSFORM = "geometry_msgs/msg/TransformStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_TYPES = (POSE.type, POSE_WITH_COVARIANCE.type, TRANSFORM, POSE_ARRAY, TF_MESSAGE, ODOMETRY)
# covariances, and a velocity
# accepted types of topics by the ends of their names
ACCEPTED_TYPES = {
    **dict.fromkeys(TAKE_KEYS.values(), POSE_TYPES),
    JOINT_STATES: (JOINTS.type,),
    GRIPPER_STATE: (JOINTS.type,),
    VIA_POINTS_TOPIC: (STRING.type,),
}
NUMBERS_AFTER = {
    POSE_WITH_COVARIANCE.type: 36,
    ODOMETRY: 36 + 6 + 36,
}
_NUMBERS = {count: struct.Struct(f"<{count}d") for count in (7, *NUMBERS_AFTER.values())}


class PoseTopic(NamedTuple):
    """A topic with poses; `part` is the index in a PoseArray or the child frame in a TFMessage, and
    empty for other types.
    """

    topic: str
    part: str = ""

    @classmethod
    def parsed(cls, text: str) -> PoseTopic:
        """The topic in a text `TOPIC` or `TOPIC:PART`."""
        topic, _, part = text.partition(":")
        return cls(topic, part)

    def __str__(self) -> str:
        return printable(f"{self.topic}:{self.part}" if self.part else self.topic)


class Parts(NamedTuple):
    """The poses of one part of a topic: stamps [ns], times of recording [ns], poses, and all frames
    of them.
    """

    stamps: list[int]
    logged: list[int]
    poses: list[tuple[float, ...]]
    frames: list[str]


class PoseRecording:
    """The messages of a recording from which poses can be computed, by topic."""

    def __init__(self, path: str | Path) -> None:
        """Read an MCAP file, a bag's folder, `.db3`, `.bag`, CSV of Motive or C3D.

        Raises RecordingError.
        """
        self.path = Path(path)
        self.topics: dict[str, str] = {}  # type of each topic
        self.faults: list[FileFault] = []
        self.settings: Settings | None = None  # settings of the recording, if thirdhand made it
        self.urdf = ""
        self.is_ours = False  # True if settings are attached
        self.unused: list[str] = []  # remarks on content that cannot be used
        self.via_points: tuple[ViaPoint, ...] = ()  # recorded via-points of the task
        self.conducts: Hands = "both"  # the hands that lead the tool in a take
        self.person = ""  # the person who demonstrates in a take
        self.begun_ns: list[int] = []  # when requests began the task
        self._raw: dict[
            str, list[tuple[int, bytes]]
        ] = {}  # time of recording [ns] and bytes of messages by topic
        self._read: dict[str, dict[str, Parts]] = {}
        self._ros_1_topics: set[str] = set()
        # True for motion capture: poses are in metres, in the axes of the capture system
        self.is_captured = False
        if reader := {".csv": read_motive, ".c3d": read_c3d}.get(self.path.suffix.lower()):
            self._read_captured(reader(self._existing()))
        elif self.path.is_dir() or self.path.suffix in (".db3", ".bag"):
            self._read_bag()
        elif instead := NOT_READ.get(self.path.suffix.lower()):
            raise RecordingError(f"{self._existing()} has a format that is not read: {instead}")
        else:
            self._read_mcap()
        other_types = (other_type(self.topics, key, kinds) for key, kinds in ACCEPTED_TYPES.items())
        self.unused += filter(None, other_types)

    def _existing(self) -> Path:
        if not self.path.is_file():
            raise RecordingError(f"there is no file {self.path}")
        begin_of(self.path)
        return self.path

    def _read_captured(self, captured: Captured) -> None:
        self.is_captured = True
        for name, (stamps, poses) in captured.items():
            topic, part = PoseTopic.parsed(name)
            self.topics[topic] = POSE.type
            rows = [tuple(row) for row in poses.tolist()]
            self._read.setdefault(topic, {})[part] = Parts(stamps, stamps, rows, [CAPTURE_FRAME])

    def _read_mcap(self) -> None:
        messages = Messages(existing(self.path))
        for schema, channel, message in messages:
            kind = full_name(schema)
            self.topics.setdefault(channel.topic, type_of(schema, channel, ("cdr", "ros1")))
            if self.topics[channel.topic] in (*POSE_TYPES, JOINTS.type):
                if channel.message_encoding == "ros1":
                    self._ros_1_topics.add(channel.topic)
                self._raw.setdefault(channel.topic, []).append((message.log_time, message.data))
            elif kind == STRING.type and f"/{channel.topic}".endswith(f"/{VIA_POINTS_TOPIC}"):
                self._read_via_points(message.data)
            elif kind == STRING.type and f"/{channel.topic}".endswith(f"/{BEGIN_TOPIC}"):
                self.begun_ns.append(message.log_time)
        self.faults = messages.faults
        about = messages.metadata.get("thirdhand", {})
        self.conducts = next(
            (hands for hands in get_args(Hands) if hands == about.get("hands")), "both"
        )
        self.person = about.get("person", "")
        if "settings.json" in messages.attachments:
            self.is_ours = True
            try:
                self.settings = validated(
                    msgspec.json.decode(messages.attachments["settings.json"]), Settings
                )
            except (msgspec.DecodeError, InvalidError) as error:
                self.unused.append(
                    f"the settings in {self.path} are not valid: {in_words(error, named=False)}"
                )
            self.urdf = messages.attachments.get("arm.urdf", b"").decode(errors="replace")

    def _read_via_points(self, data: bytes) -> None:
        try:
            self.via_points = Add(
                decode_request(cdr.decode_string(_whole(data)).encode(), tuple[ViaPoint, ...])
            ).points
        except (WireError, ValueError) as error:
            self.unused.append(f"the recorded via-points are not readable and not used: {error}")

    def _read_bag(self) -> None:
        # its import is slow, and most recordings are MCAP files
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader

        self._check_folder()
        has_metadata = (self.path / "metadata.yaml").exists()
        files = [self._existing()] if not self.path.is_dir() else sorted(self.path.glob("*.db3"))
        for file in (*files, *self.path.glob("*.mcap")):
            begin_of(file)
        is_killed = any(Path(f"{file}-wal").exists() for file in files)
        is_ros_1 = self.path.suffix == ".bag"
        is_database = files and not is_ros_1 and (is_killed or not has_metadata)
        try:
            if is_database:
                for file in files:
                    self._read_sqlite(file)
                return
            with (Ros1Reader if is_ros_1 else Ros2Reader)(self.path) as bag:
                self._read_messages(bag)
            self._ros_1_topics = set(self.topics) if is_ros_1 else set()
        except Exception as error:  # the exceptions of the bags' storages have no common base
            raise RecordingError(f"{self.path} is not a bag that can be read: {error}.") from None

    def _check_folder(self) -> None:
        """Raise RecordingError for a folder that is no bag."""
        if (self.path / "meta" / "info.json").exists():
            raise RecordingError(
                f"{self.path} is a data set of LeRobot, whose columns do not name hands and tool. "
                f"{FROM_ARRAYS}"
            )
        has_metadata = (self.path / "metadata.yaml").exists()
        if self.path.is_dir() and not has_metadata and any(self.path.glob("*.mcap")):
            raise RecordingError(
                f"{self.path} is a folder without metadata.yaml: give its files, {self.path}/*.mcap"
            )

    def _read_messages(self, bag: Any) -> None:
        """Read the topics of an open bag, and the messages of poses and joints."""
        self.topics = {connection.topic: connection.msgtype for connection in bag.connections}
        connections = [
            connection
            for connection in bag.connections
            if connection.msgtype in (*POSE_TYPES, JOINTS.type)
        ]
        for connection, logged_ns, data in (
            bag.messages(connections=connections) if connections else ()
        ):
            self._raw.setdefault(connection.topic, []).append((logged_ns, bytes(data)))

    def _read_sqlite(self, file: Path) -> None:
        """Read a `.db3`, and messages that a killed recorder has left in its `-wal`."""
        with contextlib.closing(
            sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)
        ) as database:
            kinds = dict(
                database.execute("SELECT name, type FROM topics WHERE serialization_format = 'cdr'")
            )
            self.topics |= kinds
            for topic, logged_ns, data in database.execute(
                "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id "
                "ORDER BY timestamp"
            ):
                if kinds.get(topic) in (*POSE_TYPES, JOINTS.type):
                    self._raw.setdefault(topic, []).append((logged_ns, bytes(data)))

    def _decoded(self, topic: str, decode: Callable[[bytes], Value]) -> Iterator[tuple[int, Value]]:
        """Time of recording [ns] and value of each message of a topic.

        Messages of which `decode` raises WireError are left out, with a remark on their number and
        the first cause. Raises RecordingError if no message is left.
        """
        raw = self._raw.get(topic, ())
        causes: list[str] = []
        for logged_ns, data in raw:
            try:
                whole = _whole(data)
                value = decode(
                    _of_ros_1(whole, self.topics[topic]) if topic in self._ros_1_topics else whole
                )
            except WireError as error:
                causes.append(str(Refusal(str(error), self.topics[topic], data)))
            else:
                yield logged_ns, value
        if not causes:
            return
        remark = f"{topic}: {len(causes)} of {len(raw)} messages are not readable: {causes[0]}"
        if len(causes) == len(raw):
            raise RecordingError(f"{self.path}: {remark}")
        if remark not in self.unused:
            self.unused.append(remark)

    def tracks(self, topic: str) -> dict[str, Parts]:
        """The streams of poses in a topic by part. Raises RecordingError."""
        if topic in self._read:
            return self._read[topic]
        out = dict[str, Parts]()
        rejected: list[str] = []
        for logged_ns, pairs in self._decoded(
            topic, functools.partial(_poses, self.topics[topic], rejected)
        ):
            for part, pose in pairs:
                stamps, logged, poses, frames = out.setdefault(part, Parts([], [], [], []))
                if pose.frame_id not in frames:
                    frames.append(pose.frame_id)
                stamps.append(pose.stamp_ns or logged_ns)
                logged.append(logged_ns)
                poses.append(pose.position + pose.orientation)
        if rejected:
            self.unused.append(
                f"{topic}: {len(rejected)} transforms are not readable: {rejected[0]}"
            )
        self._read[topic] = out
        return out

    def track(self, name: str, source: PoseTopic, settings: Settings) -> Track:
        """One stream as arrays. Raises RecordingError."""
        stamps, logged, rows, (frame, *others) = self.tracks(source.topic)[source.part]
        if others:
            raise RecordingError(
                f"{self.path}: {source}: poses in frames {frame!r} and {others[0]!r}; one needed"
            )
        poses = np.array(rows, np.float64)
        # `from_tracker` will multiply by the unit and apply the pose of the capture system
        if self.is_captured:
            poses[:, :3] /= UNIT_M[settings.hands.unit]
            frame = frame if settings.hands.frame in ("", BASE) else settings.hands.frame
        return Track(
            name, str(source), np.array(stamps, np.int64), np.array(logged, np.int64), poses, frame
        )

    def tool_by_joints(self, topic: str, settings: Settings, urdf: str) -> Track:
        """The tool in frame `base`, computed from joint states by the URDF. Raises
        RecordingError.
        """
        states = [
            state
            for state in self._joint_states(topic, settings.joints.names)
            if np.isfinite(state[2]).all()
        ]
        if not states:
            raise RecordingError(f"{self.path}: {topic}: no joint state is finite")
        logged, stamps, joints = zip(*states, strict=True)
        poses, rows = tool_poses(settings, urdf, np.array(stamps, np.int64), np.array(joints))
        source = f"{topic}, by the URDF"
        return Track(
            TAKE_KEYS["tool"], source, np.array(stamps)[rows], np.array(logged)[rows], poses, BASE
        )

    def closures(
        self, stamps: NDArray[np.int64], *, logged: bool = False, part: int | None = None
    ) -> Vector | None:
        """Closure of the gripper (T,), 0 open to 1 closed, at stamps (T,) [ns]; None if no topic
        ends in `gripper/state`. The closure is the position of the first joint there.

        If `logged`, the stamps are times of recording. `part` selects one part of the messages, if
        their clock restarts. Raises RecordingError.
        """
        topics = [topic for topic in self._raw if f"/{topic}".endswith(f"/{GRIPPER_STATE}")]
        if len(topics) > 1:
            self.unused.append(
                f"topics {', '.join(sorted(topics))} are not used: one topic of a gripper needed"
            )
            return None
        states = list(self._joint_states(topics[0])) if topics else []
        if part is not None:
            states = _part_of(states, part)
        closure_at = {
            logged_ns if logged else stamp_ns: position[0]
            for logged_ns, stamp_ns, position in states
            if position and np.isfinite(position[0])
        }
        if len(closure_at) < len(states):
            self.unused.append(
                f"{len(states) - len(closure_at)} of {len(states)} states of the gripper have no "
                "position"
            )
        return _interpolated(closure_at, stamps) if closure_at else None

    def _joint_states(self, topic: str, names: tuple[str, ...] = ()) -> Iterator[StampedJoints]:
        """Each joint state of a topic.

        With `names`, these joints only, which may be spread over several messages. Raises
        RecordingError.
        """
        states = JointStates(names, STATE_PARTS_TIMEOUT_S)
        is_found = False

        def decode(data: bytes) -> JointState:
            message = cdr.decode_joints(data)
            if len(message.position) == len(message.names):
                measured(message, tuple(name for name in names if name in message.names))
            return message

        for logged_ns, message in self._decoded(topic, decode):
            state = states.take(message, logged_ns / 1e9) if names else message
            if state is not None:
                is_found = True
                position = measured(state, names)[0] if names else state.position
                yield logged_ns, state.stamp_ns or logged_ns, position
        if names and not is_found:
            raise RecordingError(f"{self.path}: {topic}: no state of all joints {', '.join(names)}")

    def joint_topic(self, settings: Settings) -> str:
        """The topic with joint states of the arm's joints; empty if there are none or several."""
        topics = []
        for topic in self._raw:
            if self.topics[topic] == JOINTS.type:
                with contextlib.suppress(RecordingError):
                    next(self._joint_states(topic, settings.joints.names))
                    topics.append(topic)
        exact = [topic for topic in topics if f"/{topic}".endswith(f"/{JOINT_STATES}")]
        chosen = exact if len(exact) == 1 else topics
        return chosen[0] if len(chosen) == 1 else ""

    def streams(self) -> Iterator[tuple[PoseTopic, int]]:
        """Every readable stream of poses, and its number of poses."""
        for topic in sorted(self.topics):
            if self.topics[topic] in POSE_TYPES:
                with contextlib.suppress(RecordingError):  # other topics may be readable
                    for part, (stamps, *_) in self.tracks(topic).items():
                        yield PoseTopic(topic, part), len(stamps)


def _part_of(states: Sequence[StampedJoints], part: int) -> list[StampedJoints]:
    """The states in one part of their messages, whose clock restarts, or else in the last part."""
    parts = clock_parts(np.array([stamp_ns for _, stamp_ns, _ in states], np.int64))
    return [states[i] for i in parts[min(part, len(parts) - 1)]]


def _interpolated(closure_at: Mapping[int, float], stamps: NDArray[np.int64]) -> Vector:
    """The closure (T,) at stamps (T,) [ns], read-only, from those at some stamps."""
    state_ns = np.array(sorted(closure_at), np.int64)
    times = (
        (stamps - state_ns[0]).astype(np.float64),
        (state_ns - state_ns[0]).astype(np.float64),
    )
    out: Vector = np.interp(*times, [closure_at[i] for i in state_ns.tolist()])
    out.setflags(write=False)
    return out


def type_of(schema: Schema | None, channel: Channel, read: Sequence[str] = ("cdr",)) -> str:
    """The type of a channel's messages, with their encoding unless that is `read`."""
    kind = full_name(schema)
    return kind if channel.message_encoding in read else f"{kind} in {channel.message_encoding}"


def other_type(topics: Mapping[str, str], key: str, accepted: Sequence[str]) -> str:
    """A remark on the topics that end in a key and have none of the accepted types, given the type
    of each topic; empty if there are none.
    """
    others = {
        topic: kind
        for topic, kind in topics.items()
        if f"/{topic}".endswith(f"/{key}") and kind not in accepted
    }
    return f"not used: {with_types(others)}; {', '.join(accepted)} accepted" if others else ""


def with_types(topics: Mapping[str, str]) -> str:
    """The topics of a recording in words, each with its type."""
    return (
        ", ".join(f"{topic} ({topics[topic] or 'no type'})" for topic in sorted(topics)) or "none"
    )


def _whole(data: bytes) -> bytes:
    """The bytes of a message, decompressed if it was compressed on its own. Raises WireError."""
    if not data.startswith(zstandard.FRAME_HEADER):
        return data
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            content: bytes = stream.read(MAX_MESSAGE_BYTES + 1)
    except zstandard.ZstdError as error:
        raise WireError(f"it cannot be decompressed: {error}") from None
    if len(content) > MAX_MESSAGE_BYTES:
        raise WireError(f"it has more than {MAX_MESSAGE_BYTES} bytes after decompression")
    return content


@functools.cache
def _typestore() -> Any:
    # its import is slow, and few recordings need it
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _of_ros_1(data: bytes, kind: str) -> bytes:
    """The CDR bytes of a message of ROS 1. Raises WireError."""
    try:
        return bytes(_typestore().ros1_to_cdr(data, kind))
    except Exception as error:  # the library raises many kinds of exceptions
        raise WireError(f"a {kind} of ROS 1 that is not readable: {error}") from None


def _poses(kind: str, rejected: list[str], data: bytes) -> list[tuple[str, PoseStamped]]:
    """Part and pose of each pose in the CDR bytes of a message of POSE_TYPES. Mistakes of single
    transforms are appended to `rejected`. Raises WireError.
    """
    if kind == TF_MESSAGE:
        return cdr.decode_transforms(data, longest=MAX_MESSAGE_BYTES, rejected=rejected)
    reader = cdr.Reader(data)
    stamp_ns, frame = reader.header()
    child = reader.string() if kind in (TRANSFORM, ODOMETRY) else ""
    parts = (
        list(map(str, range(reader.items())))
        if kind == POSE_ARRAY
        else [child if kind == TRANSFORM else ""]
    )
    rows = [reader.unpack(_NUMBERS[7], 8) for _ in parts]
    if kind in NUMBERS_AFTER:
        reader.unpack(_NUMBERS[NUMBERS_AFTER[kind]], 8)
    reader.end()
    frame = frame if kind == POSE.type else frame.strip("/")
    return [
        (part.strip("/"), PoseStamped(stamp_ns, frame, row[:3], row[3:]))
        for part, row in zip(parts, rows, strict=True)
    ]
