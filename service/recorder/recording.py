"""Recordings as MCAP files: a Recorder that writes what each tick consumed and decided, a Recording
that gives it back.

All channels are ROS 2 messages in CDR, so that ROS 2 tools, Rerun and Foxglove read a recording as
it is. Within a file the order is: settings, skill and URDF as attachments, then tick by tick
`tick`, its events, `frame`, `timing`, `state`; what is there only for other tools is ignored on
reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import msgspec

from service.config import Settings, robot_description
from service.contract import cdr, channels
from service.contract.messages import BASE, Transform, Vector3, WireError
from service.contract.records import SIDES
from service.core.frame import TIMING, Record, Tick, decode, encode, frame_layout, state_layout
from service.core.outputs import outgoing
from service.recorder.mcap_file import McapFile, Messages, RecordingError, ends_early, existing, machine
from service.urdf import Urdf

FORMAT = "2"  # of State and Frame too: another version decides otherwise, and does not replay it
_LATCHED = (
    "[{history: 1, depth: 1, reliability: 1, durability: 1, liveliness: 1, avoid_ros_namespace_conventions: false, "
    "deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: 0}, liveliness_lease_duration: {sec: 0, nsec: 0}}]"
)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class Recorder:
    """Writes a recording.

    Errors of the file system are raised; `flush` bounds what a kill can lose.
    """

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
        self._urdf = robot_description(settings) if urdf is None else urdf
        self._settings, self._skill, self._state = settings, skill, state
        self._begun, self._sequence = False, 0
        self._links = Urdf(self._urdf)
        self._topics = {
            channel.key: channels.key(settings.cell, channel.key) for channel in channels.CHANNELS if channel.recorded
        }
        self._file = McapFile(Path(path), joints=len(settings.joints.names))
        self.path = self._file.path
        about = {"format": FORMAT, "cell": settings.cell, **(machine() if metadata is None else metadata)}
        writer = self._file.writer
        writer.add_metadata("thirdhand", about)
        writer.add_attachment(time_ns, time_ns, "settings.json", "application/json", msgspec.json.encode(settings))
        writer.add_attachment(time_ns, time_ns, "skill.npz", "application/octet-stream", skill)
        writer.add_attachment(time_ns, time_ns, "arm.urdf", "application/xml", self._urdf.encode())

    def _begin(self, time_ns: int) -> None:
        """The initial state and the robot's description carry the time of the first thing written.

        A reader's time line starts there.
        """
        self._begun = True
        self._put("/robot_description", cdr.encode_string(self._urdf), time_ns, qos=_LATCHED)
        if self._state is not None:
            self._put("state", encode(self._state), time_ns)

    def _put(self, key: str, data: bytes, time_ns: int, *, qos: str = "") -> None:
        """One message on a channel: as the channel has it, or as its events are kept."""
        channel = channels.BY_KEY[key]
        kind = channel.kept_as.type
        self._file.put(self._topics[key], kind, data, time_ns, self._sequence, qos=qos)

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

        After `lost` ticks that could not be recorded, `state` (the controller's, after this tick)
        and `skill` (in force) let a replay go on. The skill is written only if it differs from the
        last that was.
        """
        if not self._begun:
            self._begin(time_ns)
        put, self._sequence = self._put, tick.index
        kinds = [channels.EVENT_NUMBERS[event.kind] for event in tick.inbox]
        put("tick", cdr.encode_tick(tick.index, kinds, lost), time_ns)
        for event in tick.inbox:
            if event.kind == "skill":
                self._skill = event.payload
                put("skill", cdr.encode_skill(event.payload), time_ns)
            else:
                put(event.kind, event.payload, time_ns)
        put("frame", encode(frame), time_ns)
        if timing is not None:
            put("timing", encode(timing), time_ns)
        if state is not None:
            put("state", encode(state), time_ns)
        if skill is not None and skill != self._skill:
            self._skill = skill
            put("skill_in_force", cdr.encode_skill(skill), time_ns)
        for channel, payload in outgoing(frame, time_ns, self._settings.joints.names):
            put(channel.key, payload, time_ns)
        if tick.index % channels.BY_KEY["/tf"].every == 0:
            put("/tf", cdr.encode_transforms(time_ns, self._transforms(frame)), time_ns)

    def _transforms(self, frame: Record) -> list[Transform]:
        """Where everything is, for viewers: the arm's links, tool, setpoint, target and hands."""
        settings, orientation = self._settings, tuple(frame["orientation"].tolist())
        joints = dict(zip(settings.joints.names, frame["joints"].tolist(), strict=True))
        found = self._links.transforms(joints)
        offset = settings.tool.plate_from_tool
        found.append(Transform(settings.arm.plate, "tool", offset[:3], offset[3:]))
        found.append(Transform(BASE, "setpoint", _point(frame["setpoint"]), orientation))
        for side, name in enumerate(SIDES):
            if frame["hand_ages"][side] >= 0:
                found.append(Transform(BASE, f"{name}_hand", _point(frame["hands"][side]), _UPRIGHT))
        if frame["covariance"].any():  # without both hands nothing is predicted
            found.append(Transform(BASE, "target", _point(frame["target"]), orientation))
        return found

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Writes a text under `<cell>/<key>`, like `status`, `requests` or `log`; replay ignores
        it.
        """
        if key in _REPLAYED:
            raise ValueError(f"a note under {key!r}: that topic holds what a replay needs")
        if not self._begun:
            self._begin(time_ns)
        topic = channels.key(self._settings.cell, key)
        self._file.put(topic, channels.STRING.type, cdr.encode_string(text), time_ns, self._sequence)

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


_RECORDS = ("frame", "timing", "state")
_REPLAYED = {*channels.EVENT_NUMBERS, *_RECORDS, "tick", "skill_in_force"}


def _point(position: Any) -> Vector3:
    x, y, z = position.tolist()
    return x, y, z


class Step(NamedTuple):
    """One recorded tick: what it consumed, what it decided, and the state after it where that was
    recorded.

    The first step may hold the state before the first tick and nothing else: its `frame` is None.
    Where ticks were `lost` before this one, replay continues from its `state`, with the skill in
    force, which is told where it may have changed meanwhile.
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
    """A recording on disk: its settings, its skill, and its steps one after the other, however long
    it is.
    """

    def __init__(
        self, path: Path, settings: Settings, skill: bytes, urdf: str, metadata: dict[str, str], *, truncated: bool
    ) -> None:
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
            raise RecordingError(
                f"{path} is an MCAP file but not a recording of thirdhand: settings and skill are not attached"
            )
        if about.get("format") != FORMAT:
            raise RecordingError(
                f"{path} has format {about.get('format')}, {FORMAT} is understood: was it made by another version?"
            )
        try:
            settings = msgspec.json.decode(parts["settings.json"], type=Settings)
        except msgspec.DecodeError as error:
            raise RecordingError(f"the settings in {path} are not understood: {error}") from None
        urdf = parts.get("arm.urdf", b"").decode(errors="replace")
        return cls(path, settings, parts["skill.npz"], urdf, about, truncated=ends_early(path))

    def steps(self, *, outputs: bool = True) -> Iterator[Step]:
        """Every recorded tick in order, after the initial state if there is one.

        Raises RecordingError on what is not understood.

        Without `outputs` only what went in: a recording of a version with other frames and states
        can be read so.
        """
        names = {channels.key(self.settings.cell, name): name for name in _REPLAYED}
        joints = len(self.settings.joints.names)
        layouts = {"frame": frame_layout(joints), "timing": TIMING, "state": state_layout(joints)}
        messages = Messages(self.path)
        step: dict[str, Any] | None = None
        try:
            for schema, channel, message in messages:
                name = names.get(channel.topic)
                if name is None or schema is None or (name in _RECORDS and not outputs):
                    continue
                data = message.data
                if name == "tick":
                    if step is not None:
                        yield _finished(step, outputs=outputs)
                    index, kinds, lost = cdr.decode_tick(data)
                    step = {"tick": index, "kinds": kinds, "events": [], "lost": lost, "time_ns": message.log_time}
                elif step is None:
                    if name == "state":
                        initial = decode(data, layouts["state"])
                        yield Step(int(initial["tick"]), (), None, None, initial)
                elif name in _RECORDS:
                    step[name] = decode(data, layouts[name])
                elif name == "skill_in_force":
                    step["skill"] = cdr.decode_skill(data)
                else:
                    step["events"].append((name, cdr.decode_skill(data) if name == "skill" else data))
            if step is not None and ("frame" in step or not outputs):
                yield _finished(step, outputs=outputs)
        except WireError as error:
            raise RecordingError(f"{self.path}: after tick {step['tick'] if step else 'none'}: {error}") from None
        self.truncated = self.truncated or bool(messages.cut)

    def notes(self, *keys: str) -> Iterator[tuple[str, str, int]]:
        """Key, text and time [ns] of the notes under the keys, in order."""
        topics = {channels.key(self.settings.cell, key): key for key in keys}
        for _, channel, message in Messages(self.path):
            if channel.topic in topics:
                yield topics[channel.topic], cdr.decode_string(message.data), message.log_time


def _finished(step: dict[str, Any], *, outputs: bool) -> Step:
    kinds, events = [_kind(number) for number in step["kinds"]], step["events"]
    if [kind for kind, _ in events] != kinds or (outputs and "frame" not in step):
        raise WireError(
            f"tick {step['tick']} lists {kinds}; "
            f"{[kind for kind, _ in events]} and {'a' if 'frame' in step else 'no'} frame follow"
        )
    timing, state, skill = (step.get(name) for name in ("timing", "state", "skill"))
    return Step(step["tick"], tuple(events), step.get("frame"), timing, state, skill, step["lost"], step["time_ns"])


def _kind(number: int) -> str:
    if number not in channels.EVENT_KINDS:
        raise WireError(f"a Tick with an event of kind {number}; {len(channels.EVENT_KINDS)} are known")
    return channels.EVENT_KINDS[number]
