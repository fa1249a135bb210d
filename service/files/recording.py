"""Recordings as MCAP files: a Recorder writes what each tick consumed and decided, a Recording
reads it.

All channels are ROS 2 messages in CDR, so that ROS 2 tools, Rerun and Foxglove read a recording as
it is. Settings, skill and URDF are attachments; then follow, tick by tick, `tick`, its events,
`frame`, `timing` and `state`. What is stored only for other tools is ignored on reading.
"""

from __future__ import annotations

import contextlib
import shlex
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from service.contract import cdr, channels
from service.contract.explain import InvalidError, in_words, validated
from service.contract.messages import SceneObject
from service.core.frame import Outputs, Record, Tick, encode
from service.core.transforms import Frames
from service.files.mcap_file import McapFile, RecordingError, ends_early, existing, machine
from service.files.mcap_reader import FileFault, Messages
from service.files.pose_streams import ENDINGS
from service.files.steps import REPLAYED, Gap, Step, steps
from service.files.urdf_markers import with_markers
from service.settings.config import Settings, robot_description

OBJECTS = "objects"
CHECKSUMS = "checksums.u32"  # for each tick number since 0, little endian
FORMAT = "2"  # of State and Frame too: another format cannot be replayed
_LATCHED = (
    "[{history: 1, depth: 1, reliability: 1, durability: 1, liveliness: 1, avoid_ros_namespace_conventions: false, "
    "deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: 0}, liveliness_lease_duration: {sec: 0, nsec: 0}}]"
)


