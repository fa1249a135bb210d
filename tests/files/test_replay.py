"""Replays of the golden session and of other recordings give the same frames bit for bit, from any
state and with any number of BLAS threads.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest

from support.cell import thirdhand, told
from support.cell_commands import assert_refused, succeeded
from support.in_process import record, ticks_of
from support.paths import RECORDINGS
from support.recorded import copied, thin
from thirdhand.core.controller import Controller
from thirdhand.core.frame import STAGES
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.recordings import replay as replay_module
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.recording import DECISIONS, Recording
from thirdhand.recordings.replay import replay
from thirdhand.skills.via_points import adapted
from thirdhand_sim.golden import refresh
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

GOLDEN = RECORDINGS / "golden.mcap"


def test_golden_session_replays_with_two_blas_threads() -> None:
    """The replay is the same bit for bit."""
    two = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    done = thirdhand("replay", str(GOLDEN), timeout=110, env=os.environ | two)
    assert (done.returncode, done.stdout) == (0, "10000 ticks, 10000 frames identical\n"), (
        done.stderr
    )


def test_a_replay_names_the_stages_whose_constants_are_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = Recording.open(GOLDEN)
    names = {f"constants of {stage}" for stage in STAGES}
    assert names | {"features", "libc", "kernel"} <= recording.metadata.keys()
    tuning = TUNING._replace(setpoint=TUNING.setpoint._replace(jerk_weight=3e-9))
    monkeypatch.setattr(replay_module, "Controller", functools.partial(Controller, tuning=tuning))
    result = replay(GOLDEN)
    assert not result.exact
    assert result.differing == {"setpoint"}
    assert "the constants of setpoint are not those of the recording" in result.text()


@pytest.mark.thorough
def test_a_thin_recording_is_small_and_replays_bit_for_bit(golden: Path, tmp_path: Path) -> None:
    old = Recording.open(golden)
    path = thin(golden, tmp_path / "thin.mcap")
    assert replay(path).exact
    fixed = len(old.skill) * 6  # five skills are loaded in this session
    assert 5 * (path.stat().st_size - fixed) < golden.stat().st_size - fixed
    steps = list(Recording.open(path).steps())
    whole = {step.tick: step.frame for step in steps if step.frame is not None}
    before: tuple[int, ...] = ()
    for step in old.steps():
        if step.frame is not None:
            decided = tuple(int(step.frame[name]) for name in DECISIONS)
            assert (step.tick in whole) == (step.tick % 20 == 0 or decided != before), step.tick
            before = decided
    assert [step.tick for step in steps if step.state is not None] == [-1, 500, 5500]
    spoilt = replay(thin(golden, tmp_path / "spoilt.mcap", spoilt=4321))
    assert (spoilt.ticks - spoilt.identical, spoilt.first_difference) == (
        1,
        "first difference at tick 4321: its checksum",
    )


def test_the_golden_session_replays_from_a_state_in_its_middle(golden: Path) -> None:
    result = replay(golden, after=6000)
    assert result.identical == result.ticks
    assert 3000 < result.ticks < 5000


@pytest.fixture(scope="module")
def recorded(skill: Skill, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short session, with states, recorded in process."""
    path = tmp_path_factory.mktemp("recorded") / "short.mcap"
    taught = adapted(skill, Scene().via_points(), tolerance=0.05)
    ticks = list(ticks_of(HandScript(Scene(), seed=4)))[:1000]
    return record(path, taught, ticks, states_every=250)


