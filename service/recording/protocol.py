"""The messages between control process and scribe: setup, ticks, notes and reports."""

from __future__ import annotations

import json
import struct
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from service.config import Settings
from service.contract.channels import CHANNELS, EVENT_KINDS, EVENT_NUMBERS
from service.core.frame import TIMING, Event, Record, Tick, frame_layout, state_layout
from service.core.outputs import Outputs

LONGEST_NOTE = 16_384  # characters; JSON may need six bytes for each
LARGEST_MESSAGE = 256 * 1024  # skills travel as files in memory instead

_TICK, NOTE = 1, 2
HEAD = struct.Struct("<BBHHIq")  # type, flags of what follows, number of events, of outputs, ticks lost before, index
_EVENT = struct.Struct("<BI")  # kind of an event or number of an output, bytes
_HAS_STATE, _HAS_SKILL = 1, 2
_ELSEWHERE = 0xFFFFFFFF  # as a size: the bytes are in a memory file that is sent along
_SKILL = EVENT_NUMBERS["skill"]
OUTPUT_KEYS = tuple(channel.key for channel in CHANNELS if channel.direction == "out")


class TickMessage(NamedTuple):
    """One tick as it is sent to the scribe; `lost` ticks before it were not sent."""

    tick: Tick
    frame: Record
    timing: Record
    state: Record | None
    skill: bytes | None
    lost: int
    outputs: Outputs = ()


def pack(
    tick: Tick,
    frame: Record,
    timing: Record,
    *,
    state: Record | None,
    lost: int,
    with_skill: bool,
    outputs: Outputs = (),
) -> bytes:
    """One message about a tick, without the bytes of skills."""
    head, bodies = [b""], []
    for event in tick.inbox:
        kind = EVENT_NUMBERS[event.kind]
        if kind == _SKILL:
            head.append(_EVENT.pack(kind, _ELSEWHERE))
        else:
            head.append(_EVENT.pack(kind, len(event.payload)))
            bodies.append(event.payload)
    follows = (_HAS_STATE if state is not None else 0) | (_HAS_SKILL if with_skill else 0)
    for key, payload in outputs:
        head.append(_EVENT.pack(OUTPUT_KEYS.index(key), len(payload)))
        bodies.append(payload)
    head[0] = HEAD.pack(_TICK, follows, len(tick.inbox), len(outputs), lost, tick.index)
    bodies += (frame.tobytes(), timing.tobytes())
    if state is not None:
        bodies.append(state.tobytes())
    return b"".join(head + bodies)


def unpack(message: bytes, skills: list[bytes], *, joints: int) -> TickMessage:
    """The tick in a message, for an arm with so many joints; `skills` are the files sent along, in
    order.
    """
    frame_type, state_type = frame_layout(joints), state_layout(joints)
    _, follows, count, sent, lost, index = HEAD.unpack_from(message)
    kinds = [_EVENT.unpack_from(message, HEAD.size + i * _EVENT.size) for i in range(count + sent)]
    at, files, inbox, outputs = HEAD.size + (count + sent) * _EVENT.size, iter(skills), [], []
    for kind, size in kinds[:count]:
        payload = next(files) if size == _ELSEWHERE else message[at : at + size]
        at += 0 if size == _ELSEWHERE else size
        inbox.append(Event(EVENT_KINDS[kind], payload, None))
    for number, size in kinds[count:]:
        outputs.append((OUTPUT_KEYS[number], message[at : at + size]))
        at += size
    frame: Record = np.frombuffer(message, frame_type, 1, at)[0]
    timing: Record = np.frombuffer(message, TIMING, 1, at + frame_type.itemsize)[0]
    at += frame_type.itemsize + TIMING.itemsize
    state: Record | None = np.frombuffer(message, state_type, 1, at)[0] if follows & _HAS_STATE else None
    skill = next(files) if follows & _HAS_SKILL else None
    return TickMessage(Tick(index, tuple(inbox)), frame, timing, state, skill, lost, tuple(outputs))


def pack_note(key: str, text: str, time_ns: int) -> bytes:
    """One message with a text for the recording, under `<cell>/<key>`."""
    return HEAD.pack(NOTE, 0, 0, 0, 0, time_ns) + json.dumps([key, text[:LONGEST_NOTE]]).encode()


def unpack_note(message: bytes) -> tuple[str, str, int] | None:
    """Key, text and time [ns] of a message with a text; None for one about a tick."""
    if message[0] != NOTE:
        return None
    key, text = json.loads(message[HEAD.size :])
    return key, text, HEAD.unpack_from(message)[5]


class ScribeSetup(msgspec.Struct, frozen=True):
    """The setup of a scribe; the skill is sent along as a memory file.

    Without state it begins with the first message that has one. `recording` and `rrd` are explicit
    paths instead of names in `folder`; `attempt` counts the scribes of one daemon.
    """

    settings: Settings
    state: bytes | None
    folder: str | None
    recording: str | None
    rrd: str | None
    live_port: int | None
    attempt: int


class ScribeReport(msgspec.Struct, frozen=True):
    """A scribe's report, twice a second: where it writes, and how many of the ticks sent to it are
    on disk (`kept`), how many never will be (`lost`), and how many of the lost ones no recording
    marks yet (`unmarked`).
    """

    state: Literal["starting", "recording", "interrupted", "drawing"] = "starting"
    recording: str | None = None
    rrd: str | None = None
    live: str | None = None
    kept: int = 0
    lost: int = 0
    unmarked: int = 0
    errors: tuple[str, ...] = ()  # new ones
    free_mb: float | None = None  # free space where it writes; None: it writes nothing
