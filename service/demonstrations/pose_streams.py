"""Streams of poses in ROS recordings, ours and others': MCAP files, bag folders, `.db3` and `.bag`;
and which of them are the hands and the tool.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.config import Settings, robot_description
from service.contract import cdr
from service.contract.channels import JOINTS, POSE, STRING
from service.contract.messages import BASE, PoseStamped, WireError, in_order
from service.contract.printable import printable
from service.contract.requests import Add, Hands, ViaPoint, decode_request
from service.core.frame import Vector
from service.demonstrations.tool_poses import tool_poses
from service.recording.mcap_file import RecordingError, existing
from service.recording.mcap_reader import FileFault, Messages, full_name

SIDES = ("left", "right", "tool")
ENDINGS = {"left": "hands/left", "right": "hands/right", "tool": "tool/pose"}
JOINT_STATES, GRIPPER_STATE, PLACES = "joints/state", "gripper/state", "places"
OF_A_HAND = {"hand", "hands", "wrist", "palm", "glove"}
WORDS = {"left": {"left"}, "right": {"right"}, "tool": {"tool", "tcp", "gripper", "effector", "flange"}}
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


class Track(NamedTuple):
    """Poses (N, 7) of one stream, x y z and quaternion x y z w, in `frame`; their stamps (N,) [ns]
    and the times at which they were recorded (N,) [ns].
    """

    name: str
    source: str
    stamps_ns: NDArray[np.int64]
    logged_ns: NDArray[np.int64]
    poses: Vector
    frame: str


Parts = tuple[list[int], list[int], list[tuple[float, ...]], str]


class Recorded:
    """The messages of a recording from which poses can be read, by topic."""

    def __init__(self, path: str | Path) -> None:
        """Reads an MCAP file, a bag's folder, `.db3` or `.bag`. Raises RecordingError."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}  # types by topic, of all topics
        self.faults: list[FileFault] = []
        self.settings: Settings | None = None  # those in force when it was recorded, if it is ours
        self.urdf = ""
        self.places: tuple[ViaPoint, ...] = ()  # of the task, if they are recorded
        self.conducts: Hands = "both"  # which hands, in a take
        self.person = ""  # who demonstrated, if a take says so
        self._raw: dict[str, list[tuple[int, bytes]]] = {}
        self._read: dict[str, dict[str, Parts]] = {}
        self._is_ros_1 = self.path.suffix == ".bag"
        if self.path.is_dir() or self.path.suffix in (".db3", ".bag"):
            self._read_bag()
        else:
            self._read_mcap()

    @property
    def is_ours(self) -> bool:
        """Whether its settings are attached."""
        return self.settings is not None

    def _read_mcap(self) -> None:
        messages = Messages(existing(self.path))
        for schema, channel, message in messages:
            kind = full_name(schema)
            self.topics.setdefault(channel.topic, kind)
            if channel.message_encoding == "cdr" and kind in (*KINDS, JOINTS.type):
                self._raw.setdefault(channel.topic, []).append((message.log_time, message.data))
            elif kind == STRING.type and f"/{channel.topic}".endswith(f"/{PLACES}"):
                self.places = self._decoded_places(message.data)
        self.faults = messages.faults
        told = messages.metadata.get("thirdhand", {})
        self.conducts = next((who for who in get_args(Hands) if who == told.get("hands")), "both")
        self.person = told.get("person", "")
        if "settings.json" in messages.attachments:
            try:
                self.settings = msgspec.json.decode(messages.attachments["settings.json"], type=Settings)
            except msgspec.DecodeError as error:
                raise RecordingError(f"the settings in {self.path} are not understood: {error}") from None
            self.urdf = messages.attachments.get("arm.urdf", b"").decode(errors="replace")

    def _decoded_places(self, data: bytes) -> tuple[ViaPoint, ...]:
        try:
            return Add(decode_request(cdr.decode_string(data).encode(), tuple[ViaPoint, ...])).points
        except (WireError, ValueError) as error:
            raise RecordingError(f"{self.path}: {PLACES}: {error}") from None

    def _read_bag(self) -> None:
        from rosbags.rosbag1 import Reader as Ros1Reader  # heavy, and most recordings are MCAP files
        from rosbags.rosbag2 import Reader as Ros2Reader

        if self.path.is_dir() and not (self.path / "metadata.yaml").exists() and any(self.path.glob("*.mcap")):
            raise RecordingError(f"{self.path} is a folder: give its files, {self.path}/*.mcap")
        try:
            with (Ros1Reader if self._is_ros_1 else Ros2Reader)(self.path) as bag:
                self.topics = {one.topic: one.msgtype for one in bag.connections}
                wanted = [one for one in bag.connections if one.msgtype in (*KINDS, JOINTS.type)]
                for one, logged_ns, data in bag.messages(connections=wanted) if wanted else ():
                    self._raw.setdefault(one.topic, []).append((logged_ns, bytes(data)))
        except Exception as error:  # the exceptions of its storages have no common base
            there = "" if self.path.exists() else " It is not there."
            raise RecordingError(f"{self.path} is not a bag that can be read: {error}.{there}") from None

    def _decoded(self, data: bytes, kind: str) -> Any:
        if self._is_ros_1:
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
                parts = _poses(kind, self._decoded(data, kind))
            except Exception as error:  # the deserialiser raises exceptions of many kinds
                raise RecordingError(f"{self.path}: {topic}: a {kind} that is not readable: {error}") from None
            for part, stamp_ns, frame, pose in parts:
                if not (self.is_ours or np.isfinite(pose).all()):
                    raise RecordingError(
                        f"{self.path}: {topic}: a pose that is not finite, at stamp {stamp_ns or logged_ns} ns"
                    )
                stamps, logged, poses, _ = out.setdefault(part, ([], [], [], frame))
                if frame != out[part][3]:
                    raise RecordingError(
                        f"{self.path}: {PoseTopic(topic, part)}: poses in frames {out[part][3]!r} and {frame!r}"
                    )
                stamps.append(stamp_ns or logged_ns)
                logged.append(logged_ns)
                poses.append(pose)
        return out

    def track(self, name: str, source: PoseTopic) -> Track:
        """One stream as arrays. Raises RecordingError."""
        stamps, logged, poses, frame = self.tracks(source.topic)[source.part]
        return Track(name, str(source), np.array(stamps), np.array(logged), np.array(poses), frame)

    def tool_by_joints(self, topic: str, settings: Settings, urdf: str) -> Track:
        """The tool in frame `base`, found from joint states by the URDF. Raises RecordingError."""
        logged, stamps, joints = zip(*self._joint_states(topic, settings.joints.names), strict=True)
        poses, kept = tool_poses(settings, urdf, np.array(stamps, np.int64), np.array(joints))
        source = f"{topic}, by the URDF"
        return Track(ENDINGS["tool"], source, np.array(stamps)[kept], np.array(logged)[kept], poses, BASE)

    def closures(self, stamps: NDArray[np.int64], *, logged: bool = False) -> Vector | None:
        """How far the gripper is closed (T,) at stamps (T,) [ns]; None where no topic ends in
        `gripper/state`, whose first joint it is.

        With `logged`, the stamps are times of recording. Raises RecordingError.
        """
        topics = [topic for topic in self._raw if f"/{topic}".endswith(f"/{GRIPPER_STATE}")]
        if len(topics) > 1:
            raise RecordingError(f"{self.path}: topics {', '.join(sorted(topics))}: one gripper needed")
        closure_at: dict[int, float] = {}
        for logged_ns, stamp_ns, position in self._joint_states(topics[0]) if topics else ():
            if not np.isfinite(position[:1]).all() or not position:
                raise RecordingError(f"{self.path}: {topics[0]}: no finite position, at stamp {stamp_ns} ns")
            closure_at[logged_ns if logged else stamp_ns] = position[0]
        if not closure_at:
            return None
        at = np.array(sorted(closure_at), np.int64)
        times = (stamps - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        out: Vector = np.interp(*times, [closure_at[i] for i in at.tolist()])
        out.setflags(write=False)
        return out

    def _joint_states(self, topic: str, names: tuple[str, ...] = ()) -> Iterator[tuple[int, int, tuple[float, ...]]]:
        """Time of recording, stamp [ns], and position of each joint state, of the joints named if
        there are names. Raises RecordingError.
        """
        for logged_ns, data in self._raw[topic]:
            try:
                if self._is_ros_1:
                    raise WireError("joint states of ROS 1 are not read; a bag of ROS 2 needed, or --tool with poses")
                state = cdr.decode_joints(data)
                position = in_order(state, names)[0] if names else state.position
            except WireError as error:
                raise RecordingError(f"{self.path}: {topic}: {error}") from None
            yield logged_ns, state.stamp_ns or logged_ns, position

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
        """Every stream of poses, and its number of poses."""
        for topic in sorted(self._raw):
            if self.topics[topic] in KINDS:
                for part, (stamps, *_) in self.tracks(topic).items():
                    yield PoseTopic(topic, part), len(stamps)


def chosen(recorded: Recorded, given: Mapping[str, PoseTopic], settings: Settings) -> tuple[list[Track], list[str]]:
    """The tracks of left hand, right hand and tool; and in words those that were guessed.

    Topics are found by what is `given`, else by the ends of their names, the tool else by joint
    states, all else by words in their names. A hand that conducts alone is both. Raises
    RecordingError.
    """
    urdf = recorded.urdf or robot_description(settings)
    tracks: list[Track] = []
    guessed: list[str] = []
    for name in SIDES:
        if name in ("left", "right") and recorded.conducts not in ("both", name):
            continue
        source = _given(recorded, name, given[name]) if name in given else _by_ending(recorded, name)
        joints = source.topic if source and recorded.topics[source.topic] == JOINTS.type else ""
        if source is None and name == "tool":
            joints = recorded.joint_topic(settings)
        if joints:
            tracks.append(recorded.tool_by_joints(joints, settings, urdf))
            guessed.append(f"tool found from {joints} by the arm's URDF")
            continue
        if source is None:
            source = _by_words(recorded, name)
            guessed.append(f"{name} is {source}")
        tracks.append(recorded.track(ENDINGS[name], source))
    if recorded.conducts != "both":
        tracks.insert(0, tracks[0])
        guessed.append(f"the {recorded.conducts} hand conducts alone")
    return tracks, guessed


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


def _by_words(recorded: Recorded, name: str) -> PoseTopic:
    """The one stream with a fitting word in its name. Raises RecordingError."""
    others = {word for other in SIDES[:2] if other != name for word in WORDS[other]}
    streams = [] if recorded.is_ours else [source for source, _ in recorded.streams()]
    words = {source: _words(str(source)) for source in streams}
    fitting = [source for source in streams if words[source] & WORDS[name] and not words[source] & others]
    if len(fitting) > 1 and name != "tool":
        fitting = [source for source in fitting if words[source] & OF_A_HAND]
    if len(fitting) == 1:
        return fitting[0]
    also = f" or {JOINT_STATES} of the arm's joints" if name == "tool" else ""
    several = f"; {', '.join(map(str, fitting))} could be it" if fitting else ""
    raise RecordingError(
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
