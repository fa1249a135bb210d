"""The messages between control process and scribe: setup, ticks, notes and reports."""

from __future__ import annotations

from typing import Literal, NamedTuple

import msgspec
import numpy as np

from thirdhand.core.frame import TIMING, Event, Outputs, Record, Tick, frame_layout, state_layout
from thirdhand.settings.config import Settings

MAX_NOTE_LENGTH = 16_384  # [characters]
MAX_PACKET_BYTES = 256 * 1024  # skills are larger, and are sent as files in memory


class Note(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """A text for the recording, under `<cell>/<key>`, and its time [ns]."""

    key: str
    text: str
    time_ns: int


class ImageArrival(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """An image's key and time of arrival [ns]; its CDR bytes are sent as a memory file."""

    key: str
    time_ns: int
    data: bytes = b""


class _Tick(msgspec.Struct, frozen=True, tag=True, array_like=True):
    """One tick in bytes. A skill among its events is None, and is sent as a memory file. The last
    of these files is the skill in force if `with_skill`.
    """

    index: int
    lost: int
    events: list[tuple[str, bytes | None]]
    outputs: list[tuple[str, bytes]]
    frame: bytes
    timing: bytes
    state: bytes | None
    with_skill: bool


_MESSAGES = msgspec.msgpack.Decoder(_Tick | Note | ImageArrival)


class TickMessage(NamedTuple):
    """One tick as sent to the scribe; `lost` ticks before it were not sent."""

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
    """The message of a tick, without the bytes of skills."""
    events = [
        (event.kind, None if event.kind == "skill" else event.payload) for event in tick.inbox
    ]
    end = None if state is None else state.tobytes()
    sent = _Tick(
        tick.index, lost, events, list(outputs), frame.tobytes(), timing.tobytes(), end, with_skill
    )
    return msgspec.msgpack.encode(sent)


def unpack(
    message: bytes, skills: list[bytes], *, joints: int, has_wishes: bool = False
) -> TickMessage | Note | ImageArrival:
    """The tick, note or image in a message. `joints` is the arm's number of joints, whose state
    `has_wishes` where a policy leads; `skills` are the files sent with the message, in order.
    """
    sent = _MESSAGES.decode(message)
    files = iter(skills)
    if isinstance(sent, Note):
        return sent
    if isinstance(sent, ImageArrival):
        return msgspec.structs.replace(sent, data=next(files))
    inbox = tuple(
        Event(kind, next(files) if data is None else data, None) for kind, data in sent.events
    )
    frame: Record = np.frombuffer(sent.frame, frame_layout(joints))[0]
    timing: Record = np.frombuffer(sent.timing, TIMING)[0]
    state: Record | None = (
        None
        if sent.state is None
        else np.frombuffer(sent.state, state_layout(joints, has_wishes=has_wishes))[0]
    )
    skill = next(files) if sent.with_skill else None
    return TickMessage(
        Tick(sent.index, inbox), frame, timing, state, skill, sent.lost, sent.outputs
    )


def pack_note(key: str, text: str, time_ns: int) -> bytes:
    """The message of a text for the recording, cut to MAX_NOTE_LENGTH."""
    readable = text[:MAX_NOTE_LENGTH].encode(errors="replace").decode()
    return msgspec.msgpack.encode(Note(key, readable, time_ns))


def pack_image(key: str, time_ns: int) -> bytes:
    """The message of an image, without its bytes."""
    return msgspec.msgpack.encode(ImageArrival(key, time_ns))


class ScribeSetup(msgspec.Struct, frozen=True):
    """The setup of a scribe; the skill is sent with it as a memory file.

    Without state the scribe begins with the first message that has one. `recording` is an explicit
    path instead of names in `folder`. `attempt` counts the scribes of a daemon.
    `unmarked` ticks were lost with earlier scribes and are not marked in a recording yet.
    `constants` are `Controller.constants`.
    """

    settings: Settings
    state: bytes | None
    folder: str | None
    recording: str | None
    live_port: int | None
    attempt: int
    unmarked: int = 0
    constants: dict[str, str] = {}


class ScribeReport(msgspec.Struct, frozen=True):
    """A scribe's report, twice a second: the path of its file, and the numbers of ticks on disk
    (`kept`), of lost ticks (`lost`), and of lost ticks that no recording marks yet (`unmarked`).
    """

    state: Literal["starting", "recording", "interrupted", "drawing"] = "starting"
    recording: str | None = None
    live: str | None = None
    kept: int = 0
    lost: int = 0
    unmarked: int = 0
    errors: tuple[str, ...] = ()  # new error messages
    free_mb: float | None = None  # free space on the disk of the recording; None: it writes nothing
    mb_per_hour: float | None = None  # recent growth of recordings; None: not known yet
    # growth until each file takes an older one's place; None: without end
    keep_mb_left: float | None = None
