"""Reading of MCAP files: it verifies every checksum, reads up to a cut, and continues after
damage.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

LARGEST_CHUNK_BYTES = 64 << 20  # unpacked; recorders write some MB at most
Found = tuple[Schema | None, Channel, Message]
_HEAD = struct.Struct("<BQ")  # opcode, number of the following bytes
_FOOTER = struct.Struct("<BQQQI")  # head, summary, summary offsets, checksum
_COMPRESSION = re.compile(b"\x04\0\0\0zstd|\x03\0\0\0lz4")
_BEFORE_COMPRESSION = _HEAD.size + 28  # [bytes] offset of the name of the compression in a chunk
_BLOCK = 1 << 20
# records that are read by their type alone, beside chunks, messages and attachments
_NAMING = {
    int(kind): record
    for kind, record in (
        (Opcode.SCHEMA, Schema),
        (Opcode.CHANNEL, Channel),
        (Opcode.METADATA, Metadata),
    )
}
# errors of a damaged record
_BROKEN = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    LookupError,
    OverflowError,
    MemoryError,
)


class FileFault(NamedTuple):
    """A part of a file that cannot be read: first byte, size [bytes], cause.

    If `cut`, the end of the file is missing; else the file continues after the damage.
    """

    cut: bool
    at: int
    size: int
    why: str

    def __str__(self) -> str:
        if self.cut:
            return f"cut at byte {self.at}: the end is missing ({self.why})"
        return f"damage at byte {self.at}: {self.size} bytes cannot be trusted ({self.why})"


class Messages:
    """An iterable over schema, channel and message of every message of an MCAP file in file order.

    `faults`, `attachments` and `metadata` hold those read so far. A new fault lies before the next
    message. Attachments with a wrong checksum are left out.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.faults: list[FileFault] = []
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def __iter__(self) -> Iterator[Found]:
        with self.path.open("rb") as stream:
            self._reading = reading = _Reading(stream, self.faults)
            schemas: dict[int, Schema] = {}
            channels: dict[int, Channel] = {}
            unnamed = False
            for record in itertools.chain(reading.named_in_summary(), reading.records()):
                if isinstance(record, Message):
                    channel = channels.get(record.channel_id)
                    if channel is not None:
                        yield schemas.get(channel.schema_id), channel, record
                    elif not unnamed:
                        unnamed = True
                        why = f"messages on channel {record.channel_id}, whose name is missing"
                        self.faults.append(FileFault(False, stream.tell(), 0, why))
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data
                elif isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata

    def refuse(self, topic: str, message: Message, error: Exception) -> None:
        """Note as a fault that the newest message cannot be decoded."""
        why = f"a message on {topic}: {error}"
        self.faults.append(FileFault(False, self._reading.at, len(message.data), why))


