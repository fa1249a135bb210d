"""A drawing agrees with its recording: time, log, modes, skills and late ticks are the same, and
gaps of the recording are gaps of curves and trails.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.recorded import SKILL, TEXT, at_ns, drawn, frames_of, ticks, values, vise_taught
from support.wam import JOINT_NAMES
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.frame import Event, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recorder
from thirdhand.settings.config import Settings
from thirdhand.workbench.cli.view import convert

# ticks between those of whole frames
MEASURED_AT = 55
TAUGHT_AT = 155
LATE_AT = 205
HELD_AT = 255


def log_of(rows: dict[str, list[dict[str, Any]]]) -> dict[str, float]:
    """Times [s] of the lines of a drawing's log."""
    return {row[TEXT][0]: row["seconds"].total_seconds() for row in rows["/log"] if row.get(TEXT)}


def test_drawing_shows_what_is_between_whole_frames(tmp_path: Path, skill: Skill) -> None:
    """Events and late ticks between whole frames are shown."""
    taught = vise_taught(skill)
    with Recorder(
        tmp_path / "a.mcap", settings=Settings(), skill=skill.file, thin=True
    ) as recorder:
        recorder.note("log", "before the first tick", at_ns(0) - 3_000_000_000)
        for tick, frame, timing in ticks(400):
            inbox = []
            if tick.index == MEASURED_AT:
                joints = JointState(at_ns(tick.index), JOINT_NAMES, tuple(frame["joints"]), ())
                inbox = [Event("joints/state", cdr.encode_joints(joints), None)]
            if tick.index == TAUGHT_AT:
                inbox = [Event("skill", taught, None)]
            if tick.index == HELD_AT:
                frame["mode"] = Mode.HOLD
                frame["reason"] = Reason.OPERATOR
            timing["lateness_us"] = 3000 if tick.index == LATE_AT else 10
            recorder.write(
                Tick(tick.index, tuple(inbox)), frame, time_ns=at_ns(tick.index), timing=timing
            )
        recorder.note("requests", 'via_points {"op": "clear"}', at_ns(450))
    assert convert(tmp_path / "a.mcap", tmp_path / "a.rrd") == 400
    whole = frames_of(tmp_path / "a.mcap")["tick"].tolist()
    rows = drawn(tmp_path / "a.rrd")
    assert values(rows["/joints/position"], "tick") == whole
    assert {0, HELD_AT, HELD_AT + 1} < set(whole)
    seconds = [time.total_seconds() for time in values(rows["/joints/position"], "seconds")]
    assert seconds == pytest.approx(np.array(whole) / 500)  # time 0 is the first tick
    log = log_of(rows)
    assert log["before the first tick"] == 0.0
    assert log["All via-points were removed."] == pytest.approx(0.9)
    assert [tick for tick in values(rows["/joints/error"], "tick") if tick > MEASURED_AT] == [
        tick for tick in whole if tick > MEASURED_AT
    ]
    late = dict(
        zip(whole, np.ravel(values(rows["/timing/lateness"], "Scalars:scalars")), strict=True)
    )
    assert max(late, key=lambda tick: late[tick]) == 220  # tick of the next whole frame
    assert any(
        "vise" in labels for labels in values(rows["/skill/via_points/tool"], "Points3D:labels")
    )


@pytest.mark.parametrize(
    ("lost", "pause_ticks", "is_broken"), [(5, 5, True), (0, 500, True), (0, 3, False)]
)
def test_curves_are_interrupted_where_frames_are_missing(
    tmp_path: Path, lost: int, pause_ticks: int, is_broken: bool
) -> None:
    """Gaps are unrecorded ticks, and a loop that was stopped for a second; missed deadlines are no
    gap.
    """
    with Recorder(tmp_path / "a.mcap", settings=Settings(), skill=SKILL, thin=True) as recorder:
        for number, (source, frame, timing) in enumerate(ticks(400)):
            index = source.index + pause_ticks * (number >= 203)
            frame["tick"] = timing["tick"] = index
            recorder.write(
                Tick(index), frame, time_ns=at_ns(index), timing=timing, lost=lost * (number == 203)
            )
    convert(tmp_path / "a.mcap", tmp_path / "a.rrd")
    rows = drawn(tmp_path / "a.rrd")
    for path in (
        "/joints/position",
        "/speed/left",
        "/error/target",
        "/timing/work",
        "/deviation/target",
    ):
        curve = sorted(
            (row["tick"], np.isnan(row["Scalars:scalars"]).any())
            for row in rows[path]
            if "tick" in row
        )
        breaks = [tick for tick, is_break in curve if is_break]
        assert breaks == [201] * is_broken, path  # behind the last frame before the gap
    trails = {
        row["tick"]: len(row["LineStrips3D:strips"][0])
        for row in rows["/scene/left_trail"]
        if "tick" in row
    }
    after = min(tick for tick in trails if tick > 210)
    assert (trails[after] == 1) == is_broken
    assert (
        f"gap after tick 202, before tick 208: {lost} ticks not recorded" in log_of(rows)
    ) == bool(lost)


def test_unreadable_recording_leaves_no_part_of_a_drawing(tmp_path: Path) -> None:
    """The recording cannot be read to its end."""
    path = tmp_path / "a.mcap"
    with Recorder(path, settings=Settings(), skill=SKILL) as recorder:
        for tick, frame, timing in ticks(40):
            recorder.write(tick, frame, time_ns=at_ns(tick.index), timing=timing)

    def stop(count: int) -> None:
        if count == 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(path, tmp_path / "a.rrd", progress=stop)
    assert [left.name for left in tmp_path.iterdir()] == ["a.mcap"]
