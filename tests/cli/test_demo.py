"""The demo: bench, service and scribe are processes; the robot hands the board over, fetches the
glass and holds it over the board.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from support.cell import thirdhand
from support.cell_commands import succeeded
from support.paths import ROOT
from support.recorded import drawn_ticks, frames_of
from support.repeated import repeated
from thirdhand.client import Client, Tracker, UnreachableError, open_session
from thirdhand.command_line import main
from thirdhand.contract.records import Mode, Reason
from thirdhand.daemon.launch import launched, played
from thirdhand.recordings.recording import Recording
from thirdhand.settings.config import WAM, Settings
from thirdhand.workbench.cli.demo import (
    DEMO_ATTEMPTS,
    EVENT_TITLES,
    SLOW_RATE_HZ,
    TOO_BUSY,
    exit_code,
    text,
)
from thirdhand.workbench.report.columns import read
from thirdhand_sim.scene import Scene

timed = pytest.mark.timed
SCENE = """
handover = [0.68, -0.20, 0.36]
glass = [0.44, 0.31, 0.22]
soldering = [0.70, 0.09, 0.09]
seed = 7
"""


def demonstrated(*arguments: str, cwd: Path = ROOT) -> dict[str, Any]:
    """The report of a demo that succeeds."""
    done = thirdhand("demo", "--json", *arguments, timeout=320, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["success"]
    return report


@timed
@pytest.mark.timeout(330)
def test_task_succeeds_in_new_places_and_replays(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    report = demonstrated(
        "--output", str(tmp_path / "out"), "--scene", str(tmp_path / "scene.toml")
    )
    assert report["missing"] == ""
    for name in ("handover", "grasp", "carry"):
        assert report["events"][name]["reached"]
        assert report["events"][name]["error_mm"] <= 30
    recorded = frames_of(Path(report["recording"]))["tick"].tolist()
    assert drawn_ticks(Path(report["rrd"]), "/joints/velocity") == recorded
    succeeded("replay", "--exact", report["recording"])
    left = {"joints/command", "tool/target", "frame", "objects"}
    left = {f"/thirdhand/{name}" for name in left} | {"/tf", "/robot_description"}
    with Path(report["recording"]).open("rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        while left:  # a ROS 2 reader finds each topic
            left -= {next(decoded).channel.topic}


@timed
@pytest.mark.timeout(330)
def test_a_cell_of_ones_own_is_demonstrated_at_1000_hz(tmp_path: Path) -> None:
    """The URDF lies beside the settings; both are named by relative paths, and `start_held` is
    set.
    """
    (tmp_path / "my").mkdir()
    for name in ("ur5.toml", "ur5.urdf"):
        (tmp_path / "my" / name).write_bytes(WAM.with_name(name).read_bytes())
    cell = tmp_path / "my" / "ur5.toml"
    cell.write_text(cell.read_text().replace("[arm]\n", '[arm]\nstart = "held"\n'))
    report = demonstrated("--arm", "my/ur5.toml", "--rate", "1000", "--output", "out", cwd=tmp_path)
    assert report["rate_hz"] == pytest.approx(1000, rel=0.05)


BROWSER = """import sys, urllib.request as web
page = web.urlopen(sys.argv[1]).read().decode()
viewer = page.split('frame.src = live ? "', 1)[1].split("?", 1)[0]
status = web.urlopen(sys.argv[1] + "status").read().decode()
open(sys.argv[2], "a").write(f"{web.urlopen(viewer).status} {status}\\n")
"""


@timed
@pytest.mark.thorough
@pytest.mark.timeout(330)
def test_live_view_of_a_demo_is_open_before_the_arm_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The view is open in the browser."""
    (tmp_path / "browser.py").write_text(BROWSER)
    monkeypatch.setenv(
        "BROWSER", f"{sys.executable} {tmp_path / 'browser.py'} %s {tmp_path / 'opened'}"
    )
    report = demonstrated("--open", "--output", str(tmp_path / "out"))
    assert report["rate_hz"] == pytest.approx(SLOW_RATE_HZ, rel=0.05)
    for line in (tmp_path / "opened").read_text().splitlines():
        code, _, status = line.partition(" ")
        assert code == "200"
        assert json.loads(status)["mode"] == "hold"


@timed
def test_a_scene_out_of_reach_is_refused_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text("handover = [1.5, 0.0, 0.3]\n")
    done = thirdhand(
        "demo", "--output", str(tmp_path / "out"), "--scene", str(tmp_path / "scene.toml")
    )
    assert done.returncode == 1
    assert "handover" in done.stderr


