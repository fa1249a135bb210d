"""Recordings as MCAP files: a Recorder that writes what each tick consumed and decided, a Recording that gives it back.

All channels are ROS 2 messages in CDR, so that ROS 2 tools, Rerun and Foxglove read a recording as it is. Within a file the order is: settings, skill
and URDF as attachments, then tick by tick `tick`, its events, `frame`, `timing`, `state`; what is there only for other tools is ignored on reading.
Demonstrations are the same kind of file, with the hands and the tool only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from service import schemas, wire
from service.config import Settings
from service.frame import EVENT_KINDS, FRAME, STATE, TIMING, Record, Tick, decode, encode, encode_setpoint, encode_target
from service.schemas import McapFile, Messages, PoseStreams, RecordingError, Transform, ends_early, existing, machine, next_whole

__all__ = [
    "URDF",
    "Demonstration",
    "Recorder",
    "Recording",
    "RecordingError",
    "Step",
    "iter_hands",
    "machine",
    "read_demonstration",
    "read_hands",
    "write_demonstration",
]  # fmt: skip

DRAWN_EVERY = 5  # ticks; what is there only for other tools
URDF = Path(__file__).with_name("wam.urdf")
_EVENT_TYPES = (wire.POSE, wire.POSE, wire.JOINTS, schemas.SKILL, schemas.STRING, schemas.STRING, schemas.STRING)
_LATCHED = (
    "[{history: 1, depth: 1, reliability: 1, durability: 1, liveliness: 1, avoid_ros_namespace_conventions: false, "
    "deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: 0}, liveliness_lease_duration: {sec: 0, nsec: 0}}]"
)


class Recorder:
    """Writes a recording. Errors of the file system are raised; `flush` bounds what a kill can lose."""

    def __init__(
        self,
        path: str | Path,
        *,
        settings: Settings,
        skill: bytes,
        state: Record | None = None,
        urdf: str | None = None,
        metadata: Mapping[str, str] | None = None,
        time_ns: int = 0,
    ) -> None:
        urdf = URDF.read_text(encoding="utf-8") if urdf is None else urdf
        self._state, self._urdf, self._sequence = state, urdf, 0
        self._skill = skill
        self._begun = False
        self._topics = {name: wire.key(settings.cell, name) for name in (*EVENT_KINDS, *_OWN)}
        self._cell = settings.cell
        self._arm = schemas.ArmFrames(urdf)
        self._plate_from_tool = settings.tool.plate_from_tool
        self._file = McapFile(Path(path))
        self.path = self._file.path
        writer = self._file.writer
        writer.add_metadata("thirdhand", {"format": "1", "cell": settings.cell, **(machine() if metadata is None else metadata)})
        writer.add_attachment(time_ns, time_ns, "settings.json", "application/json", msgspec.json.encode(settings))
        writer.add_attachment(time_ns, time_ns, "skill.npz", "application/octet-stream", skill)
        writer.add_attachment(time_ns, time_ns, "arm.urdf", "application/xml", urdf.encode())

    def _begin(self, time_ns: int) -> None:
        """The initial state and the robot's description carry the time of the first thing written: a reader's time line starts there."""
        self._begun = True
        self._file.put("/robot_description", schemas.STRING, wire.encode_string(self._urdf), time_ns, 0, qos=_LATCHED)
        if self._state is not None:
            self._file.put(self._topics["state"], schemas.STATE, encode(self._state), time_ns, 0)

    def write(
        self,
        tick: Tick,
        frame: Record,
        *,
        time_ns: int,
        timing: Record | None = None,
        state: Record | None = None,
        skill: bytes | None = None,
        lost: int = 0,
    ) -> None:
        """Writes a tick and what came of it.

        After `lost` ticks that could not be recorded, `state` (the controller's, after this tick) and `skill` (in force) let a replay go on. The
        skill is written only if it differs from the last that was.
        """
        if not self._begun:
            self._begin(time_ns)
        topics, put, i = self._topics, self._file.put, tick.index
        self._sequence = i
        put(topics["tick"], schemas.TICK, schemas.encode_tick(i, [EVENT_KINDS.index(event.kind) for event in tick.inbox], lost), time_ns, i)
        for event in tick.inbox:
            if event.kind == "skill":
                self._skill = event.payload
            kind = _EVENT_TYPES[EVENT_KINDS.index(event.kind)]
            put(topics[event.kind], kind, schemas.encode_skill(event.payload) if kind == schemas.SKILL else event.payload, time_ns, i)
        put(topics["frame"], schemas.FRAME, encode(frame), time_ns, i)
        if timing is not None:
            put(topics["timing"], schemas.TIMING, encode(timing), time_ns, i)
        if state is not None:
            put(topics["state"], schemas.STATE, encode(state), time_ns, i)
        if skill is not None and skill != self._skill:
            self._skill = skill
            put(topics["skill_in_force"], schemas.SKILL, schemas.encode_skill(skill), time_ns, i)
        if frame["commanded"]:
            command = wire.encode_command(time_ns, frame["joints"].tolist(), frame["joint_velocities"].tolist())
            put(topics["joints/command"], wire.JOINTS, command, time_ns, i)
        if i % DRAWN_EVERY == 0:
            self._draw(frame, time_ns, i)

    def _draw(self, frame: Record, time_ns: int, i: int) -> None:
        put, orientation = self._file.put, tuple(frame["orientation"].tolist())
        transforms = self._arm.transforms(frame["joints"].tolist())
        if "tool_plate" in self._arm.links:
            offset = self._plate_from_tool
            transforms.append(Transform("tool_plate", "tool", offset[:3], offset[3:]))
        else:
            transforms.append(Transform(wire.BASE, "tool", tuple(frame["tool"].tolist()), orientation))
        setpoint = tuple(frame["setpoint"].tolist())
        transforms.append(Transform(wire.BASE, "setpoint", setpoint, orientation))
        put(self._topics["tool/setpoint"], wire.POSE, encode_setpoint(time_ns, frame), time_ns, i)
        seen = frame["hand_ages"] >= 0
        for side in (0, 1):
            if seen[side]:
                transforms.append(Transform(wire.BASE, _HANDS[side], tuple(frame["hands"][side].tolist()), (0.0, 0.0, 0.0, 1.0)))
        if frame["covariance"].any():  # without both hands nothing is predicted
            target = tuple(frame["target"].tolist())
            put(self._topics["tool/target"], wire.POSE_COV, encode_target(time_ns, frame), time_ns, i)
            transforms.append(Transform(wire.BASE, "target", target, orientation))
        put("/tf", schemas.TF, schemas.encode_transforms(time_ns, transforms), time_ns, i)

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Writes a text under `<cell>/<key>`, like `status`, `requests` or `log`; replay ignores it."""
        if key in self._topics:
            raise ValueError(f"a note under {key!r}: that topic holds what a replay needs")
        if not self._begun:
            self._begin(time_ns)
        self._file.put(wire.key(self._cell, key), schemas.STRING, wire.encode_string(text), time_ns, self._sequence)

    def flush(self) -> None:
        """Ends the chunk in progress: what was written so far survives a kill of the process."""
        self._file.flush()

    def close(self) -> None:
        """Ends the file. A second call does nothing."""
        if not self._begun and self._state is not None:
            self._begin(0)
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


_OWN = ("tick", "frame", "timing", "state", "skill_in_force", "joints/command", "tool/target", "tool/setpoint")
_HANDS = ("left_hand", "right_hand")


# --- reading ----------------------------------------------------------------------------------------------------------------


class Step(NamedTuple):
    """One recorded tick: what it consumed, what it decided, and the state after it where that was recorded.

    The first step may hold the state before the first tick and nothing else: its `frame` is None. Where ticks were `lost` before this one, replay
    continues from its `state`, with the skill in force, which is told where it may have changed meanwhile.
    """

    tick: int
    events: tuple[tuple[str, bytes], ...]
    frame: Record | None
    timing: Record | None
    state: Record | None
    skill: bytes | None = None
    lost: int = 0
    time_ns: int = 0


class Recording:
    """A recording on disk: its settings, its skill, and its steps one after the other, however long it is."""

    def __init__(self, path: Path, settings: Settings, skill: bytes, urdf: str, metadata: dict[str, str], *, truncated: bool) -> None:
        self.path, self.settings, self.skill, self.urdf, self.metadata = path, settings, skill, urdf, metadata
        self.truncated = truncated  # its end is missing; also set when reading meets damage

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """The recording in a file. Raises RecordingError."""
        path = existing(path)
        messages = Messages(path)
        next(iter(messages), None)
        about, parts = messages.metadata.get("thirdhand"), messages.attachments
        if about is None or "settings.json" not in parts or "skill.npz" not in parts:
            if messages.cut:
                raise RecordingError(f"{path} is cut before its first message ({messages.cut})")
            raise RecordingError(f"{path} is an MCAP file but not a recording of thirdhand: settings and skill are not attached")
        if about.get("format") != "1":
            raise RecordingError(f"{path} has format {about.get('format')}, 1 is understood: was it made by a newer version?")
        try:
            settings = msgspec.json.decode(parts["settings.json"], type=Settings)
        except msgspec.DecodeError as error:
            raise RecordingError(f"the settings in {path} are not understood: {error}") from None
        urdf = parts.get("arm.urdf", b"").decode(errors="replace")
        return cls(path, settings, parts["skill.npz"], urdf, about, truncated=ends_early(path))

    def steps(self, *, outputs: bool = True) -> Iterator[Step]:
        """Every recorded tick in order, after the initial state if there is one. Raises RecordingError on what is not understood.

        Without `outputs` only what went in: a recording of a version with other frames and states can be read so.
        """
        prefix = self.settings.cell + "/"
        names = {prefix + name: name for name in (*EVENT_KINDS, "tick", "frame", "timing", "state", "skill_in_force")}
        messages = Messages(self.path)
        step: dict[str, Any] | None = None
        try:
            for schema, channel, message in messages:
                name = names.get(channel.topic)
                if name is None or schema is None or (name in _LAYOUTS and not outputs):
                    continue
                data = message.data
                if name == "tick":
                    if step is not None:
                        yield _finished(step, outputs=outputs)
                    index, kinds, lost = schemas.decode_tick(data)
                    step = {"tick": index, "kinds": kinds, "events": [], "lost": lost, "time_ns": message.log_time}
                elif step is None:
                    if name == "state":
                        initial = decode(data, STATE)
                        yield Step(int(initial["tick"]), (), None, None, initial)
                elif name in _LAYOUTS:
                    step[name] = decode(data, _LAYOUTS[name])
                elif name == "skill_in_force":
                    step["skill"] = schemas.decode_skill(data)
                else:
                    step["events"].append((name, schemas.decode_skill(data) if schema.name == schemas.SKILL else data))
            if step is not None and ("frame" in step or not outputs):
                yield _finished(step, outputs=outputs)
        except wire.WireError as error:
            raise RecordingError(f"{self.path}: after tick {step['tick'] if step else 'none'}: {error}") from None
        self.truncated = self.truncated or bool(messages.cut)

    def notes(self, *keys: str) -> Iterator[tuple[str, str, int]]:
        """Key, text and time [ns] of the notes under the keys, in order."""
        topics = {wire.key(self.settings.cell, key): key for key in keys}
        for _, channel, message in Messages(self.path):
            if channel.topic in topics:
                yield topics[channel.topic], wire.decode_string(message.data), message.log_time


_LAYOUTS = {"frame": FRAME, "timing": TIMING, "state": STATE}


def _finished(step: dict[str, Any], *, outputs: bool) -> Step:
    kinds, events = [EVENT_KINDS[place] for place in step["kinds"]], step["events"]
    if [kind for kind, _ in events] != kinds or (outputs and "frame" not in step):
        raise wire.WireError(f"tick {step['tick']} lists {kinds}; {[kind for kind, _ in events]} and {'a' if 'frame' in step else 'no'} frame follow")
    timing, state, skill = (step.get(name) for name in ("timing", "state", "skill"))
    return Step(step["tick"], tuple(events), step.get("frame"), timing, state, skill, step["lost"], step["time_ns"])


# --- demonstrations ---------------------------------------------------------------------------------------------------------


class Demonstration(NamedTuple):
    """How the tool went with the hands: stamps (T,) [ns], poses (T, 7), each x y z [m] and quaternion x y z w, in one frame."""

    stamps_ns: NDArray[np.int64]
    left: NDArray[np.float64]
    right: NDArray[np.float64]
    tool: NDArray[np.float64]


_STREAMS = ("hands/left", "hands/right", "tool/pose")


def write_demonstration(
    path: str | Path,
    stamps_ns: NDArray[np.int64],
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    tool: NDArray[np.float64],
    *,
    cell: str = "thirdhand",
) -> None:
    """Writes a demonstration: stamps (T,) [ns], poses (T, 7) in frame `base`. The same arrays give the same bytes."""
    poses = [np.asarray(stream, np.float64) for stream in (left, right, tool)]
    for name, stream in zip(_STREAMS, poses, strict=True):
        if stream.shape != (len(stamps_ns), 7) or not np.isfinite(stream).all():
            raise ValueError(f"{name}: shape {stream.shape} given, finite numbers of shape ({len(stamps_ns)}, 7) needed")
    file = McapFile(Path(path))
    try:
        for i, (stamp, *rows) in enumerate(zip(np.asarray(stamps_ns).tolist(), *(stream.tolist() for stream in poses), strict=True)):
            for name, row in zip(_STREAMS, rows, strict=True):
                data = wire.encode_pose(wire.PoseStamped(stamp, wire.BASE, tuple(row[:3]), tuple(row[3:])))
                file.put(wire.key(cell, name), wire.POSE, data, stamp, i)
    finally:
        file.close()


def read_demonstration(path: str | Path) -> Demonstration:
    """The demonstration in an MCAP file: the hands and the tool at the tool's stamps, as far as all three reach. Raises RecordingError.

    Topics are found by their ends, whatever the cell. Where the streams have stamps of their own, the hands are interpolated linearly.
    """
    path = existing(path)
    streams = PoseStreams(path, _STREAMS)
    rows: dict[str, list[wire.PoseStamped]] = {name: [] for name in _STREAMS}
    for schema, channel, message in Messages(path):
        name = streams.name(schema, channel)
        if name:
            try:
                pose = wire.decode_pose(message.data)
            except wire.WireError as error:
                raise RecordingError(f"{path}: {channel.topic}: {error}") from None
            if not wire.finite(pose.position + pose.orientation):
                raise RecordingError(f"{path}: {channel.topic}: a pose that is not finite, at stamp {pose.stamp_ns} ns")
            rows[name].append(pose)
    tracks = []
    for name, poses in rows.items():
        if not poses:
            raise streams.missing(name)
        stamps, first = np.unique(np.array([pose.stamp_ns for pose in poses], np.int64), return_index=True)
        if len(stamps) < 2:
            raise RecordingError(f"{path}: {len(poses)} poses on {name} with {len(stamps)} different stamps, 2 needed")
        tracks.append((stamps, np.array([poses[i].position + poses[i].orientation for i in first])))
    frames = {name: poses[0].frame for name, poses in rows.items()}
    if len(set(frames.values())) > 1:
        raise RecordingError(f"{path}: poses in different frames: {', '.join(f'{name} in {frame!r}' for name, frame in frames.items())}")
    stamps = tracks[2][0]
    start, end = max(track[0][0] for track in tracks), min(track[0][-1] for track in tracks)
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    if len(stamps) < 2:
        raise RecordingError(f"{path}: hands and tool have less than two stamps of the tool in common: by which clocks were they stamped?")
    left, right, tool = (_resampled(stamps, *track) for track in tracks)
    stamps.setflags(write=False)
    return Demonstration(stamps, left, right, tool)


def _resampled(stamps: NDArray[np.int64], at: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 7) at `stamps`, between those at `at` (N,) by linear interpolation, quaternions the short way and of norm 1."""
    if np.isin(stamps, at).all():
        out = poses[np.searchsorted(at, stamps)]
    else:
        signs = np.cumprod(np.where(np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0, -1.0, 1.0), axis=0)
        smooth = np.concatenate([poses[:, :3], poses[:, 3:] * np.concatenate([[1.0], signs])[:, None]], axis=1)
        times, knots = (stamps - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        out = np.stack([np.interp(times, knots, column) for column in smooth.T], axis=1)
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    out.setflags(write=False)
    return out


def iter_hands(path: str | Path) -> Iterator[tuple[int, str, bytes]]:
    """Log time [ns], side and CDR bytes of every hand sample in order of time, one after the other. Raises RecordingError.

    Reads demonstrations, recordings and other ROS 2 recordings; of a file that was cut, what is there, in the order of writing.
    """
    path = existing(path)
    streams = PoseStreams(path, _STREAMS[:2])
    empty = True
    with path.open("rb") as stream:
        messages = iter(Messages(path)) if ends_early(path) else make_reader(stream).iter_messages()
        while found := next_whole(messages, path):
            name = streams.name(found[0], found[1])
            if name:
                empty = False
                yield found[2].log_time, name.removeprefix("hands/"), found[2].data
    if empty:
        raise streams.missing("hands/left or hands/right")


def read_hands(path: str | Path) -> list[tuple[int, str, bytes]]:
    """Log time [ns], side and CDR bytes of every hand sample, sorted by time. Raises RecordingError."""
    return sorted(iter_hands(path), key=lambda sample: sample[0])
