"""Successive recordings: they join without a gap, the oldest ones are removed for room, and after
faults of a disk or folder, losses are counted and recording continues by itself.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from support.in_process import ASSUMED, ticks_of
from support.recorded import SKILL, state_after, ticks, write
from support.small_disk import fill, small_disk
from support.wam import URDF
from thirdhand.command_line import main
from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import TIMING, Frame, Tick, blank
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay
from thirdhand.scribe import segments
from thirdhand.scribe.paths import RecordingPaths
from thirdhand.scribe.protocol import TickMessage
from thirdhand.scribe.scribe import Scribe
from thirdhand.scribe.segments import Segments
from thirdhand.settings.config import Files, RecordingSettings, Settings
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

COUNT = 2100
SMALL = Files(segment_mb=0.1)
WHOLE = RecordingSettings(frames_hz=0)
CELL = Settings(cell="hall/bench-1", rate_hz=50, recording=WHOLE)


@pytest.fixture(scope="module")
def rotated(skill: Skill, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The recordings that the scribe's process wrote of one session."""
    folder = tmp_path_factory.mktemp("rotated")
    settings = msgspec.structs.replace(ASSUMED, files=SMALL)
    controller = Controller(settings, skill, urdf=URDF)
    scribe = Scribe(settings, folder=folder)

    def tell(tick: Tick, frame: Frame) -> None:
        timing = blank(TIMING)
        timing["tick"] = tick.index
        timing["time_ns"] = tick.index * 2_000_000
        scribe.send(tick, frame, timing, state=lambda: controller.state, skill=skill.file)
        if tick.index % 100 == 0:
            time.sleep(0.02)

    try:
        scribe.start(skill=skill.file, state=controller.state)
        run(controller, list(ticks_of(HandScript(Scene(), seed=4)))[:COUNT], [tell])
    finally:
        assert scribe.close(20) == ""
    return sorted(folder.glob("*.mcap"))


def test_recordings_rotate_without_losing_a_tick(rotated: list[Path]) -> None:
    """Each recording replays by itself."""
    assert len(rotated) >= 3
    steps = [step for path in rotated for step in Recording.open(path).steps()]
    decided = [step for step in steps if step.frame is not None or step.checksum is not None]
    assert [step.tick for step in decided] == list(range(COUNT))
    whole = {step.tick for step in decided if step.frame is not None}
    assert whole >= set(range(0, COUNT, 20))
    assert len(whole) < COUNT / 8
    for path in rotated:
        alone = replay(path)
        assert alone.exact, alone.text()


def test_a_recording_missing_in_a_row_is_a_gap(
    rotated: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(rotated[0]), str(rotated[2]), "--exact"]) == 1
    output = capsys.readouterr().out
    assert "gap after tick " in output
    assert f"{rotated[2].name} does not continue the one before" in output
    assert main(["replay", str(rotated[0]), str(rotated[2])]) == 0


def with_limits(**limits: float) -> Settings:
    return msgspec.structs.replace(CELL, files=Files(**limits))


def test_oldest_recordings_of_the_cell_make_room(tmp_path: Path) -> None:
    """Other files are not removed."""
    settings = with_limits()
    current = RecordingPaths(settings, str(tmp_path), None).next()
    assert current is not None
    old = [tmp_path / f"hall-bench-1-2026010{day}T000000Z.mcap" for day in (1, 2, 3)]
    for path in (*old, current):
        write(path, 3, settings=settings)
    other = msgspec.structs.replace(CELL, cell="hall-bench/1")
    spared = [
        tmp_path / name
        for name in ("hall-bench-1-20260101T000001Z.mcap", "north-20200101T000000Z.mcap")
    ]
    write(spared[0], 3, settings=other)  # another cell's recording with a similar name
    spared += [
        tmp_path / name for name in ("hall-bench-1-notes.mcap", "hall-bench-1-20200101T000000Z.rrd")
    ]
    for path in spared[1:]:
        path.write_bytes(bytes(80_000))
    size_mb = old[0].stat().st_size / 1e6
    places = RecordingPaths(with_limits(keep_mb=3.5 * size_mb), str(tmp_path), None)
    assert places.prune(current) == [old[0]]  # room for 3.5 of 4 recordings
    assert all(path.exists() for path in [*spared, current, *old[1:]])
    assert places.prune(current) == []
    assert places.keep_mb_left == pytest.approx(0.5 * size_mb, rel=0.05)
    for path in old[1:]:
        os.utime(path, (0, 0))
    aged = RecordingPaths(with_limits(keep_hours=0.3), str(tmp_path), None)
    assert aged.prune(current) == old[1:]
    assert aged.keep_mb_left == pytest.approx(50_000, rel=0.01)
    unlimited = RecordingPaths(with_limits(keep_mb=0), str(tmp_path), None)
    assert unlimited.prune(current) == []
    assert unlimited.keep_mb_left is None


