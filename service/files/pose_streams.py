"""Streams of poses in ROS recordings, ours and others': MCAP files, bag folders, `.db3` and `.bag`;
and which of them are the hands and the tool.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
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
from service.files.motion_capture import FRAME, Captured, read_c3d, read_motive
from service.files.tool_poses import tool_poses
from service.files.track import Track, clock_parts
from service.settings.config import Settings, robot_description

SIDES = ("left", "right", "tool")
ENDINGS = {"left": "hands/left", "right": "hands/right", "tool": "tool/pose"}
JOINT_STATES, GRIPPER_STATE, PLACES = "joints/state", "gripper/state", "places"
PATIENCE_S = 0.1  # between the parts of an arm's state that come in several messages
OF_A_HAND = {"hand", "hands", "wrist", "palm", "glove"}
WORDS = {"left": {"left"}, "right": {"right"}, "tool": {"tool", "tcp", "gripper", "effector", "flange"}}
FROM_ARRAYS = "Arrays of any origin become a take in a few lines: docs/arrays.md"
NOT_READ = {
    **dict.fromkeys((".zst", ".zstd", ".lz4", ".gz", ".zip"), "decompress it first, or give the folder of the bag"),
    **dict.fromkeys(
        (".parquet", ".npz", ".npy", ".h5", ".hdf5", ".json", ".txt", ".tsv", ".trc", ".bvh", ".fbx", ".tak"),
        FROM_ARRAYS,
    ),
}
LARGEST_MESSAGE = 1 << 24  # [bytes]
MANY, TREE = "geometry_msgs/msg/PoseArray", "tf2_msgs/msg/TFMessage"
KINDS = (
    POSE.type,
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    MANY,
    TREE,
)


class PoseTopic(NamedTuple):
    """A topic with poses; `part` is the index in a PoseArray or the child frame in a TFMessage,
    empty where there is only one.
    """

    topic: str
    part: str = ""

    @classmethod
    def parsed(cls, text: str) -> PoseTopic:
        """Given as `TOPIC` or `TOPIC:PART`."""
        topic, _, part = text.partition(":")
        return cls(topic, part)

    def __str__(self) -> str:
        return printable(f"{self.topic}:{self.part}" if self.part else self.topic)


Parts = tuple[list[int], list[int], list[tuple[float, ...]], str]


class Recorded:
    """The messages of a recording from which poses can be read, by topic."""

    def __init__(self, path: str | Path) -> None:
        """Reads an MCAP file, a bag's folder, `.db3`, `.bag`, CSV of Motive or C3D.

        Raises RecordingError.
        """
        self.path = Path(path)
        self.topics: dict[str, str] = {}  # types by topic, of all topics
        self.faults: list[FileFault] = []
        self.settings: Settings | None = None  # those in force when it was recorded, if it is ours
        self.urdf = ""
        self.is_ours = False  # whether settings are attached
        self.unused: list[str] = []  # in words, what is there and cannot be used
        self.places: tuple[ViaPoint, ...] = ()  # of the task, if they are recorded
        self.conducts: Hands = "both"  # which hands, in a take
        self.person = ""  # who demonstrated, if a take says so
        self._raw: dict[str, list[tuple[int, bytes]]] = {}
        self._read: dict[str, dict[str, Parts]] = {}
        self._ros_1_topics: set[str] = set()
        self.is_captured = False  # by a motion capture system: in metres, in the axes of that
        if reader := {".csv": read_motive, ".c3d": read_c3d}.get(self.path.suffix.lower()):
            self._read_captured(reader(self._existing()))
        elif self.path.is_dir() or self.path.suffix in (".db3", ".bag"):
            self._read_bag()
        elif instead := NOT_READ.get(self.path.suffix.lower()):
            raise RecordingError(f"{self._existing()} is not read: {instead}")
        else:
            self._read_mcap()

    def _existing(self) -> Path:
        if not self.path.is_file():
            raise RecordingError(f"{self.path} is not there")
        return self.path

    def _read_captured(self, captured: Captured) -> None:
        self.is_captured = True
        for name, (stamps, poses) in captured.items():
            topic, part = PoseTopic.parsed(name)
            self.topics[topic] = POSE.type
            rows = [tuple(row) for row in poses.tolist()]
            self._read.setdefault(topic, {})[part] = (stamps, stamps, rows, FRAME)

    def _read_mcap(self) -> None:
        messages = Messages(existing(self.path))
        for schema, channel, message in messages:
            kind = full_name(schema)
            self.topics.setdefault(channel.topic, kind)
            if channel.message_encoding in ("cdr", "ros1") and kind in (*KINDS, JOINTS.type):
                if channel.message_encoding == "ros1":
                    self._ros_1_topics.add(channel.topic)
                self._raw.setdefault(channel.topic, []).append((message.log_time, self._whole(message.data)))
            elif kind == STRING.type and f"/{channel.topic}".endswith(f"/{PLACES}"):
                self._read_places(self._whole(message.data))
        self.faults = messages.faults
        told = messages.metadata.get("thirdhand", {})
        self.conducts = next((who for who in get_args(Hands) if who == told.get("hands")), "both")
        self.person = told.get("person", "")
        if "settings.json" in messages.attachments:
            self.is_ours = True
            try:
                self.settings = validated(msgspec.json.decode(messages.attachments["settings.json"]), Settings)
            except (msgspec.DecodeError, InvalidError) as error:
                self.unused.append(f"the settings in {self.path} are not understood: {in_words(error, named=False)}")
            self.urdf = messages.attachments.get("arm.urdf", b"").decode(errors="replace")

    def _whole(self, data: bytes) -> bytes:
        """The bytes of a message, also of one that was compressed alone. Raises RecordingError."""
        if not data.startswith(zstandard.FRAME_HEADER):
            return data
        try:
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                found: bytes = stream.read(LARGEST_MESSAGE + 1)
        except zstandard.ZstdError as error:
            raise RecordingError(f"{self.path}: a message that cannot be decompressed: {error}") from None
        if len(found) > LARGEST_MESSAGE:
            raise RecordingError(f"{self.path}: a message of more than {LARGEST_MESSAGE} bytes, once decompressed")
        return found

    def _read_places(self, data: bytes) -> None:
        try:
            self.places = Add(decode_request(cdr.decode_string(data).encode(), tuple[ViaPoint, ...])).points
        except (WireError, ValueError) as error:
            self.unused.append(f"{PLACES} are not understood, and not used: {error}")

    def _read_bag(self) -> None:
        from rosbags.rosbag1 import Reader as Ros1Reader  # heavy, and most recordings are MCAP files
        from rosbags.rosbag2 import Reader as Ros2Reader

        if (self.path / "meta" / "info.json").exists():
            raise RecordingError(
                f"{self.path} is a data set of LeRobot: its columns do not say which are the hands and the tool. "
                f"{FROM_ARRAYS}"
            )
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists() and any(self.path.glob("*.mcap")):
            raise RecordingError(f"{self.path} is a folder: give its files, {self.path}/*.mcap")
        try:
            is_ros_1 = self.path.suffix == ".bag"
            with (Ros1Reader if is_ros_1 else Ros2Reader)(self.path) as bag:
                self.topics = {one.topic: one.msgtype for one in bag.connections}
                self._ros_1_topics = set(self.topics) if is_ros_1 else set()
                wanted = [one for one in bag.connections if one.msgtype in (*KINDS, JOINTS.type)]
                for one, logged_ns, data in bag.messages(connections=wanted) if wanted else ():
                    self._raw.setdefault(one.topic, []).append((logged_ns, bytes(data)))
        except Exception as error:  # the exceptions of its storages have no common base
            there = "" if self.path.exists() else " It is not there."
            raise RecordingError(f"{self.path} is not a bag that can be read: {error}.{there}") from None

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
            except Exception as error:  # the deserialiser raises exceptions of many kinds
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
        if self.is_captured:  # `settings` say where the system is, and the unit in which it publishes
            poses[:, :3] /= UNIT_M[settings.hands.unit]
            frame = frame if settings.hands.frame in ("", BASE) else settings.hands.frame
        return Track(name, str(source), np.array(stamps, np.int64), np.array(logged, np.int64), poses, frame)

    def tool_by_joints(self, topic: str, settings: Settings, urdf: str) -> Track:
        """The tool in frame `base`, found from joint states by the URDF. Raises RecordingError."""
        states = [one for one in self._joint_states(topic, settings.joints.names) if np.isfinite(one[2]).all()]
        if not states:
            raise RecordingError(f"{self.path}: {topic}: no joint state is finite")
        logged, stamps, joints = zip(*states, strict=True)
        poses, kept = tool_poses(settings, urdf, np.array(stamps, np.int64), np.array(joints))
        source = f"{topic}, by the URDF"
        return Track(ENDINGS["tool"], source, np.array(stamps)[kept], np.array(logged)[kept], poses, BASE)

    def closures(self, stamps: NDArray[np.int64], *, logged: bool = False, part: int | None = None) -> Vector | None:
        """How far the gripper is closed (T,) at stamps (T,) [ns]; None where no topic ends in
        `gripper/state`, whose first joint it is.

        With `logged`, the stamps are times of recording; with a `part`, they are of that part
        between two beginnings of the clock. Raises RecordingError.
        """
        topics = [topic for topic in self._raw if f"/{topic}".endswith(f"/{GRIPPER_STATE}")]
        if len(topics) > 1:
            self.unused.append(f"topics {', '.join(sorted(topics))}: one gripper needed, and none is used")
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
            self.unused.append(f"{len(states) - len(closure_at)} of {len(states)} states of the gripper tell nothing")
        if not closure_at:
            return None
        at = np.array(sorted(closure_at), np.int64)
        times = (stamps - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        out: Vector = np.interp(*times, [closure_at[i] for i in at.tolist()])
        out.setflags(write=False)
        return out

    def _joint_states(self, topic: str, names: tuple[str, ...] = ()) -> Iterator[tuple[int, int, tuple[float, ...]]]:
        """Time of recording, stamp [ns], and position of each joint state, of the joints named if
        there are names; they may be spread over several messages. Raises RecordingError.
        """
        states, found = JointStates(names, PATIENCE_S), False
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
        """Raises WireError."""
        if topic not in self._ros_1_topics:
            return cdr.decode_joints(data)
        try:
            found = self._decoded(topic, data, JOINTS.type)
        except Exception as error:  # the deserialiser raises exceptions of many kinds
            raise WireError(f"a {JOINTS.type} that is not readable: {error}") from None
        stamp_ns = found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec
        return JointState(stamp_ns, tuple(found.name), tuple(found.position.tolist()), ())

    def joint_topic(self, settings: Settings) -> str:
        """The one topic with joint states of the arm's joints; empty: none, or several."""
        found = []
        for topic in self._raw:
            if self.topics[topic] == JOINTS.type:
                with contextlib.suppress(RecordingError):
                    next(self._joint_states(topic, settings.joints.names))
                    found.append(topic)
        exact = [topic for topic in found if f"/{topic}".endswith(f"/{JOINT_STATES}")]
        return exact[0] if len(exact) == 1 else found[0] if len(found) == 1 else ""

    def streams(self) -> Iterator[tuple[PoseTopic, int]]:
        """Every stream of poses that is readable, and its number of poses."""
        for topic in sorted(self.topics):
            if self.topics[topic] in KINDS:
                with contextlib.suppress(RecordingError):  # another may be meant
                    for part, (stamps, *_) in self.tracks(topic).items():
                        yield PoseTopic(topic, part), len(stamps)


