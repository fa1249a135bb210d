"""Damaged files: any wrong byte is detected, damage is distinguished from a cut, and the messages
behind it are read.
"""

from __future__ import annotations

import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from support.recorded import drawn, write
from thirdhand.core.frame import encode
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay
from thirdhand.recordings.steps import Step
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.cli.view import convert
from thirdhand.workbench.report.report import reported
from thirdhand.workbench.takes.demonstration_reader import (
    hand_samples,
    read_demonstration,
    write_demonstration,
)

COUNT = 600


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of 600 ticks in a dozen chunks."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    write(path, COUNT)
    return path.read_bytes()


@pytest.fixture(scope="module")
def frames(whole: bytes, tmp_path_factory: pytest.TempPathFactory) -> dict[int, bytes]:
    """The frames of `whole` by their ticks."""
    _, steps = read(tmp_path_factory.mktemp("frames") / "a.mcap", whole)
    return {step.tick: encode(step.frame) for step in steps if step.frame is not None}


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Opcode, first byte and end of every record."""
    spans = []
    offset = 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        spans.append((opcode, offset, offset + 9 + length))
        offset += 9 + length
    return spans


def chunks(data: bytes) -> list[tuple[int, int]]:
    return [(start, end) for opcode, start, end in records(data) if opcode == Opcode.CHUNK]


def flipped(data: bytes, at: int, mask: int = 0xFF) -> bytes:
    out = bytearray(data)
    out[at] ^= mask
    return bytes(out)


def read(path: Path, data: bytes) -> tuple[Recording, list[Step]]:
    path.write_bytes(data)
    recording = Recording.open(path)
    return recording, list(recording.steps())


@pytest.mark.parametrize("at", [0, 1, 3, 8, 17, 28, 34, 40, 70])
@pytest.mark.parametrize("which", [0, 5, -1])
def test_what_follows_a_damaged_chunk_is_read(
    tmp_path: Path, whole: bytes, frames: dict[int, bytes], which: int, at: int
) -> None:
    """The damage is anywhere in a chunk or in its header: at most its ticks are missing, and they
    are reported.
    """
    recording, steps = read(tmp_path / "a.mcap", flipped(whole, chunks(whole)[which][0] + at, 0x11))
    assert not recording.truncated
    assert len(recording.faults) >= 1
    assert all("damage at byte" in str(fault) for fault in recording.faults)
    read_ticks = [step.tick for step in steps if step.frame is not None]
    assert all(encode(step.frame) == frames[step.tick] for step in steps if step.frame is not None)
    missing = sorted(set(range(COUNT)) - set(read_ticks))
    assert missing == (list(range(missing[0], missing[-1] + 1)) if missing else [])
    # errors at these bytes show only in the checksum of all data
    assert missing or at in (1, 17, 28)
    assert len(missing) <= 60
    if missing and missing[-1] < COUNT - 1:
        (behind,) = (step for step in steps if step.damage)
        assert behind.tick == missing[-1] + 1


def test_every_byte_counts(tmp_path: Path, whole: bytes) -> None:
    random = np.random.default_rng(3)
    refused: list[str] = []
    starts = [start for _, start, _ in records(whole)]
    for offset in [
        *random.integers(8, len(whole), 40).tolist(),
        *(start + 3 for start in starts[:60:4]),
        len(whole) - 4,
    ]:
        try:
            recording, steps = read(tmp_path / "a.mcap", flipped(whole, offset, 0x10))
        except RecordingError as error:
            refused.append(str(error))
            continue
        assert recording.faults, f"byte {offset}"
        assert not recording.truncated, f"byte {offset}"
        assert len(steps) > COUNT * 0.8
    assert refused
    assert all("lacks its settings: " in error for error in refused)


@pytest.mark.parametrize("compression", ["zstd", "zstd of another size", "lz4"])
def test_a_chunk_that_would_fill_the_memory_is_not_unpacked(
    tmp_path: Path, whole: bytes, compression: str
) -> None:
    size = 100 << 20
    zeros = bytes(size)
    packed = lz4.frame.compress(zeros) if compression == "lz4" else zstandard.compress(zeros)
    told_size = size if compression == "zstd" else 1000
    name = compression[:4].encode()
    body = (
        struct.pack("<QQQII", 0, 1 << 63, told_size, 0, len(name))
        + name
        + struct.pack("<Q", len(packed))
        + packed
    )
    begin, _ = chunks(whole)[0]
    bomb = struct.pack("<BQ", Opcode.CHUNK, len(body)) + body
    recording, steps = read(tmp_path / "a.mcap", whole[:begin] + bomb + whole[begin:])
    assert "a chunk of more than 64 MiB is not unpacked" in str(recording.faults[0])
    assert sum(step.frame is not None for step in steps) == COUNT


def test_a_recording_whose_skill_is_damaged_says_so(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "a.mcap"
    for offset in (whole.index(b"skill.npz") + 300, whole.index(b"arm.urdf") + 300):
        path.write_bytes(flipped(whole, offset))
        for use in (replay, lambda path: convert(path, tmp_path / "a.rrd")):
            with pytest.raises(
                RecordingError, match=r"lacks its (skill|arm); .*an attachment's checksum is wrong"
            ):
                use(path)
        columns = reported(path).columns
        assert columns.ticks.tolist() == list(range(COUNT))
        assert any("an attachment's checksum is wrong" in gap for gap in columns.gaps)
    path.write_bytes(flipped(whole, whole.index(b"settings.json") + 300))
    with pytest.raises(
        RecordingError, match=r"lacks its settings: .*an attachment's checksum is wrong"
    ):
        Recording.open(path)


def test_nothing_is_learned_or_played_from_damage_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_demonstration(
        path,
        Demonstration(np.arange(3000) * 10_000_000, *np.random.default_rng(1).random((3, 3000, 7))),
    )
    start, end = chunks(path.read_bytes())[0]
    path.write_bytes(flipped(path.read_bytes(), (start + end) // 2))
    with pytest.raises(
        RecordingError, match=r"damage at byte .* no poses can be read; nothing is learned"
    ):
        read_demonstration(path)
    with pytest.raises(RecordingError, match="is damaged"):
        list(hand_samples(path))


@pytest.mark.parametrize("kind", ["damaged", "cut"])
def test_drawing_names_what_is_missing(tmp_path: Path, whole: bytes, kind: str) -> None:
    """The drawing names the same gap as a replay, and shows all other ticks."""
    path = tmp_path / "a.mcap"
    remarks = list[str]()
    start, end = chunks(whole)[5]
    path.write_bytes(
        flipped(whole, start + 100) if kind == "damaged" else whole[: (start + end) // 2]
    )
    tick_count = convert(path, tmp_path / "a.rrd", say=remarks.append)
    recording = Recording.open(path)
    steps = [step for step in recording.steps() if step.frame is not None]
    assert tick_count == len(steps) > 0
    assert remarks[-1] == f"the other {tick_count} ticks are shown"
    gaps = [step for step in steps if step.damage]
    assert len(remarks) == len(gaps) + 1 + (kind == "cut")
    expected = {
        "damaged": f"before tick {gaps[0].tick if gaps else ''}: damage at byte {start}",
        "cut": f"cut at byte {start}: the end is missing",
    }[kind]
    assert expected in remarks[0]
    assert all(any(str(fault) in line for line in remarks) for fault in recording.faults)
    logged = [
        row["TextLog:text"][0]
        for row in drawn(tmp_path / "a.rrd")["/log"]
        if row.get("TextLog:text")
    ]
    assert set(remarks[:-1]) <= set(logged)
