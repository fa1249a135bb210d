"""The steps of a recording, assembled from its messages: the input and the decision of each tick,
and the gaps.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from mcap.records import Message

from thirdhand.contract import cdr, channels
from thirdhand.contract.messages import WireError
from thirdhand.core.frame import (
    TIMING,
    Frame,
    Outputs,
    Record,
    decode,
    encode,
    frame_layout,
    state_layout,
)
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.mcap_reader import Messages
from thirdhand.settings.config import Settings

_RECORDS = ("frame", "timing", "state")
REPLAYED = {*channels.EVENT_NUMBERS, *_RECORDS, "tick", "skill_in_force"}


class Step(NamedTuple):
    """One recorded tick: its events, its frame, and the state after it if recorded.

    A step without `frame` holds only a state, before the first tick or after damage; or its frame
    was left out, and the step or the recording has its `checksum`.
    If ticks were `lost` before this one, a replay continues from its `state` with the skill in
    force, which is recorded again if it may have changed. `damage` is the reason why messages
    before this step cannot be read; empty if all were read.
    """

    tick: int
    events: tuple[tuple[str, bytes], ...] = ()
    frame: Record | None = None
    timing: Record | None = None
    state: Record | None = None
    skill: bytes | None = None
    lost: int = 0
    time_ns: int = 0
    damage: str = ""
    checksum: int | None = None


@dataclass
class Gap:
    """Missing ticks: the ticks before and after them (None: the begin or end of the recording), the
    number counted as lost, and the reason.
    """

    after: int | None
    before: int | None
    lost: int
    why: str

    def __str__(self) -> str:
        where = "before the first tick" if self.after is None else f"after tick {self.after}"
        if self.before is not None:
            where = (
                f"before tick {self.before}"
                if self.after is None
                else f"{where}, before tick {self.before}"
            )
        lost = f"{self.lost} tick{'s' * (self.lost != 1)} not recorded" if self.lost else ""
        return f"gap {where}: {'; '.join(part for part in (lost, self.why) if part)}"


def checksum(frame: Frame, outputs: Outputs = (), state: Record | None = None) -> int:
    """A checksum (32 bits) of a tick's frame, and of its published messages and the state after it
    if given.
    """
    parts = (
        encode(frame),
        *(payload for _, payload in outputs),
        b"" if state is None else encode(state),
    )
    return zlib.crc32(b"".join(parts))


def steps(messages: Messages, settings: Settings, *, outputs: bool, whole: bool) -> Iterator[Step]:
    """Every complete tick in order, after the initial state if there is one.

    Without `outputs` only the inputs are read. If `whole`, each tick must have its frame. A message
    that cannot be decoded is a fault of the file, and its tick is damaged. Raises RecordingError
    for ticks that do not fit their messages, and for frames and states of another version, none of
    which can be decoded.
    """
    assembly = _Assembly(messages, settings, outputs=outputs, whole=whole)
    try:
        yield from assembly.steps()
    except WireError as error:
        raise RecordingError(f"{messages.path}: after tick {assembly.tick}: {error}") from None


class _Assembly:
    """Steps in the making, from the messages of a recording."""

    def __init__(
        self, messages: Messages, settings: Settings, *, outputs: bool, whole: bool
    ) -> None:
        joints = len(settings.joints.names)
        self._layouts = {
            "frame": frame_layout(joints),
            "timing": TIMING,
            "state": state_layout(joints, has_wishes=settings.skill.has_wishes),
        }
        replayed = REPLAYED if outputs else REPLAYED.difference(_RECORDS)
        self._names = channels.keys_by_topic(settings.cell, replayed)
        self._messages = messages
        self._needs_frames = outputs and whole
        self._step: dict[str, Any] | None = None
        self._fault_count = 0  # faults of the file before the step
        self._damage = ""  # before the next step
        self._refused: set[str] = set()  # keys of which a message was not decoded
        self._readable: set[str] = set()  # keys of which a message was decoded

    @property
    def tick(self) -> int | str:
        """The index of the tick in progress, or `none`."""
        return self._step["tick"] if self._step else "none"

    @property
    def _is_damaged(self) -> bool:
        return len(self._messages.faults) > self._fault_count

    def steps(self) -> Iterator[Step]:
        """Every complete tick in order, and the initial state. Raises WireError."""
        for _, channel, message in self._messages:
            if self._is_damaged:
                yield from self._interrupted()
            name = self._names.get(channel.topic)
            value = None if name is None else self._decoded(name, channel.topic, message)
            if name is None or value is None:
                continue

            if name == "tick":
                yield from self._finished()
                self._begin(value, message.log_time)
            elif self._step is not None:
                self._add(name, value)
            elif name == "state":
                yield Step(int(value["tick"]), state=value, damage=self._damage)
                self._damage = ""
        yield from self._finished()

    def _interrupted(self) -> Iterator[Step]:
        """The step before a fault of the file; the damage is noted for the next one."""
        yield from self._finished()
        faults = self._messages.faults
        self._damage = "; ".join(map(str, faults[self._fault_count :]))
        self._step = None
        self._fault_count = len(faults)

    def _decoded(self, name: str, topic: str, message: Message) -> Any:
        """The content of a message; None if it is damaged. Raises WireError for a record if no
        record of its kind can be decoded.
        """
        try:
            value = _value(name, message.data, self._layouts)
        except WireError as error:
            if name in self._refused - self._readable and name in _RECORDS:
                raise
            self._refused.add(name)
            self._messages.refuse(topic, message, error)
            if name != "tick":
                self._step = None
            return None
        self._readable.add(name)
        return value

    def _begin(self, tick: Any, time_ns: int) -> None:
        """Begin the step of a tick's message."""
        index, kinds, lost, recorded_sum = tick
        self._step = {
            "tick": index,
            "kinds": kinds,
            "events": [],
            "lost": lost,
            "time_ns": time_ns,
            "damage": self._damage,
            "checksum": recorded_sum,
        }
        self._damage = ""

    def _add(self, name: str, value: Any) -> None:
        """Add a record, the skill in force or an event to the step in progress."""
        assert self._step is not None
        if name in _RECORDS:
            self._step[name] = value
        elif name == "skill_in_force":
            self._step["skill"] = value
        else:
            self._step["events"].append((name, value))

    def _finished(self) -> Iterator[Step]:
        """The step in progress, unless a part of it is damaged or cut. Raises WireError."""
        step = self._step
        if step is None:
            return
        numbers = step.pop("kinds")
        recorded = [kind for kind, _ in step["events"]]
        lacks_frame = self._needs_frames and "frame" not in step and step["checksum"] is None
        if self._is_damaged and (len(recorded) != len(numbers) or lacks_frame):
            return
        kinds = [_kind(number) for number in numbers]
        if recorded != kinds or lacks_frame:
            frame = "a" if "frame" in step else "no"
            raise WireError(
                f"tick {step['tick']} lists {kinds}; {recorded} and {frame} frame follow"
            )
        yield Step(**step | {"events": tuple(step["events"])})


def _value(name: str, data: bytes, layouts: dict[str, Any]) -> Any:
    """The content of a message; for an event its bytes, which were decoded. Raises WireError."""
    channel = channels.BY_KEY[name]
    if name == "tick":
        return cdr.decode_tick(data)
    if name in _RECORDS:
        return decode(data, layouts[name])
    if name in ("skill", "skill_in_force"):
        return cdr.decode_skill(data)
    if channel.direction == "in":
        channel.codec.decode(data)
    return data


def _kind(number: int) -> str:
    if number not in channels.EVENT_KINDS:
        raise WireError(
            f"a Tick with an event of kind {number}; {len(channels.EVENT_KINDS)} are known"
        )
    return channels.EVENT_KINDS[number]
