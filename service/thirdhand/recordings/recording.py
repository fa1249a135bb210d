"""Recordings as MCAP files: a Recorder writes the input and the decision of each tick, a Recording
reads them.

All channels are ROS 2 messages in CDR, so ROS 2 tools, Rerun and Foxglove can read a recording.
Settings, skill and URDF are attachments. Each tick has the messages `tick`, its events, `timing`,
`frame` or its checksum, and sometimes `state`. Messages that only other tools need are ignored on
reading.
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
from mcap.summary import Summary

from thirdhand.contract import cdr, channels
from thirdhand.contract.channels import TAKE_KEYS
from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.contract.images import COMPRESSED_IMAGE, CompressedImage, decode_image
from thirdhand.contract.messages import SceneObject, WireError
from thirdhand.core.frame import Outputs, Record, Tick, encode
from thirdhand.recordings.mcap_file import McapFile, RecordingError, ends_early, existing, machine
from thirdhand.recordings.mcap_reader import FileFault, Messages, full_name
from thirdhand.recordings.steps import REPLAYED, Gap, Step, checksum, steps
from thirdhand.recordings.transforms import Frames
from thirdhand.recordings.urdf_markers import with_markers
from thirdhand.settings.config import Settings, robot_description, without_secrets

OBJECTS_NOTE = "objects"
CHECKSUMS = "checksums.u32"  # attachment with a little-endian number for each tick from 0 on
# a frame that changes one of these is kept
DECISIONS = ("mode", "reason", "flags", "commanded", "segment")
NOTED_US = 1000.0  # the timing of a tick that begins or ends this late is kept
SHOWN_HZ = 10.0  # rate of what other tools show, in a thin recording; a replay makes it anew
STATE_EVERY_S = 10.0  # interval of states in a thin recording; each takes 60 kB
FORMAT = "2"  # a recording with another layout of State or Frame cannot be replayed
_LATCHED_QOS = (
    "[{history: 1, depth: 1, reliability: 1, durability: 1, liveliness: 1, "
    "avoid_ros_namespace_conventions: false, deadline: {sec: 0, nsec: 0}, lifespan: {sec: 0, nsec: "
    "0}, liveliness_lease_duration: {sec: 0, nsec: 0}}]"
)


class Recorder(McapFile):
    """A recording that is being written; `flush` bounds what a kill can lose.

    With `checksums` (4 bytes for each tick number) frames may be left out. Such a file is not
    compressed, so that a version control system can store the differences of its versions.

    A `thin` recording holds what a replay needs to compute each frame again, and its checksum. It
    has `[recording] frames_hz` whole frames a second with their timing, those that change one of
    DECISIONS, and the timing of late ticks. What only viewers need, it has SHOWN_HZ times a second.
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
        constants: Mapping[str, str] | None = None,
        time_ns: int = 0,
        checksums: bytes = b"",
        thin: bool = False,
    ) -> None:
        self._urdf = robot_description(settings) if urdf is None else urdf
        self._settings = settings
        self.skill = skill  # the file of the skill in force
        self._state = state
        self._begun = False
        self._sequence = 0
        self._every = self._shown_every = self._state_every = 1  # [ticks]
        self._types: dict[str, str] = {}  # types of messages that differ from the table's
        self._tf_every = channels.BY_KEY["/tf"].every
        if thin:
            self._every = settings.frame_every
            self._state_every = round(STATE_EVERY_S * settings.rate_hz)
            self._shown_every = self._every * max(1, round(settings.recording.frames_hz / SHOWN_HZ))
            self._types = {"tick": channels.CHECKED_TICK.type}
            self._tf_every = self._shown_every
        self._decided: tuple[int, ...] = ()  # the newest frame's DECISIONS
        self._state_from = 0  # a state is due from this tick on
        self._frames = Frames(settings, self._urdf)
        self._topics = {
            channel.key: channels.topic(settings.cell, channel.key)
            for channel in channels.CHANNELS
            if channel.recorded
        }
        super().__init__(
            Path(path),
            joints=len(settings.joints.names),
            compressed=not checksums,
            has_wishes=settings.skill.has_wishes,
        )
        about = {
            "format": FORMAT,
            "cell": settings.cell,
            **(machine() if metadata is None else metadata),
        }
        about |= {f"constants of {stage}": digest for stage, digest in (constants or {}).items()}
        self.kept = self.pending = 0  # number of ticks in the file, and in the unfinished chunk
        try:
            self.writer.add_metadata("thirdhand", about)
            self.attach("settings.json", msgspec.json.encode(without_secrets(settings)), time_ns)
            self.attach("skill.npz", skill, time_ns)
            self.attach("arm.urdf", self._urdf.encode(), time_ns)
            if checksums:
                self.attach(CHECKSUMS, checksums, time_ns)
        except OSError:
            self.abandon()
            raise

    def _begin(self, time_ns: int) -> None:
        """Write the robot's description and the initial state, with the time of the first
        message.
        """
        self._begun = True
        self._put(
            "/robot_description",
            cdr.encode_string(with_markers(self._urdf)),
            time_ns,
            qos=_LATCHED_QOS,
        )
        if self._state is not None:
            self._put("state", encode(self._state), time_ns)

    def _put(self, key: str, data: bytes, time_ns: int, *, qos: str = "") -> None:
        """Write one message on a channel, in the type in which its events are recorded."""
        kind = self._types.get(key) or channels.BY_KEY[key].kept_as.type
        self.put(self._topics[key], kind, data, time_ns, self._sequence, qos=qos)

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
        last: bool = False,
    ) -> None:
        """Write a tick, its frame, and its published messages by key.

        After `lost` ticks that could not be recorded, a replay continues from `state` (after this
        tick) and `skill` (in force). The skill is written only if it differs from the last one. The
        `last` tick has its state, from which the next recording continues.
        """
        if not self._begun:
            self._begin(time_ns)
        self._sequence = tick.index
        self.pending += 1
        self._put_tick(tick, frame, lost, time_ns)

        kept_frame = self._kept(frame, lost)
        if kept_frame is not None:
            self._put("frame", encode(kept_frame), time_ns)
        if timing is not None and (kept_frame is frame or _is_noted(timing)):
            self._put("timing", encode(timing), time_ns)
        if state is not None and (lost or last or tick.index >= self._state_from):
            self._state_from = tick.index + self._state_every
            self._put("state", encode(state), time_ns)

        if skill is not None and skill != self.skill:
            self.skill = skill
            self._put("skill_in_force", cdr.encode_skill(skill), time_ns)
        self._put_drawn(kept_frame, outputs, time_ns)
        self.part_ends()

    def _put_tick(self, tick: Tick, frame: Record | None, lost: int, time_ns: int) -> None:
        """Write a tick's index, its events, and the checksum of its frame if some are left out."""
        recorded_sum = checksum(frame) if self._types and frame is not None else None
        kinds = [channels.EVENT_NUMBERS[event.kind] for event in tick.inbox]
        self._put("tick", cdr.encode_tick(tick.index, kinds, lost, recorded_sum), time_ns)
        for event in tick.inbox:
            payload = event.payload
            if event.kind == "skill":
                self.skill = payload
                payload = cdr.encode_skill(payload)
            self._put(event.kind, payload, time_ns)

    def _put_drawn(self, frame: Record | None, outputs: Outputs, time_ns: int) -> None:
        """Write what other programs draw of a tick: its published messages, and transforms."""
        index = self._sequence
        if index % self._shown_every == 0:
            for key, payload in outputs:
                self._put(key, payload, time_ns)
        if frame is not None and index % self._tf_every == 0:
            frames = [*self._frames.fixed, *self._frames.moving(frame, frame["joints"].tolist())]
            self._put("/tf", cdr.encode_transforms(time_ns, frames), time_ns)

    def _kept(self, frame: Record | None, lost: int) -> Record | None:
        """The frame if it is recorded as a whole."""
        if frame is None or self._every == 1:
            return frame
        before = self._decided
        self._decided = tuple(int(frame[name]) for name in DECISIONS)
        is_due = int(frame["tick"]) % self._every == 0
        return frame if lost or self._decided != before or is_due else None

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Write a text under `<cell>/<key>`, like `status`, `requests` or `log`, or objects in JSON
        under `objects`. A replay ignores it.
        """
        if key in REPLAYED:
            raise ValueError(
                f"a note under {key!r}: this topic is reserved for the data of a replay"
            )
        if not self._begun:
            self._begin(time_ns)
        if key == OBJECTS_NOTE:
            objects = msgspec.json.decode(text, type=tuple[SceneObject, ...])
            return self._put(key, channels.BY_KEY[key].codec.encode(time_ns, objects), time_ns)
        topic = channels.topic(self._settings.cell, key)
        self.put(topic, channels.STRING.type, cdr.encode_string(text), time_ns, self._sequence)
        return None

    def image(self, key: str, data: bytes, time_ns: int) -> None:
        """Write an image, the CDR bytes of a CompressedImage, under a whole key. A replay ignores
        it.
        """
        if not self._begun:
            self._begin(time_ns)
        self.put(f"/{key}", COMPRESSED_IMAGE, data, time_ns, self._sequence)

    def flush(self) -> None:
        super().flush()
        self.kept = self.kept + self.pending
        self.pending = 0

    def close(self) -> None:
        if not self.closed and not self._begun and self._state is not None:
            self._begin(0)
        super().close()


def _is_noted(timing: Record) -> bool:
    """True if a tick was so late, or took so long, that its timing is always recorded."""
    return bool(timing["lateness_us"] + timing["work_us"] >= NOTED_US)


def _summary_of(path: Path) -> Summary | None:
    """A file's summary; None if it is missing."""
    with path.open("rb") as stream, contextlib.suppress(McapError, struct.error, ValueError):
        return make_reader(stream).get_summary()
    return None


