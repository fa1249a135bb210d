"""The messages between control process and scribe: setup, ticks, notes and reports."""

from __future__ import annotations

from typing import Literal, NamedTuple

import msgspec
import numpy as np

from service.core.frame import TIMING, Event, Outputs, Record, Tick, frame_layout, state_layout
from service.settings.config import Settings

LONGEST_NOTE = 16_384  # characters
LARGEST_MESSAGE = 256 * 1024  # skills travel as files in memory instead


class Note(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """A text for the recording, under `<cell>/<key>`, and its time [ns]."""

    key: str
    text: str
    time_ns: int


class _Tick(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """One tick in bytes. A skill among its events is None: it is in a memory file sent along, of
    which the last is the skill in force if `with_skill`.
    """

    index: int
    lost: int
    events: list[tuple[str, bytes | None]]
    outputs: list[tuple[str, bytes]]
    frame: bytes
    timing: bytes
    state: bytes | None
    with_skill: bool


_MESSAGES = msgspec.msgpack.Decoder(_Tick | Note)


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
    events = [(event.kind, None if event.kind == "skill" else event.payload) for event in tick.inbox]
    end = None if state is None else state.tobytes()
    told = _Tick(tick.index, lost, events, list(outputs), frame.tobytes(), timing.tobytes(), end, with_skill)
    return msgspec.msgpack.encode(told)


def unpack(message: bytes, skills: list[bytes], *, joints: int) -> TickMessage | Note:
    """The tick, for an arm with so many joints, or the note in a message; `skills` are the files
    sent along, in order.
    """
    told, files = _MESSAGES.decode(message), iter(skills)
    if isinstance(told, Note):
        return told
    inbox = tuple(Event(kind, next(files) if data is None else data, None) for kind, data in told.events)
    frame: Record = np.frombuffer(told.frame, frame_layout(joints))[0]
    timing: Record = np.frombuffer(told.timing, TIMING)[0]
    state: Record | None = None if told.state is None else np.frombuffer(told.state, state_layout(joints))[0]
    skill = next(files) if told.with_skill else None
    return TickMessage(Tick(told.index, inbox), frame, timing, state, skill, told.lost, told.outputs)


def pack_note(key: str, text: str, time_ns: int) -> bytes:
    """One message with a text for the recording, cut to LONGEST_NOTE."""
    readable = text[:LONGEST_NOTE].encode(errors="replace").decode()
    return msgspec.msgpack.encode(Note(key, readable, time_ns))


class ScribeSetup(msgspec.Struct, frozen=True):
    """The setup of a scribe; the skill is sent along as a memory file.

    Without state it begins with the first message that has one. `recording` and `rrd` are explicit
    paths instead of names in `folder`; `attempt` counts the scribes of one daemon; `unmarked` ticks
    were lost with those before, and no recording marks them yet.
    """

    settings: Settings
    state: bytes | None
    folder: str | None
    recording: str | None
    rrd: str | None
    live_port: int | None
    attempt: int
    unmarked: int = 0


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
    mb_per_hour: float | None = None  # of recordings and drawings lately; None: not known yet
    keep_mb_left: float | None = None  # that they may grow by before the oldest are removed; None: they are not