class Chosen(NamedTuple):
    """The tracks of left hand, right hand and tool; which hands conduct; and in words what was
    guessed. The track of a hand that conducts alone is there twice.
    """

    tracks: list[Track]
    conducts: Hands
    guessed: list[str]


def chosen(recorded: Recorded, given: Mapping[str, PoseTopic], settings: Settings) -> Chosen:
    """The tracks of hands and tool in a recording.

    Topics are found by what is `given`, else by the ends of their names, the tool else by joint
    states, all else by words in their names. If only one hand is found, it conducts alone. Raises
    RecordingError.
    """
    guessed: list[str] = []
    sources: dict[str, PoseTopic] = {}
    conducts = recorded.conducts
    for name in SIDES[:2]:
        if conducts not in ("both", name):
            continue
        source = _given(recorded, name, given[name]) if name in given else _by_ending(recorded, name)
        if source is None and (source := _by_words(recorded, name)):
            guessed.append(f"{name} is {source}")
        if source is not None:
            sources[name] = source
    if not sources:
        raise _not_found(recorded, conducts.replace("both", "left"), [])
    if len(set(sources.values())) < len(sources):
        sources = _side_of_the_one(recorded, sources["left"])
    if len(sources) == 1:
        (conducts,) = (name for name in get_args(Hands) if name in sources)
        hint = "" if conducts == recorded.conducts else f": no other is there (--{_other(conducts)} TOPIC names one)"
        guessed.append(f"the {conducts} hand conducts alone{hint}")
    hands = [recorded.track(ENDINGS[name], source, settings) for name, source in sources.items()]
    return Chosen([hands[0], hands[-1], _tool(recorded, given, settings, guessed)], conducts, guessed)