def _take_hint(path: Path) -> str:
    """The end of an error message for a file that is a take: the command that shows it."""
    contents = _summary_of(path)
    topics = [f"/{channel.topic}" for channel in contents.channels.values()] if contents else []
    if path.suffix != ".mcap" or not all(
        any(t.endswith(f"/{end}") for t in topics) for end in TAKE_KEYS.values()
    ):
        return ""
    name = shlex.quote(path.stem)
    folder = shlex.quote(str(path.parent))
    return f"; it is a take: thirdhand record {name} --folder {folder} --show --plot {name}.png"


def _is_cut(messages: Messages) -> bool:
    return any(fault.cut for fault in messages.faults)


def _lacks_parts(messages: Messages) -> bool:
    """True if a needed attachment is missing. A cut file without skill and arm has no ticks either;
    from a damaged one, a report can be made without.
    """
    needed = ["settings.json"]
    if _is_cut(messages):
        needed += ["skill.npz", "arm.urdf"]
    elif not messages.faults:
        needed += ["skill.npz"]
    return any(name not in messages.attachments for name in needed)


def _no_recording(path: Path, messages: Messages) -> str:
    """The message about a file that lacks settings or skill."""
    if _is_cut(messages):
        return f"{path} is cut before its first message ({messages.faults[-1].why})"
    if messages.faults:
        return f"{path} lacks its settings: {'; '.join(map(str, messages.faults))}"
    return (
        f"{path} is an MCAP file but not a recording of thirdhand: settings and skill are "
        "not attached" + _take_hint(path)
    )