class Recorder(McapFile):
    """A recording that is being written; `flush` bounds what a kill can lose.

    With `checksums` (4 bytes each tick number) frames may be left out. Such a file is not
    compressed, so that a history that packs it stores only what differs from the one before.
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
        checksums: bytes = b"",
    ) -> None:
        self._urdf = robot_description(settings) if urdf is None else urdf
        self._settings, self.skill, self._state = settings, skill, state  # the skill in force, a file
        self._begun, self._sequence = False, 0
        self._frames = Frames(settings, self._urdf)
        self._topics = {
            channel.key: channels.topic(settings.cell, channel.key) for channel in channels.CHANNELS if channel.recorded
        }
        super().__init__(Path(path), joints=len(settings.joints.names), compressed=not checksums)
        about = {"format": FORMAT, "cell": settings.cell, **(machine() if metadata is None else metadata)}
        self.kept = self.pending = 0  # ticks in the file, ticks that wait for the end of their chunk
        try:
            self.writer.add_metadata("thirdhand", about)
            self.attach("settings.json", msgspec.json.encode(settings), time_ns)
            self.attach("skill.npz", skill, time_ns)
            self.attach("arm.urdf", self._urdf.encode(), time_ns)
            if checksums:
                self.attach(CHECKSUMS, checksums, time_ns)
        except OSError:
            self.abandon()
            raise

    def _begin(self, time_ns: int) -> None:
        """Writes the robot's description and the initial state, timed as the first message."""
        self._begun = True
        self._put("/robot_description", cdr.encode_string(with_markers(self._urdf)), time_ns, qos=_LATCHED)
        if self._state is not None:
            self._put("state", encode(self._state), time_ns)

    def _put(self, key: str, data: bytes, time_ns: int, *, qos: str = "") -> None:
        """Writes one message on a channel, in the type in which its events are kept."""
        self.put(self._topics[key], channels.BY_KEY[key].kept_as.type, data, time_ns, self._sequence, qos=qos)

    def write(
        self,
        tick: Tick,
        frame: Record | None,
        *,
        time_ns: int,
        timing: Record | None = None,
        state: Record | None = None,
        skill: bytes | None = None,
        lost: int = 0,
        outputs: Outputs = (),
    ) -> None:
        """Writes a tick, its frame, and what it published by key.

        After `lost` ticks that could not be recorded, `state` (after this tick) and `skill` (in
        force) let a replay continue. The skill is written only if it differs from the last one.
        """
        if not self._begun:
            self._begin(time_ns)
        put, self._sequence = self._put, tick.index
        self.pending += 1
        kinds = [channels.EVENT_NUMBERS[event.kind] for event in tick.inbox]
        put("tick", cdr.encode_tick(tick.index, kinds, lost), time_ns)
        for event in tick.inbox:
            if event.kind == "skill":
                self.skill = event.payload
                put("skill", cdr.encode_skill(event.payload), time_ns)
            else:
                put(event.kind, event.payload, time_ns)
        if frame is not None:
            put("frame", encode(frame), time_ns)
        if timing is not None:
            put("timing", encode(timing), time_ns)
        if state is not None:
            put("state", encode(state), time_ns)
        if skill is not None and skill != self.skill:
            self.skill = skill
            put("skill_in_force", cdr.encode_skill(skill), time_ns)
        for key, payload in outputs:
            put(key, payload, time_ns)
        if frame is not None and tick.index % channels.BY_KEY["/tf"].every == 0:
            frames = [*self._frames.fixed, *self._frames.moving(frame, frame["joints"].tolist())]
            put("/tf", cdr.encode_transforms(time_ns, frames), time_ns)
        self.part_ends()

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Writes a text under `<cell>/<key>`, like `status`, `requests` or `log`, or objects given
        as JSON under `objects`; replay ignores it.
        """
        if key in REPLAYED:
            raise ValueError(f"a note under {key!r}: that topic holds what a replay needs")
        if not self._begun:
            self._begin(time_ns)
        if key == OBJECTS:
            objects = msgspec.json.decode(text, type=tuple[SceneObject, ...])
            return self._put(key, channels.BY_KEY[key].codec.encode(time_ns, objects), time_ns)
        topic = channels.topic(self._settings.cell, key)
        self.put(topic, channels.STRING.type, cdr.encode_string(text), time_ns, self._sequence)
        return None

    def flush(self) -> None:
        super().flush()
        self.kept, self.pending = self.kept + self.pending, 0

    def close(self) -> None:
        if not self.closed and not self._begun and self._state is not None:
            self._begin(0)
        super().close()


def _take_hint(path: Path) -> str:
    """For the error on a file that is a take: that it is one, and the command that shows it."""
    topics: list[str] = []
    with path.open("rb") as stream, contextlib.suppress(McapError, struct.error, ValueError):
        contents = make_reader(stream).get_summary()
        topics = [f"/{channel.topic}" for channel in contents.channels.values()] if contents else []
    if path.suffix != ".mcap" or not all(any(t.endswith(f"/{end}") for t in topics) for end in ENDINGS.values()):
        return ""
    name, folder = shlex.quote(path.stem), shlex.quote(str(path.parent))
    return f"; it is a take: thirdhand record {name} --folder {folder} --show --plot {name}.png"


class Recording:
    """A recording on disk: its settings, its skill, and its steps, which are read one by one."""

    def __init__(self, path: Path, settings: Settings, attached: Mapping[str, bytes], metadata: dict[str, str]) -> None:
        self.path, self.settings, self.metadata, self.truncated = path, settings, metadata, ends_early(path)
        self.skill, self.urdf = attached["skill.npz"], attached.get("arm.urdf", b"").decode(errors="replace")
        checksums = attached.get(CHECKSUMS, b"")
        self.checksums = dict(enumerate(np.frombuffer(checksums, "<u4", len(checksums) // 4).tolist()))
        self.faults: list[FileFault] = []  # known once all steps are read

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """The recording in a file. Raises RecordingError."""
        path = existing(path)
        messages = Messages(path)
        next(iter(messages), None)
        about, parts = messages.metadata.get("thirdhand"), messages.attachments
        needed = ["settings.json", "skill.npz", *(["arm.urdf"] if messages.faults else [])]
        if about is None or any(name not in parts for name in needed):
            if any(fault.cut for fault in messages.faults):
                raise RecordingError(f"{path} is cut before its first message ({messages.faults[-1].why})")
            if messages.faults:
                raise RecordingError(
                    f"{path} lacks settings, skill or arm, which a replay starts from: "
                    + "; ".join(map(str, messages.faults))
                )
            raise RecordingError(
                f"{path} is an MCAP file but not a recording of thirdhand: settings and skill are not attached"
                + _take_hint(path)
            )
        if about.get("format") != FORMAT:
            raise RecordingError(
                f"{path} has format {about.get('format')}, {FORMAT} is understood: was it made by another version?"
            )
        try:
            settings = validated(msgspec.json.decode(parts["settings.json"]), Settings)
        except (msgspec.DecodeError, InvalidError) as error:
            raise RecordingError(f"the settings in {path} are not understood: {in_words(error, named=False)}") from None
        return cls(path, settings, parts, about)

    def ticks(self) -> int | None:
        """The number of ticks by the file's summary; None where the summary is missing."""
        topic = channels.key(self.settings.cell, "tick")
        with self.path.open("rb") as stream, contextlib.suppress(McapError, struct.error, ValueError):
            contents = make_reader(stream).get_summary()
            if contents is not None and contents.statistics is not None:
                numbers = [number for number, channel in contents.channels.items() if channel.topic == topic]
                return sum(contents.statistics.channel_message_counts.get(number, 0) for number in numbers)
        return None

    def steps(self, *, outputs: bool = True, whole: bool = True) -> Iterator[Step]:
        """Every recorded tick in order, after the initial state if there is one.

        Without `outputs` only the inputs: so recordings of versions with other frames and states
        can be read. Raises RecordingError on what cannot be decoded, and where not all frames are
        there as a `whole`.
        """
        if outputs and whole and self.checksums:
            raise RecordingError(
                f"{self.path} keeps checksums of its frames: thirdhand replay {shlex.quote(str(self.path))} "
                "--output whole.mcap writes a recording with all of them"
            )
        messages = Messages(self.path)
        yield from steps(messages, self.settings, outputs=outputs, whole=not self.checksums)
        self.faults = messages.faults
        self.truncated = any(fault.cut for fault in messages.faults)

    def unreported(self, gaps: Iterable[Gap], *, last: int | None) -> list[str]:
        """The faults that no gap names, as text, once all steps are read up to tick `last`."""
        reported = "".join(gap.why for gap in gaps)
        read = "no tick was read" if last is None else f"the last tick read is {last}"
        return [f"{self.path}: {fault}; {read}" for fault in self.faults if str(fault) not in reported]

    def notes(self, *keys: str) -> Iterator[tuple[str, str, int]]:
        """Key, text and time [ns] of the notes under the keys, in order; objects as JSON."""
        topics = channels.keys_by_topic(self.settings.cell, keys)
        for _, channel, message in Messages(self.path):
            key = topics.get(channel.topic)
            if key == OBJECTS:
                objects = channels.BY_KEY[key].codec.decode(message.data)
                yield key, msgspec.json.encode(objects).decode(), message.log_time
            elif key is not None:
                yield key, cdr.decode_string(message.data), message.log_time