def _other(side: str) -> str:
    return SIDES[1 - SIDES.index(side)]


def _side_of_the_one(recorded: Recorded, source: PoseTopic) -> dict[str, PoseTopic]:
    """One stream that was found as both hands, by the side that its name says. Raises
    RecordingError.
    """
    sides = [side for side in SIDES[:2] if _words(str(source)) & WORDS[side]]
    if len(sides) != 1:
        raise RecordingError(
            f"{recorded.path}: {source} is given as left and as right: another topic needed for one of them, or for a "
            "task of one hand that hand's option alone"
        )
    return {sides[0]: source}


def _tool(recorded: Recorded, given: Mapping[str, PoseTopic], settings: Settings, guessed: list[str]) -> Track:
    """The tool's track; how it was guessed is appended to `guessed`. Raises RecordingError."""
    source = _given(recorded, "tool", given["tool"]) if "tool" in given else _by_ending(recorded, "tool")
    joints = source.topic if source and recorded.topics[source.topic] == JOINTS.type else ""
    joints = recorded.joint_topic(settings) if source is None else joints
    if joints:
        guessed.append(f"tool found from {joints} by the arm's URDF")
        return recorded.tool_by_joints(joints, settings, recorded.urdf or robot_description(settings))
    if source is None:
        source = _by_words(recorded, "tool")
        if source is None:
            raise _not_found(recorded, "tool", [])
        guessed.append(f"tool is {source}")
    return recorded.track(ENDINGS["tool"], source, settings)