class _Reading:
    """One pass over a file."""

    def __init__(self, stream: IO[bytes], faults: list[FileFault]) -> None:
        self._stream = stream
        self._faults = faults
        self._size = stream.seek(0, 2)
        # None after damage
        self._checksum: int | None = zlib.crc32(self._bytes(0, len(MCAP0_MAGIC)))
        self._chunked = False
        self.at = 0  # first byte of the record that is read
        closing = self._size - len(MCAP0_MAGIC)
        self._closed = (
            closing >= len(MCAP0_MAGIC) and self._bytes(closing, len(MCAP0_MAGIC)) == MCAP0_MAGIC
        )
        self._footer_at = closing - _FOOTER.size
        self._footer = self._bytes(self._footer_at, _FOOTER.size) if self._footer_at > 0 else b""
        self._closed = self._closed and self._footer[:9] == _HEAD.pack(
            Opcode.FOOTER, _FOOTER.size - _HEAD.size
        )

    def named_in_summary(self) -> Iterator[McapRecord]:
        """The schemas and channels in the file's summary, if that is intact: they are needed if the
        chunk that first held them is damaged.
        """
        offset = self._summary() if self._closed else 0
        while 0 < offset < self._footer_at:
            opcode, end = self._head(offset)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._parsed(opcode, self._content(offset, end))
            offset = end

    def _summary(self) -> int:
        """The first byte of the summary if its checksum is right, else 0."""
        _, _, start, _, checksum = _FOOTER.unpack(self._footer)
        if not 0 < start <= self._footer_at or not checksum:
            return 0
        covered = self._bytes(start, self._footer_at + _FOOTER.size - 4 - start)
        return int(start) if zlib.crc32(covered) == checksum else 0

    def records(self) -> Iterator[McapRecord]:
        """The records of the data section, with those in chunks one by one."""
        offset = len(MCAP0_MAGIC)
        while True:
            self.at = offset
            end = None
            try:
                opcode, end = self._head(offset)
                content = self._content(offset, end)
                entries = self._parsed(opcode, content)
            except _BROKEN as error:
                self._checksum = None
                resume_at = self._resume_at(offset, end)
                why = str(error) or type(error).__name__
                if resume_at is None:
                    self._faults.append(
                        FileFault(not self._closed, offset, self._size - offset, why)
                    )
                    return
                self._faults.append(FileFault(False, offset, resume_at - offset, why))
                offset = resume_at
                continue
            if self._checksum is not None:
                self._checksum = zlib.crc32(
                    content, zlib.crc32(_HEAD.pack(opcode, len(content)), self._checksum)
                )
            yield from entries
            if opcode == Opcode.DATA_END:
                self._end(end)
                return
            offset = end

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode and end of the record at a byte."""
        if at + _HEAD.size > self._size:
            raise ValueError("the file ends before the recording does")
        opcode, length = _HEAD.unpack(self._bytes(at, _HEAD.size))
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END and opcode < 0x80:
            raise ValueError(f"MCAP has no record of type {opcode}")
        if at + _HEAD.size + length > self._size:
            raise ValueError(f"a record of {length} bytes reaches beyond the end of the file")
        return opcode, at + _HEAD.size + length

    def _parsed(self, opcode: int, content: bytes) -> list[McapRecord]:
        """The records in one record, its checksum verified; several for a chunk."""
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.CHUNK:
            self._chunked = True
            return _records_in(Chunk.read(stream))
        if _COMPRESSION.match(content, 28):
            raise ValueError(f"the content is a chunk, the head has type {opcode}")
        if opcode == Opcode.MESSAGE:
            if self._chunked:
                raise ValueError("a message outside the chunks")
            return [Message.read(stream, len(content))]
        if opcode == Opcode.ATTACHMENT:
            checksum = int.from_bytes(content[-4:], "little")
            if checksum and zlib.crc32(content[:-4]) != checksum:
                raise ValueError("an attachment's checksum is wrong")
            return [Attachment.read(stream)]
        if opcode == Opcode.DATA_END:
            self._verify_data(DataEnd.read(stream).data_section_crc)
        return [_NAMING[opcode].read(stream)] if opcode in _NAMING else []

    def _verify_data(self, recorded: int) -> None:
        """Note a fault if the recorded checksum over all data is wrong; 0: none is recorded."""
        if recorded and self._checksum is not None and recorded != self._checksum:
            why = (
                "the checksum over all data is wrong, and those of chunks and attachments are right"
            )
            self._faults.append(FileFault(False, 0, self._stream.tell(), why))

    def _resume_at(self, at: int, end: int | None) -> int | None:
        """The byte at which reading continues after a broken record: its end if a record begins
        there, else the next whole chunk; None if there is none.
        """
        if end is not None:
            with contextlib.suppress(ValueError):
                self._head(end)
                return end
        for block_at in range(at + 1, self._size, _BLOCK):
            block = self._bytes(block_at, _BLOCK + _BEFORE_COMPRESSION + 8)
            for mark in _COMPRESSION.finditer(block):
                chunk_at = block_at + mark.start() - _BEFORE_COMPRESSION
                if chunk_at > at and self._is_chunk(chunk_at):
                    return chunk_at
        return None

    def _is_chunk(self, at: int) -> bool:
        try:
            opcode, end = self._head(at)
            if opcode == Opcode.CHUNK:
                _records_in(Chunk.read(ReadDataStream(BytesIO(self._content(at, end)))))
        except _BROKEN:
            return False
        return opcode == Opcode.CHUNK

    def _end(self, at: int) -> None:
        """Verify the part after the data section."""
        if self._closed:
            _, _, start, _, checksum = _FOOTER.unpack(self._footer)
            if checksum and start and not self._summary():
                self._faults.append(
                    FileFault(False, at, self._size - at, "the summary's checksum is wrong")
                )
        else:
            whole = self._footer[:1] == bytes([Opcode.FOOTER])
            why = "the closing bytes are not those of MCAP" if whole else "nothing closes the file"
            self._faults.append(FileFault(not whole, at, self._size - at, why))

    def _content(self, at: int, end: int) -> bytes:
        return self._bytes(at + _HEAD.size, end - at - _HEAD.size)

    def _bytes(self, at: int, count: int) -> bytes:
        self._stream.seek(at)
        return self._stream.read(count)


def _records_in(chunk: Chunk) -> list[McapRecord]:
    """The records in a chunk. Raises ValueError for one of more than LARGEST_CHUNK_BYTES, which is
    not unpacked, and for a wrong checksum.
    """
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    elif chunk.compression == "lz4":  # its frame need not name its size
        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(
            chunk.data, max_length=LARGEST_CHUNK_BYTES + 1
        )
        chunk = replace(chunk, compression="", data=unpacked)
        size = len(unpacked)
    if size > LARGEST_CHUNK_BYTES:
        raise ValueError(
            f"a chunk of more than {LARGEST_CHUNK_BYTES >> 20} MiB is not unpacked: recorders "
            "write less"
        )
    return breakup_chunk(chunk, validate_crc=True)


def full_name(schema: Schema | None) -> str:
    """The full name of a type, `geometry_msgs/msg/PoseStamped` also for
    `geometry_msgs/PoseStamped`; empty without a schema.
    """
    kind = "" if schema is None else schema.name
    return kind if "/msg/" in kind else kind.replace("/", "/msg/", 1)