@pytest.mark.parametrize(
    ("set_years", "set_before", "right_after", "count"),
    [(0, 0, 0, 24), (10, 0, 0, 12), (10, 5, 0, 13), (-2, 0, 0, 25), (-2, 5, 0, 25), (10, 6, 2, 24)],
    ids=[
        "right",
        "ahead now",
        "ahead five files ago",
        "back now",
        "back five files ago",
        "ahead for four files",
    ],
)
def test_a_clock_that_was_set_makes_no_recording_much_older(
    set_years: int,
    set_before: int,
    right_after: int,
    count: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """There is one recording an hour, and those of a day are kept. The clock was set before the
    last `set_before` of them, and right again for the last `right_after`.
    """
    settings = with_limits(keep_hours=24)
    now_s = 1.8e9
    set_s = set_years * 365 * 86400
    for hours in range(31):
        path = tmp_path / f"hall-bench-1-20260101T{30 - hours:06d}Z.mcap"
        path.write_bytes(b"")
        changed_s = now_s - 3600 * hours + set_s * (right_after <= hours < set_before)
        os.utime(path, (changed_s, changed_s))
    monkeypatch.setattr(
        "thirdhand.scribe.paths.time.time", lambda: now_s + set_s * (right_after == 0) + 1
    )
    RecordingPaths(settings, str(tmp_path), None).prune(None)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == [
        f"hall-bench-1-20260101T{30 - hours:06d}Z.mcap" for hours in reversed(range(count))
    ]


class Session:
    """A scribe that receives ticks at about 50 Hz, and is supervised as in the daemon."""

    def __init__(self, **where: Any) -> None:
        self.scribe = Scribe(CELL, restart_s=0.1, **where)
        self.told = 0
        self._ticks = list(ticks(40))
        self.missing = ""

    def tell(self, count: int) -> None:
        for _ in range(count):
            tick, frame, timing = self._ticks[self.told % 40]
            index = self.told
            self.scribe.send(
                Tick(index, tick.inbox),
                frame,
                timing,
                state=lambda at=index: state_after(at),
                skill=SKILL,
            )
            self.told += 1
        self.scribe.supervise()

    def until(self, what: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Send ticks until a condition of the status holds."""
        deadline = time.monotonic() + 20.0
        while not what(status := self.scribe.status()):
            assert time.monotonic() < deadline, status
            self.tell(5)
            time.sleep(0.02)
        return status


@contextlib.contextmanager
def session(**where: Any) -> Iterator[Session]:
    writer = Session(**where)
    try:
        writer.scribe.start(skill=SKILL, state=state_after(-1))
        assert writer.scribe.ready(60)
        yield writer
    finally:
        writer.missing = writer.scribe.close(10)


def test_growth_is_told_once_there_is_enough_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segments, "MIN_GROWTH_S", 0.5)
    settings = msgspec.structs.replace(CELL, files=Files(segment_mb=0.3))
    paths = RecordingPaths(settings, str(tmp_path), None)
    writer = Segments(settings, paths, say=print)
    writer.begin(SKILL, state_after(-1))
    writer.flush()
    assert writer.mb_per_hour() is None
    begin_s = time.monotonic()
    before = sum(path.stat().st_size for path in tmp_path.iterdir())
    cycle = list(ticks(40))
    for i in range(2000):
        tick, frame, timing = cycle[i % 40]
        state = state_after(i) if i % 50 == 49 else None
        writer.write(TickMessage(Tick(i, tick.inbox), frame, timing, state, None, 0))
        if i % 20 == 0:
            time.sleep(0.01)
            writer.flush()
    writer.flush()
    grown_mb = (sum(path.stat().st_size for path in tmp_path.iterdir()) - before) / 1e6
    assert len(list(tmp_path.iterdir())) > 2
    assert writer.mb_per_hour() == pytest.approx(
        grown_mb * 3600 / (time.monotonic() - begin_s), rel=0.1
    )
    assert writer.keep_mb_left is not None
    writer.close()


def accounted(paths: list[Path], told: int) -> tuple[int, int]:
    """The number of ticks in recordings, and the number that they report as missing."""
    all_steps = [step for path in paths for step in Recording.open(path).steps()]
    steps = [step for step in all_steps if step.frame is not None]
    indices = [step.tick for step in steps]
    assert indices == sorted(set(indices))
    assert indices[-1] == told - 1
    assert all(step.state is not None for step in steps if step.lost)
    return len(steps), sum(step.lost for step in steps)


@pytest.mark.thorough
def test_after_a_full_disk_the_recording_goes_on_by_itself(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "6m") as disk:
        ballast = disk / "ballast"
        with session(folder=disk) as writer:
            writer.until(lambda status: status["sent"] > 200)
            fill(ballast)
            status = writer.until(
                lambda status: status["state"] == "interrupted" and status["lost"] > 200
            )
            assert status["recording"] is None
            assert writer.scribe.newest_recording == str(*disk.glob("*.mcap"))
            full = [error for error in status["errors"] if error.startswith("recording to ")]
            assert len(full) == 1
            assert "No space left on device" in full[0]
            ballast.unlink()
            writer.until(lambda status: status["state"] == "recording")
            sent = writer.told
            status = writer.until(
                lambda status: (
                    status["sent"] > sent + 200 and "continues in" in status["errors"][-1]
                )
            )
            assert status["errors"][-1].endswith(f"{status['lost']} ticks are lost in all")
        recordings = sorted(disk.glob("*.mcap"))
        recorded, lost = accounted(recordings, writer.told)
        assert recorded + lost == writer.told
        assert writer.missing == f"{lost} of {writer.told} ticks are not recorded"
        result = [Recording.open(path) for path in recordings]
        assert [len(list(r.steps())) > 50 for r in result] == [True, True]
        assert [r.truncated for r in result] == [True, False]


def test_removed_folder_is_made_again(tmp_path: Path) -> None:
    """The ticks in the removed folder count as lost."""
    folder = tmp_path / "records"
    with session(folder=folder) as sender:
        sender.until(lambda status: status["sent"] > 200)
        shutil.rmtree(folder)
        status = sender.until(
            lambda status: status["lost"] > 0 and status["state"] == "recording" and folder.exists()
        )
        assert any("was removed while it was written" in error for error in status["errors"])
    recorded, lost = accounted(sorted(folder.glob("*.mcap")), sender.told)
    assert recorded + lost == sender.told
    assert lost > 200
    assert sender.missing == f"{lost} of {sender.told} ticks are not recorded"


def test_moved_recording_is_ended_where_it_is(tmp_path: Path) -> None:
    """Nothing is lost."""
    with session(folder=tmp_path) as sender:
        status = sender.until(lambda status: status["sent"] > 200)
        first = Path(status["recording"])
        first.rename(tmp_path / "elsewhere.mcap")
        status = sender.until(lambda status: status["recording"] != str(first))
    assert sender.missing == ""
    assert accounted([tmp_path / "elsewhere.mcap", Path(status["recording"])], sender.told) == (
        sender.told,
        0,
    )