def _given(recorded: Recorded, name: str, wanted: PoseTopic) -> PoseTopic:
    """The stream that was named, as the recording has it. Raises RecordingError."""
    topic = next((topic for topic in recorded.topics if topic.strip("/") == wanted.topic.strip("/")), "")
    if topic and recorded.topics[topic] == JOINTS.type and name == "tool":
        return PoseTopic(topic)
    if not topic or recorded.topics[topic] not in KINDS:
        problem = f"a topic of type {recorded.topics[topic]}" if topic else "no topic there"
        raise RecordingError(f"{recorded.path}: --{name} {wanted}: {problem}; {_poses_in(recorded)}")
    parts = list(recorded.tracks(topic))
    if wanted.part in parts:
        return PoseTopic(topic, wanted.part)
    if len(parts) == 1 and not wanted.part:
        return PoseTopic(topic, parts[0])
    which = "an index" if recorded.topics[topic] == MANY else "a child frame"
    needed = f"{which} needed, one of {', '.join(parts)}" if any(parts) else "it has no parts"
    raise RecordingError(f"{recorded.path}: --{name} {wanted}: {needed}")


def _by_ending(recorded: Recorded, name: str) -> PoseTopic | None:
    """The stream of PoseStamped under our own name, whatever the cell. Raises RecordingError."""
    found = [
        topic
        for topic, kind in recorded.topics.items()
        if kind == POSE.type and f"/{topic}".endswith(f"/{ENDINGS[name]}") and "" in recorded.tracks(topic)
    ]
    if len(found) > 1:
        raise RecordingError(
            f"{recorded.path} has two streams of {ENDINGS[name]}: {found[0]} and {found[1]}; --{name} says which"
        )
    return PoseTopic(found[0]) if found else None


