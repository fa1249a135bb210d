"""The steps of a recording, assembled from its messages: the input and the decision of each tick,
and the gaps.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

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
    names = channels.keys_by_topic(settings.cell, REPLAYED)
    joints = len(settings.joints.names)
    layouts = {"frame": frame_layout(joints), "timing": TIMING, "state": state_layout(joints)}
    step: dict[str, Any] | None = None
    fault_count = 0
    damage = ""
    refused: set[str] = set()  # keys of which a message was not decoded
    readable: set[str] = set()  # keys of which a message was decoded

    def finished() -> Iterator[Step]:
        """The step in progress, unless a part of it is damaged or cut."""
        if step is None:
            return
        numbers = step.pop("kinds")
        came = [kind for kind, _ in step["events"]]
        lacks_frame = outputs and whole and "frame" not in step and step["checksum"] is None
        if len(messages.faults) > fault_count and (len(came) != len(numbers) or lacks_frame):
            return
        kinds = [_kind(number) for number in numbers]
        if came != kinds or lacks_frame:
            frame = "a" if "frame" in step else "no"
            raise WireError(f"tick {step['tick']} lists {kinds}; {came} and {frame} frame follow")
        yield Step(**step | {"events": tuple(step["events"])})

    try:
        for _, channel, message in messages:
            if len(messages.faults) > fault_count:
                yield from finished()
                damage = "; ".join(str(fault) for fault in messages.faults[fault_count:])
                step = None
                fault_count = len(messages.faults)
            name = names.get(channel.topic)
            if name is None or (name in _RECORDS and not outputs):
                continue
            try:
                value = _value(name, message.data, layouts)
            except WireError as error:
                if name in refused - readable and name in _RECORDS:
                    raise
                refused.add(name)
                messages.refuse(channel.topic, message, error)
                step = step if name == "tick" else None
                continue
            readable.add(name)
            if name == "tick":
                yield from finished()
                index, kinds, lost, recorded_sum = value
                step = {
                    "tick": index,
                    "kinds": kinds,
                    "events": [],
                    "lost": lost,
                    "time_ns": message.log_time,
                }
                step["damage"] = damage
                step["checksum"] = recorded_sum
                damage = ""
            elif step is None:
                if name == "state":
                    yield Step(int(value["tick"]), state=value, damage=damage)
                    damage = ""
            elif name in _RECORDS:
                step[name] = value
            elif name == "skill_in_force":
                step["skill"] = value
            else:
                step["events"].append((name, value))
        yield from finished()
    except WireError as error:
        raise RecordingError(
            f"{messages.path}: after tick {step['tick'] if step else 'none'}: {error}"
        ) from None


def _value(name: str, data: bytes, layouts: dict[str, Any]) -> Any:
    """The content of a message: of an event its bytes, which can be decoded. Raises WireError."""
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