@timed
def test_the_service_ends_before_the_arm_that_it_moves(tmp_path: Path) -> None:
    """The person's hands are still tracked when the bench reports, so the arm still follows
    them.
    """
    settings = Settings(rate_hz=100)
    ends = list[tuple[str, int]]()
    with (
        launched(tmp_path, "--joints", "state", settings=settings, record=tmp_path) as service,
        open_session(connect=[service.endpoint]) as session,
        Tracker(session) as tracker,
    ):

        def hold_still() -> None:
            for side, start in (("left", Scene().left_start), ("right", Scene().right_start)):
                tracker.publish(side, start)

        def end() -> None:
            ends.append((Client(session).status().mode, service.stop()))

        with repeated(hold_still):
            assert played(service.endpoint, "--tracked-hands", "1", reported=end)
    assert ends == [("follow", 0)]
    (recording,) = tmp_path.glob("*.mcap")
    frames = read(Recording.open(recording)).frames
    assert (frames["reason"][-1], frames["mode"][-1]) == (Reason.OPERATOR, Mode.HOLD)
    assert Reason.ARM_SILENT not in frames["reason"]


MISSING = "1 of 9000 ticks are not recorded"


def report_of(*whys: str | None, missing: str = "", **more: Any) -> dict[str, Any]:
    """The report of a demo: an event is reached unless a reason for its failure is given."""
    events = {
        name: {"reached": why is None, "error_mm": 80.0, "time_s": 3.0}
        | ({"why": why} if why else {})
        for name, why in zip(EVENT_TITLES, whys, strict=True)
    }
    few = {"p50": 1.0, "p99": 2.0, "max": 3.0}
    figures = {
        "rate_hz": 500.0,
        "ticks": 9,
        "missed": 0,
        "latency_ms": few,
        "lateness_us": few,
        "work_us": few,
    }
    files = {"recording": "a.mcap", "rrd": None}
    outcome = {
        "success": not any(whys),
        "events": events,
        "realtime": True,
        "missing": missing,
        "busy": "",
    }
    return outcome | figures | files | more


@pytest.mark.parametrize(
    ("why", "missing", "code"),
    [
        (None, "", 0),
        (None, MISSING, 1),
        ("the arm held", "", 1),
        ("the arm held", MISSING, 1),
    ],
)
def test_demo_fails_by_a_missed_event_or_missing_ticks(
    why: str | None, missing: str, code: int
) -> None:
    """Nothing else makes a demo fail."""
    report = report_of(None, None, why, missing=missing)
    assert exit_code(report) == code
    printed = text(report)
    assert printed.endswith("held it over the board.") == (why is None)
    assert (f"The recording is not complete: {missing}." in printed) == bool(missing)


BUSY = "the bench paused for 118 ms"
HELD = report_of(None, "the arm held", None)
SILENT = report_of(None, None, None) | {"busy": "nobody answers"}


@pytest.mark.parametrize(
    ("reports", "runs", "code"),
    [
        ([HELD | {"busy": BUSY}, report_of(None, None, None)], 2, 0),
        ([HELD | {"busy": BUSY}] * 4, 3, 1),
        (
            [report_of(None, None, None, missing=MISSING) | {"busy": BUSY}],
            1,
            1,
        ),
    ],
)
def test_a_task_that_fails_on_a_busy_machine_is_tried_again(
    reports: list[dict[str, Any]],
    runs: int,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    attempts = [
        report | {"recording": str(tmp_path / f"{i}.mcap")} for i, report in enumerate(reports)
    ]
    left = iter(attempts)

    rates_hz: list[int | None] = []

    def run(_: Any, rate_hz: int | None, page: Any) -> dict[str, Any]:
        report = next(left)
        rates_hz.append(rate_hz)
        Path(report["recording"]).touch()
        if report["busy"] == SILENT["busy"]:
            raise UnreachableError(report["busy"])
        return report

    monkeypatch.setattr("thirdhand.workbench.cli.demo.run", run)
    assert main(["demo", "--output", str(tmp_path)]) == code
    assert len(reports) - len(list(left)) == runs <= DEMO_ATTEMPTS
    assert [path.name for path in tmp_path.glob("*.*")] == [f"{runs - 1}.mcap"]
    assert len(list((tmp_path / TOO_BUSY).glob("*"))) == runs - 1
    output = capsys.readouterr()
    assert output.err.count(": it is tried again at 100 Hz") == runs - 1
    assert rates_hz == [None, *[SLOW_RATE_HZ] * (runs - 1)]
    assert output.err.count("there is no drawing: ") == 1  # the recordings are empty
    assert f"thirdhand view {tmp_path}/{runs - 1}.mcap" in output.out