def test_a_change_of_one_nanoradian_is_found_and_named(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "changed.mcap"
    with copied(Recording.open(recorded), path) as (recorder, steps):
        for tick, step in steps:
            frame = step.frame.copy()
            if step.tick == 600:
                frame["joints"][2] += 1e-9
            recorder.write(tick, frame, time_ns=step.tick * 2_000_000)
    result = replay(path)
    assert not result.exact
    assert result.within_tolerance
    assert "first difference at tick 600: joints by 1e-09" in result.text()
    succeeded("replay", str(path))
    exact = told("replay", str(path), "--exact")
    assert exact.returncode == 1
    assert "first difference at tick 600" in exact.stdout


def test_a_gap_is_continued_from_the_state_after_it(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "gap.mcap"
    with copied(Recording.open(recorded), path) as (recorder, steps):
        for tick, step in steps:
            if not 400 <= tick.index < 500:
                recorder.write(
                    tick,
                    step.frame,
                    time_ns=step.tick * 2_000_000,
                    state=step.state,
                    lost=100 if tick.index == 500 else 0,
                )
    result = replay(path)
    assert not result.exact
    assert result.within_tolerance
    assert len(result.missing) == 1
    assert result.ticks == result.identical == 899
    assert (
        "gap after tick 399, before tick 500: 100 ticks not recorded; the replay continues after "
        "tick 500" in result.text()
    )


def test_damage_is_told_and_what_follows_is_compared(recorded: Path, tmp_path: Path) -> None:
    data = bytearray(recorded.read_bytes())
    path = tmp_path / "damaged.mcap"
    data[len(data) * 3 // 4] ^= 0xFF  # in a chunk of messages
    path.write_bytes(data)
    result = replay(path)
    assert len(result.missing) == 1
    assert not result.truncated
    assert result.identical == result.ticks > 500
    (gap,) = result.missing
    assert gap.resumed in (250, 500, 750, 1000)
    assert f"gap after tick {gap.after}, before tick {gap.before}: damage at byte" in result.text()
    exact = told("replay", str(path), "--exact")
    assert (exact.returncode, "checksum" in exact.stdout or "damage" in exact.stdout) == (1, True)
    with pytest.raises(RecordingError, match=r"--output cannot be written: gap after tick \d+"):
        replay(path, output=tmp_path / "whole.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["damaged.mcap"]


def test_cut_is_forbidden_only_where_exactness_is_asked_for(recorded: Path, tmp_path: Path) -> None:
    """Without the demand for exactness, the cut is only reported."""
    data = recorded.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: len(data) * 2 // 3])
    result = replay(path)
    assert result.truncated
    assert not result.exact
    assert result.within_tolerance
    assert "cut at byte" in result.text()
    assert f"the last tick read is {result.ticks - 1}" in result.text()


def test_refreshing_an_unchanged_session_changes_nothing(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    path.write_bytes(recorded.read_bytes())
    assert refresh(path) == {}
    assert replay(path).exact
    assert refresh(path) == {}


@pytest.fixture
def checked(recorded: Path, tmp_path: Path) -> Path:
    """The short session in the form of the golden one: frames as checksums."""
    path = tmp_path / "checked.mcap"
    path.write_bytes(recorded.read_bytes())
    refresh(path)
    return path


@pytest.mark.quick
def test_recording_of_checksums_becomes_one_of_frames(
    recorded: Path, checked: Path, tmp_path: Path
) -> None:
    """The frames are the same bit for bit."""
    output = tmp_path / "whole.mcap"
    done = told("replay", str(checked), "--exact", "--output", str(output))
    assert (done.returncode, done.stdout.strip()) == (0, "1000 ticks, 1000 frames identical")
    assert replay(output).exact
    sparse, whole, were = (
        [step.frame for step in Recording.open(path).steps(whole=False)][1:]
        for path in (checked, output, recorded)
    )
    assert [frame.tobytes() for frame in whole] == [frame.tobytes() for frame in were]
    assert [tick for tick, frame in enumerate(sparse) if frame is not None] == [0, 500]
    assert_refused(
        1, "a file other than the recording", "replay", str(output), "--output", str(output)
    )
    assert replay(output).exact


def test_change_at_a_checksum_is_found_and_named(checked: Path, tmp_path: Path) -> None:
    """The frame of that tick is not recorded."""
    recording = Recording.open(checked)
    path = tmp_path / "changed.mcap"
    table = np.array([*recording.checksums.values()], "<u4")
    table[601] ^= 1
    checksums = table.tobytes()
    with copied(recording, path, whole=False, checksums=checksums) as (recorder, steps):
        for tick, step in steps:
            recorder.write(tick, step.frame, time_ns=step.time_ns)
    result = replay(path)
    assert (result.ticks, result.identical, result.exact) == (1000, 999, False)
    assert (
        "first difference at tick 601: its checksum\nlargest differences: none in the frames"
        in result.text()
    )
