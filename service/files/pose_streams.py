"""Streams of poses in recordings of this and other systems: MCAP files, bag folders, `.db3`,
`.bag`, and motion capture files.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from service.contract import cdr
from service.contract.channels import JOINTS, POSE, STRING
from service.contract.explain import InvalidError, in_words, validated
from service.contract.joint_states import JointStates, measured
from service.contract.messages import BASE, JointState, PoseStamped, WireError
from service.contract.printable import printable
from service.contract.requests import Add, Hands, ViaPoint, decode_request
from service.core.frame import Vector
from service.core.intake.stage import UNIT_M
from service.files.mcap_file import RecordingError, existing
from service.files.mcap_reader import FileFault, Messages, full_name
from service.files.motion_capture import CAPTURE_FRAME, Captured, read_c3d, read_motive
from service.files.tool_poses import tool_poses
from service.files.track import Track, clock_parts
from service.settings.config import Settings

TRACK_NAMES = ("left", "right", "tool")
ENDINGS = {"left": "hands/left", "right": "hands/right", "tool": "tool/pose"}
JOINT_STATES, GRIPPER_STATE, PLACES_TOPIC = "joints/state", "gripper/state", "places"
STATE_PARTS_TIMEOUT_S = 0.1  # an arm's state may arrive in several messages within this time
FROM_ARRAYS = "A few lines of Python make a take from arrays: docs/arrays.md"
NOT_READ = {
    **dict.fromkeys((".zst", ".zstd", ".lz4", ".gz", ".zip"), "decompress it first, or give the folder of the bag"),
    **dict.fromkeys(
        (".parquet", ".npz", ".npy", ".h5", ".hdf5", ".json", ".txt", ".tsv", ".trc", ".bvh", ".fbx", ".tak"),
        FROM_ARRAYS,
    ),
}
MAX_MESSAGE_BYTES = 1 << 24  # limit of a message after decompression
POSE_ARRAY, TF_MESSAGE = "geometry_msgs/msg/PoseArray", "tf2_msgs/msg/TFMessage"
POSE_TYPES = (
    POSE.type,
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    POSE_ARRAY,
    TF_MESSAGE,
)


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


Parts = tuple[list[int], list[int], list[tuple[float, ...]], str]


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
        self.places: tuple[ViaPoint, ...] = ()  # recorded via-points of the task
        self.conducts: Hands = "both"  # the hands that lead the tool in a take
        self.person = ""  # the person who demonstrates in a take
        self._raw: dict[str, list[tuple[int, bytes]]] = {}  # time of recording [ns] and bytes of messages by topic
        self._read: dict[str, dict[str, Parts]] = {}
        self._ros_1_topics: set[str] = set()
        self.is_captured = False  # True for motion capture: poses are in metres, in the axes of the capture system
        if reader := {".csv": read_motive, ".c3d": read_c3d}.get(self.path.suffix.lower()):
            self._read_captured(reader(self._existing()))
        elif self.path.is_dir() or self.path.suffix in (".db3", ".bag"):
            self._read_bag()
        elif instead := NOT_READ.get(self.path.suffix.lower()):
            raise RecordingError(f"{self._existing()} has a format that is not read: {instead}")
        else:
            self._read_mcap()

    def _existing(self) -> Path:
        if not self.path.is_file():
            raise RecordingError(f"there is no file {self.path}")
        return self.path

    def _read_captured(self, captured: Captured) -> None:
        self.is_captured = True
        for name, (stamps, poses) in captured.items():
            topic, part = PoseTopic.parsed(name)
            self.topics[topic] = POSE.type
            rows = [tuple(row) for row in poses.tolist()]
            self._read.setdefault(topic, {})[part] = (stamps, stamps, rows, CAPTURE_FRAME)

    def _read_mcap(self) -> None:
        messages = Messages(existing(self.path))
        for schema, channel, message in messages:
            kind = full_name(schema)
            self.topics.setdefault(channel.topic, kind)
            if channel.message_encoding in ("cdr", "ros1") and kind in (*POSE_TYPES, JOINTS.type):
                if channel.message_encoding == "ros1":
                    self._ros_1_topics.add(channel.topic)
                self._raw.setdefault(channel.topic, []).append((message.log_time, self._whole(message.data)))
            elif kind == STRING.type and f"/{channel.topic}".endswith(f"/{PLACES_TOPIC}"):
                self._read_places(self._whole(message.data))
        self.faults = messages.faults
        about = messages.metadata.get("thirdhand", {})
        self.conducts = next((hands for hands in get_args(Hands) if hands == about.get("hands")), "both")
        self.person = about.get("person", "")
        if "settings.json" in messages.attachments:
            self.is_ours = True
            try:
                self.settings = validated(msgspec.json.decode(messages.attachments["settings.json"]), Settings)
            except (msgspec.DecodeError, InvalidError) as error:
                self.unused.append(f"the settings in {self.path} are not valid: {in_words(error, named=False)}")
            self.urdf = messages.attachments.get("arm.urdf", b"").decode(errors="replace")

    def _whole(self, data: bytes) -> bytes:
        """The bytes of a message, decompressed if it was compressed on its own. Raises
        RecordingError.
        """
        if not data.startswith(zstandard.FRAME_HEADER):
            return data
        try:
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                found: bytes = stream.read(MAX_MESSAGE_BYTES + 1)
        except zstandard.ZstdError as error:
            raise RecordingError(f"{self.path}: a message that cannot be decompressed: {error}") from None
        if len(found) > MAX_MESSAGE_BYTES:
            raise RecordingError(f"{self.path}: a message has more than {MAX_MESSAGE_BYTES} bytes after decompression")
        return found

    def _read_places(self, data: bytes) -> None:
        try:
            self.places = Add(decode_request(cdr.decode_string(data).encode(), tuple[ViaPoint, ...])).points
        except (WireError, ValueError) as error:
            self.unused.append(f"the recorded {PLACES_TOPIC} are not readable and not used: {error}")

    def _read_bag(self) -> None:
        from rosbags.rosbag1 import Reader as Ros1Reader  # its import is slow, and most recordings are MCAP files
        from rosbags.rosbag2 import Reader as Ros2Reader

        if (self.path / "meta" / "info.json").exists():
            raise RecordingError(
                f"{self.path} is a data set of LeRobot, whose columns do not name hands and tool. {FROM_ARRAYS}"
            )
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists() and any(self.path.glob("*.mcap")):
            raise RecordingError(f"{self.path} is a folder without metadata.yaml: give its files, {self.path}/*.mcap")
        try:
            is_ros_1 = self.path.suffix == ".bag"
            with (Ros1Reader if is_ros_1 else Ros2Reader)(self.path) as bag:
                self.topics = {one.topic: one.msgtype for one in bag.connections}
                self._ros_1_topics = set(self.topics) if is_ros_1 else set()
                wanted = [one for one in bag.connections if one.msgtype in (*POSE_TYPES, JOINTS.type)]
                for one, logged_ns, data in bag.messages(connections=wanted) if wanted else ():
                    self._raw.setdefault(one.topic, []).append((logged_ns, bytes(data)))
        except Exception as error:  # the exceptions of the bags' storages have no common base
            missing = "" if self.path.exists() else " It does not exist."
            raise RecordingError(f"{self.path} is not a bag that can be read: {error}.{missing}") from None

    def _decoded(self, topic: str, data: bytes, kind: str) -> Any:
        if topic in self._ros_1_topics:
            return _typestore("ROS1_NOETIC").deserialize_ros1(data, kind)
        return cdr.decode_pose(data) if kind == POSE.type else _typestore("ROS2_HUMBLE").deserialize_cdr(data, kind)

    def tracks(self, topic: str) -> dict[str, Parts]:
        """The streams of poses in a topic by part: stamps, times of recording [ns], poses, frame.

        Raises RecordingError.
        """
        if topic in self._read:
            return self._read[topic]
        kind = self.topics[topic]
        out = self._read[topic] = dict[str, Parts]()
        for logged_ns, data in self._raw.get(topic, ()):
            try:
                parts = _poses(kind, self._decoded(topic, data, kind))
            except Exception as error:  # the deserialiser raises many kinds of exceptions
                raise RecordingError(f"{self.path}: {topic}: a {kind} that is not readable: {error}") from None
            for part, stamp_ns, frame, pose in parts:
                stamps, logged, poses, _ = out.setdefault(part, ([], [], [], frame))
                if frame != out[part][3]:
                    raise RecordingError(
                        f"{self.path}: {PoseTopic(topic, part)}: poses in frames {out[part][3]!r} and {frame!r}"
                    )
                stamps.append(stamp_ns or logged_ns)
                logged.append(logged_ns)
                poses.append(pose)
        return out

    def track(self, name: str, source: PoseTopic, settings: Settings) -> Track:
        """One stream as arrays. Raises RecordingError."""
        stamps, logged, rows, frame = self.tracks(source.topic)[source.part]
        poses = np.array(rows, np.float64)
        if self.is_captured:  # `from_tracker` will multiply by the unit and apply the pose of the capture system
            poses[:, :3] /= UNIT_M[settings.hands.unit]
            frame = frame if settings.hands.frame in ("", BASE) else settings.hands.frame
        return Track(name, str(source), np.array(stamps, np.int64), np.array(logged, np.int64), poses, frame)

    def tool_by_joints(self, topic: str, settings: Settings, urdf: str) -> Track:
        """The tool in frame `base`, computed from joint states by the URDF. Raises
        RecordingError.
        """
        states = [one for one in self._joint_states(topic, settings.joints.names) if np.isfinite(one[2]).all()]
        if not states:
            raise RecordingError(f"{self.path}: {topic}: no joint state is finite")
        logged, stamps, joints = zip(*states, strict=True)
        poses, kept = tool_poses(settings, urdf, np.array(stamps, np.int64), np.array(joints))
        source = f"{topic}, by the URDF"
        return Track(ENDINGS["tool"], source, np.array(stamps)[kept], np.array(logged)[kept], poses, BASE)

    def closures(self, stamps: NDArray[np.int64], *, logged: bool = False, part: int | None = None) -> Vector | None:
        """Closure of the gripper (T,), 0 open to 1 closed, at stamps (T,) [ns]; None if no topic
        ends in `gripper/state`. The closure is the position of the first joint there.

        If `logged`, the stamps are times of recording. `part` selects one part of the messages, if
        their clock restarts. Raises RecordingError.
        """
        topics = [topic for topic in self._raw if f"/{topic}".endswith(f"/{GRIPPER_STATE}")]
        if len(topics) > 1:
            self.unused.append(f"topics {', '.join(sorted(topics))} are not used: one topic of a gripper needed")
            return None
        states = list(self._joint_states(topics[0])) if topics else []
        if part is not None:
            parts = clock_parts(np.array([stamp_ns for _, stamp_ns, _ in states], np.int64))
            states = [states[i] for i in parts[min(part, len(parts) - 1)]]
        closure_at = {
            logged_ns if logged else stamp_ns: position[0]
            for logged_ns, stamp_ns, position in states
            if position and np.isfinite(position[0])
        }
        if len(closure_at) < len(states):
            self.unused.append(
                f"{len(states) - len(closure_at)} of {len(states)} states of the gripper have no position"
            )
        if not closure_at:
            return None
        at = np.array(sorted(closure_at), np.int64)
        times = (stamps - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        out: Vector = np.interp(*times, [closure_at[i] for i in at.tolist()])
        out.setflags(write=False)
        return out

    def _joint_states(self, topic: str, names: tuple[str, ...] = ()) -> Iterator[tuple[int, int, tuple[float, ...]]]:
        """Time of recording [ns], stamp [ns] and positions of each joint state.

        With `names`, these joints only, which may be spread over several messages. Raises
        RecordingError.
        """
        states, found = JointStates(names, STATE_PARTS_TIMEOUT_S), False
        for logged_ns, data in self._raw[topic]:
            try:
                message = self._joint_state(topic, data)
                state = states.take(message, logged_ns / 1e9) if names else message
            except WireError as error:
                raise RecordingError(f"{self.path}: {topic}: {error}") from None
            if state is not None:
                found = True
                position = measured(state, names)[0] if names else state.position
                yield logged_ns, state.stamp_ns or logged_ns, position
        if names and not found:
            raise RecordingError(f"{self.path}: {topic}: no state of all joints {', '.join(names)}")

    def _joint_state(self, topic: str, data: bytes) -> JointState:
        """The joint state in a message. Raises WireError."""
        if topic not in self._ros_1_topics:
            return cdr.decode_joints(data)
        try:
            found = self._decoded(topic, data, JOINTS.type)
        except Exception as error:  # the deserialiser raises many kinds of exceptions
            raise WireError(f"a {JOINTS.type} that is not readable: {error}") from None
        stamp_ns = found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec
        return JointState(stamp_ns, tuple(found.name), tuple(found.position.tolist()), ())

    def joint_topic(self, settings: Settings) -> str:
        """The topic with joint states of the arm's joints; empty if there are none or several."""
        found = []
        for topic in self._raw:
            if self.topics[topic] == JOINTS.type:
                with contextlib.suppress(RecordingError):
                    next(self._joint_states(topic, settings.joints.names))
                    found.append(topic)
        exact = [topic for topic in found if f"/{topic}".endswith(f"/{JOINT_STATES}")]
        return exact[0] if len(exact) == 1 else found[0] if len(found) == 1 else ""

    def streams(self) -> Iterator[tuple[PoseTopic, int]]:
        """Every readable stream of poses, and its number of poses."""
        for topic in sorted(self.topics):
            if self.topics[topic] in POSE_TYPES:
                with contextlib.suppress(RecordingError):  # other topics may be readable
                    for part, (stamps, *_) in self.tracks(topic).items():
                        yield PoseTopic(topic, part), len(stamps)


@functools.cache
def _typestore(name: str) -> Any:
    from rosbags.typesys import Stores, get_typestore  # its import is slow, and few recordings need it

    return get_typestore(Stores[name])


def _poses(kind: str, message: Any) -> Iterator[tuple[str, int, str, tuple[float, ...]]]:
    """Part, stamp [ns], frame, and pose x y z, quaternion x y z w, of each pose in a message."""
    if isinstance(message, PoseStamped):
        yield "", message.stamp_ns, message.frame_id, message.position + message.orientation
        return
    for i, one in enumerate(
        message.transforms if kind == TF_MESSAGE else message.poses if kind == POSE_ARRAY else [message]
    ):
        header = message.header if kind == POSE_ARRAY else one.header
        stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        if kind == POSE_ARRAY:
            at, turn, part = one.position, one.orientation, str(i)
        elif kind == TF_MESSAGE or kind.endswith("TransformStamped"):
            at, turn, part = one.transform.translation, one.transform.rotation, one.child_frame_id.strip("/")
        else:
            pose = one.pose.pose if kind.endswith("PoseWithCovarianceStamped") else one.pose
            at, turn, part = pose.position, pose.orientation, ""
        yield part, stamp_ns, header.frame_id.strip("/"), (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