def _by_words(recorded: Recorded, name: str) -> PoseTopic | None:
    """The one stream with a fitting word in its name; None where there is none. Raises
    RecordingError where there are several.
    """
    others = {word for other in SIDES[:2] if other != name for word in WORDS[other]}
    streams = [] if recorded.is_ours else [source for source, _ in recorded.streams()]
    words = {source: _words(str(source)) for source in streams}
    fitting = [source for source in streams if words[source] & WORDS[name] and not words[source] & others]
    if len(fitting) > 1 and name != "tool":
        fitting = [source for source in fitting if words[source] & OF_A_HAND] or fitting
    if len(fitting) > 1:
        raise _not_found(recorded, name, fitting)
    return fitting[0] if fitting else None


def _not_found(recorded: Recorded, name: str, fitting: Sequence[PoseTopic]) -> RecordingError:
    also = f" or {JOINT_STATES} of the arm's joints" if name == "tool" else ""
    several = f"; {', '.join(map(str, fitting))} could be it" if fitting else ""
    return RecordingError(
        f"{recorded.path} has no topic ending in {ENDINGS[name]} with {POSE.type}{also}{several}; "
        f"{_poses_in(recorded)}; --{name} TOPIC[:PART] names another"
    )


def _words(text: str) -> set[str]:
    """The words of a name: `/vrpn/LeftHand_1` has vrpn, left, hand, 1."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)}


def _poses_in(recorded: Recorded) -> str:
    poses = ", ".join(f"{source} ({count})" for source, count in recorded.streams())
    return f"its topics: {', '.join(sorted(recorded.topics)) or 'none'}; of these hold poses: {poses or 'none'}"


@functools.cache
def _typestore(name: str) -> Any:
    from rosbags.typesys import Stores, get_typestore  # takes a moment, and few recordings need it

    return get_typestore(Stores[name])


def _poses(kind: str, message: Any) -> Iterator[tuple[str, int, str, tuple[float, ...]]]:
    """Part, stamp [ns], frame, and pose x y z, quaternion x y z w, of each pose in a message."""
    if isinstance(message, PoseStamped):
        yield "", message.stamp_ns, message.frame_id, message.position + message.orientation
        return
    for i, one in enumerate(message.transforms if kind == TREE else message.poses if kind == MANY else [message]):
        header = message.header if kind == MANY else one.header
        stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        if kind == MANY:
            at, turn, part = one.position, one.orientation, str(i)
        elif kind == TREE or kind.endswith("TransformStamped"):
            at, turn, part = one.transform.translation, one.transform.rotation, one.child_frame_id.strip("/")
        else:
            pose = one.pose.pose if kind.endswith("PoseWithCovarianceStamped") else one.pose
            at, turn, part = pose.position, pose.orientation, ""
        yield part, stamp_ns, header.frame_id.strip("/"), (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