class Recording:
    """A recording on disk: its settings, its skill, and its steps."""

    def __init__(
        self,
        path: Path,
        settings: Settings,
        attached: Mapping[str, bytes],
        metadata: dict[str, str],
        damage: str,
    ) -> None:
        self.path = path
        self.settings = settings
        self.metadata = metadata
        self.truncated = ends_early(path)
        self.skill = attached.get("skill.npz", b"")  # empty if it is damaged, and so is `urdf`
        self.urdf = attached.get("arm.urdf", b"").decode(errors="replace")
        self._damage = damage  # before the first message
        checksums = attached.get(CHECKSUMS, b"")
        self.checksums = dict(
            enumerate(np.frombuffer(checksums, "<u4", len(checksums) // 4).tolist())
        )
        self.faults: list[FileFault] = []  # complete once all steps are read

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """The recording in a file. Raises RecordingError."""
        path = existing(path)
        messages = Messages(path)
        next(iter(messages), None)
        about = messages.metadata.get("thirdhand")
        parts = messages.attachments
        if about is None or _lacks_parts(messages):
            raise RecordingError(_no_recording(path, messages))
        if about.get("format") != FORMAT:
            raise RecordingError(
                f"{path} has format {about.get('format')}; format {FORMAT} needed: was it made by "
                "another version?"
            )
        try:
            settings = validated(msgspec.json.decode(parts["settings.json"]), Settings)
        except (msgspec.DecodeError, InvalidError) as error:
            raise RecordingError(
                f"the settings in {path} are not valid: {in_words(error, named=False)}"
            ) from None
        return cls(path, settings, parts, about, "; ".join(map(str, messages.faults)))

    def require_whole(self) -> Self:
        """This recording. Raises RecordingError if its skill or its arm is damaged."""
        lacking = [name for name, part in (("skill", self.skill), ("arm", self.urdf)) if not part]
        if lacking and self._damage:
            part_names = " and ".join(lacking)
            raise RecordingError(
                f"{self.path} lacks its {part_names}; only a report does without: {self._damage}"
            )
        return self

    def ticks(self) -> int | None:
        """The number of ticks in the file's summary; None if the summary is missing."""
        topics = channels.keys_by_topic(self.settings.cell, ("tick",))
        contents = _summary_of(self.path)
        if contents is None or contents.statistics is None:
            return None
        numbers = [
            number for number, channel in contents.channels.items() if channel.topic in topics
        ]
        return sum(contents.statistics.channel_message_counts.get(number, 0) for number in numbers)

    def steps(self, *, outputs: bool = True, whole: bool = True) -> Iterator[Step]:
        """Every recorded tick in order, after the initial state if there is one.

        Without `outputs` only the inputs are read, also from versions with other frames and states.
        Raises RecordingError for messages that cannot be decoded, and if `whole` frames are
        required and the recording has checksums instead.
        """
        if outputs and whole and self.checksums:
            raise RecordingError(
                f"{self.path} has checksums instead of frames: thirdhand replay "
                f"{shlex.quote(str(self.path))} --output whole.mcap writes a recording with all "
                "frames"
            )
        messages = Messages(self.path)
        yield from steps(messages, self.settings, outputs=outputs, whole=not self.checksums)
        self.faults = [
            *messages.faults,
            *(fault for fault in self.faults if fault not in messages.faults),
        ]
        self.truncated = any(fault.cut for fault in messages.faults)

    def unreported(self, gaps: Iterable[Gap], *, last: int | None) -> list[str]:
        """Messages on the faults that no gap names, once all steps are read up to tick `last`."""
        reported = "".join(gap.why for gap in gaps)
        read = "no tick was read" if last is None else f"the last tick read is {last}"
        return [
            f"{self.path}: {fault}; {read}" for fault in self.faults if str(fault) not in reported
        ]

    def images(self) -> Iterator[tuple[str, CompressedImage, int]]:
        """Key, image and time of arrival [ns] of each image, in order."""
        for schema, channel, message in Messages(self.path):
            if full_name(schema) == COMPRESSED_IMAGE:
                with contextlib.suppress(WireError):  # of a format that is neither JPEG nor PNG
                    yield channel.topic.lstrip("/"), decode_image(message.data), message.log_time

    def notes(self, *keys: str) -> Iterator[tuple[str, str, int]]:
        """Key, text and time [ns] of the notes under these keys, in order; objects as JSON. Notes
        that cannot be decoded are `faults`.
        """
        topics = channels.keys_by_topic(self.settings.cell, keys)
        messages = Messages(self.path)
        for _, channel, message in messages:
            if (key := topics.get(channel.topic)) is None:
                continue
            try:
                content = (
                    channels.BY_KEY[key].codec.decode(message.data) if key == OBJECTS_NOTE else None
                )
                text = (
                    cdr.decode_string(message.data)
                    if content is None
                    else msgspec.json.encode(content).decode()
                )
            except WireError as error:
                messages.refuse(channel.topic, message, error)
                self.faults.append(messages.faults[-1])
            else:
                yield key, text, message.log_time
