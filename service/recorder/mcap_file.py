"""MCAP files as we write and read them: profile `ros2`, small chunks, and a reader that goes on up
to where a file was cut.
"""

from __future__ import annotations

import contextlib
import platform
import struct
from collections.abc import Iterator
from importlib import metadata as packages
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from service.contract.explain import ExplainedError
from service.contract.ros2msg import schema

CHUNK_BYTES = 128 * 1024  # what a kill can lose between two flushes, and what a reader must hold
_CUT = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    UnicodeDecodeError,
    ValueError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
)


class RecordingError(ExplainedError, ValueError):
    """A file that is not the recording it should be: says which, why, and what would do."""


def machine() -> dict[str, str]:
    """What the result of a tick may depend on besides its input: versions, CPU, BLAS."""
    found = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "cpu": platform.processor() or platform.machine(),
    }
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        found["cpu"] = next(
            (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), found["cpu"]
        )
    build: Any = np.show_config(mode="dicts")
    blas = build["Build Dependencies"]["blas"]
    found["blas"] = f"{blas['name']} {blas['version']}"
    for name in ("thirdhand", "numpy", "scipy", "pin", "ruckig", "msgspec", "mcap", "eclipse-zenoh"):
        with contextlib.suppress(packages.PackageNotFoundError):
            found[name] = packages.version(name)
    return found


class McapFile:
    """An MCAP file being written: profile `ros2`, zstd, small chunks, channels made as they are
    needed.
    """

    def __init__(self, path: Path, *, joints: int) -> None:
        """`joints` is how many the arm has: the layouts of what is recorded of it depend on it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._stream: IO[bytes] = path.open("wb")
        self.writer = Writer(self._stream, chunk_size=CHUNK_BYTES)
        self.writer.start(profile="ros2", library="thirdhand")
        self._joints = joints
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def put(self, topic: str, kind: str, data: bytes, time_ns: int, sequence: int, *, qos: str = "") -> None:
        """Writes one CDR message of the type `kind`."""
        channel = self._channels.get(topic)
        if channel is None:
            if kind not in self._schemas:
                self._schemas[kind] = self.writer.register_schema(
                    kind, "ros2msg", schema(kind, joints=self._joints).encode()
                )
            channel = self.writer.register_channel(topic, "cdr", self._schemas[kind], {"offered_qos_profiles": qos})
            self._channels[topic] = channel
        self.writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)

    def flush(self) -> None:
        """Ends the chunk in progress: what was written so far survives a kill of the process."""
        self.writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Ends the file; it is closed even if its end cannot be written."""
        if not self._stream.closed:
            try:
                self.writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self._stream.close()


def existing(path: str | Path) -> Path:
    """The path of a recording that is there.

    Raises RecordingError with the names of those that are.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is a folder, a recording needed")
    if not path.is_file():
        there = sorted(found.name for found in path.parent.glob("*.mcap"))
        names = f" There are: {', '.join(there)}." if there else ""
        raise RecordingError(f"no recording {path}.{names}")
    with path.open("rb") as stream:
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"{path} is not an MCAP file")
    return path


def ends_early(path: Path) -> bool:
    """Whether an MCAP file was cut: its closing bytes are missing."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MCAP0_MAGIC)))
        return stream.read() != MCAP0_MAGIC or size < 2 * len(MCAP0_MAGIC)


class Messages:
    """The schema, channel and message of every message of an MCAP file in file order, up to the end
    or the cut; `.cut` tells which it was.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.cut = ""
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def __iter__(self) -> Iterator[tuple[Schema | None, Channel, Message]]:
        found: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self._path.open("rb") as stream:
            records = iter(
                StreamReader(stream, record_size_limit=self._path.stat().st_size, validate_crcs=True).records
            )
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except _CUT as error:
                    self.cut = f"{type(error).__name__} {error}".strip()
                    return
                if isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    yield found.get(channel.schema_id), channel, record
                elif isinstance(record, Schema):
                    found[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data
                elif isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                elif isinstance(record, DataEnd):
                    return


def next_whole(
    messages: Iterator[tuple[Schema | None, Channel, Message]], path: Path
) -> tuple[Schema | None, Channel, Message] | None:
    """The next message of an indexed file, None at its end.

    Raises RecordingError where the file is damaged.
    """
    try:
        return next(messages, None)
    except _CUT as error:
        raise RecordingError(f"{path} is damaged: {type(error).__name__} {error}".strip()) from None
