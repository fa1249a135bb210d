"""A correction from end to end, over Zenoh with the bench's arm: the arm is held, led by hand,
corrected and resumed, and the correction is undone.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from support.cell import LEFT, LISTENING, Daemon, Tracker, serving, told
from support.guided_bench import GuidedBench
from support.recorded import frames_of
from thirdhand.client import RefusedError
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import Settings

RATE_HZ = 100  # ticks of 10 ms leave time for the simulated arm on a busy machine
# The simulated arm is a thread of the tests, and may be silent there for more than 0.1 s.
PATIENT = LISTENING + "[arm]\nsilent_ms = 1000\n"
HALFWAY = (0.80, -0.31, 0.19)  # left hand on its way to the handover
# [rad] motion by hand, larger than the allowed error of an arm
LED = np.array([0.12, -0.1, 0.0, 0.12, 0.0, 0.0, 0.0])
NEAR_M = 0.004


def has_arrived(status: dict[str, Any], at: Any = None) -> bool:
    """True if the arm follows, and its tool is at a position [m], by default at its target."""
    at = status["target_m"] if at is None else at
    if status["mode"] != "follow" or "engaging" in status["flags"]:
        return False
    return bool(np.linalg.norm(np.array(status["tool_m"]) - np.array(at)) < NEAR_M)


def move(tracker: Tracker, to: tuple[float, float, float]) -> None:
    """Move the left hand slowly, as the tracker may be late."""
    start = np.array(tracker.left)
    pause = threading.Event()
    for share in np.linspace(0.0, 1.0, 40):
        tracker.left = tuple((start + share * (np.array(to) - start)).tolist())  # type: ignore[assignment]
        pause.wait(0.03)


def refusals(daemon: Daemon, *requests: dict[str, Any]) -> str:
    """The texts of the refusals."""
    words = []
    for request in requests:
        with pytest.raises(RefusedError) as error:
            daemon.client.ask("correct", request)
        words.append(str(error.value))
    return "\n".join(words)


@pytest.mark.timeout(900)
@pytest.mark.thorough
def test_correction_from_end_to_end(tmp_path: Path) -> None:  # noqa: PLR0915 - one session
    """The correction moves the tool to where it was led; undoing it moves the tool back."""
    settings = msgspec.structs.replace(Settings(), rate_hz=RATE_HZ)
    records = tmp_path / "records"
    with (
        serving(
            tmp_path, "--rate", str(RATE_HZ), "--record", str(records), network=PATIENT
        ) as daemon,
        Tracker(daemon.session) as tracker,
        GuidedBench(daemon.session, settings) as bench,
    ):
        daemon.until(has_arrived, 120)
        move(tracker, HALFWAY)
        before = daemon.until(has_arrived, 60)["tool_m"]
        assert "does not hold for an operator" in refusals(daemon, {"op": "add"}, {"op": "undo"})

        daemon.client.hold()
        assert "the arm was not led in this hold" in refusals(daemon, {"op": "add"})
        bench.lead(LED)
        daemon.until(lambda s: bench.is_led_there and s["reason"] == "guided", 60)
        threading.Event().wait(1.0)
        tool = daemon.until(lambda s: s["guided"])["tool_measured_m"]
        move(tracker, LEFT)  # the leading hand; a correction uses the hands at the hold
        answer = told("correct", "--connect", daemon.endpoint)
        assert answer.returncode == 0, answer.stderr
        assert answer.stdout.startswith("correction-1 in force since tick "), answer.stdout
        assert "in the segment start -> handover" in answer.stdout
        (point,) = daemon.client.via_points()
        assert (point.name, point.segment, point.corrections) == ("correction-1", "start", 1)
        np.testing.assert_allclose(point.left, HALFWAY, atol=5e-3)
        np.testing.assert_allclose(point.tool, tool, atol=NEAR_M)
        assert point.missed_by_m < 1e-3
        moved_m = float(np.linalg.norm(np.subtract(tool, before)))
        assert moved_m > 0.03

        with pytest.raises(RefusedError, match="the arm is led by hand, which no resume ends"):
            daemon.client.resume()
        move(tracker, HALFWAY)
        bench.let_go()
        daemon.until(lambda s: s["reason"] == "operator", 60)
        daemon.client.resume()
        daemon.until(lambda s: has_arrived(s, tool), 60)

        daemon.client.hold()
        undone = daemon.client.undo_correction().correction
        assert undone is not None
        assert undone.undone
        assert undone.moved_m == pytest.approx(moved_m, abs=0.01)
        assert daemon.client.via_points() == ()
        assert refusals(daemon, {"op": "undo"}) == "no correction is in force"
        daemon.client.resume()
        daemon.until(lambda s: has_arrived(s, before), 60)
        assert daemon.end() == 0

    (path,) = records.glob("*.mcap")
    whole = tmp_path / "whole.mcap"
    assert replay(path, output=whole).exact
    frames = frames_of(whole)
    assert not (frames["mode"] == Mode.FAULT).any()
    assert (frames["reason"] == Reason.GUIDED).sum() > RATE_HZ / 2
    commanded = frames[frames["commanded"] == 1]
    speeds = RATE_HZ * np.linalg.norm(np.diff(commanded["tool"], axis=0), axis=1)
    is_engaging = (commanded["flags"][1:] & int(Flag.ENGAGING)) > 0
    assert (
        speeds[is_engaging & (np.diff(commanded["tick"]) == 1)].max()
        < 1.15 * settings.tool.engage_speed
    )
