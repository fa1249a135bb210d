"""The clutch over Zenoh: another process presses it, then releases it or is killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.cell import LISTENING, Daemon, Tracker, serving
from support.paths import ROOT
from thirdhand.contract import cdr
from thirdhand.contract.records import Mode, Reason
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay

CLUTCHED = f'{LISTENING}\n[hands]\nclutch = "key"\n'
SWITCH = """
import sys, threading, time
from thirdhand.client import connect

released = threading.Event()
threading.Thread(target=lambda: (sys.stdin.readline(), released.set()), daemon=True).start()
with connect(sys.argv[1]) as cell:
    while not released.wait(0.02):
        cell.clutch(True)
    cell.clutch(False)
"""


def switch(daemon: Daemon) -> subprocess.Popen[str]:
    """A process that presses the clutch until it reads a line."""
    return subprocess.Popen(
        [sys.executable, "-c", SWITCH, daemon.endpoint], stdin=subprocess.PIPE, text=True, cwd=ROOT
    )


def is_held(status: dict[str, Any]) -> bool:
    return (status["mode"], status["reason"]) == ("hold", "clutch")


def is_following(status: dict[str, Any]) -> bool:
    return status["mode"] == "follow"


@pytest.mark.timeout(120)
def test_arm_holds_in_the_tick_of_a_release(tmp_path: Path) -> None:
    """The arm holds after a silence too."""
    records = tmp_path / "records"
    with (
        serving(
            tmp_path, "--joints", "assumed", "--record", str(records), network=CLUTCHED
        ) as daemon,
        Tracker(daemon.session),
    ):
        status = daemon.until(is_held)
        assert status["because"] == "the clutch has not been heard yet"
        daemon.session.put("thirdhand/clutch", b"\0\1\0\0\7")
        daemon.until(
            lambda s: s["because"].endswith(
                "what arrives on clutch is malformed: a bool of 7; 0 or 1 needed"
            )
        )

        pressed = switch(daemon)
        daemon.until(is_following)
        pressed.communicate("release\n", timeout=30)
        status = daemon.until(is_held)
        assert status["because"].startswith("the clutch of [hands] clutch is not pressed")
        assert status["received"]["clutch"] > 2

        with switch(daemon) as killed:
            daemon.until(is_following)
            killed.kill()
        status = daemon.until(is_held)
        assert status["because"].startswith(
            "the clutch was last heard as pressed, and then not for 300 ms"
        )
        assert daemon.end() == 0

    (path,) = records.glob("*.mcap")
    whole = tmp_path / "whole.mcap"
    assert replay(path, output=whole).exact
    steps = [step for step in Recording.open(whole).steps() if step.frame is not None]
    events = [event for step in steps for event in step.events]
    heard = [cdr.decode_bool(payload) for kind, payload in events if kind == "clutch"]
    assert heard.count(False) == 1
    # from the recording: the last message, and the time at which it becomes stale
    newest = False
    until = -1
    for step in steps:
        for value in (
            cdr.decode_bool(payload) for kind, payload in step.events if kind == "clutch"
        ):
            newest = value
            until = step.tick + 150
        is_pressed = newest and step.tick < until
        expected = {Reason.NONE, Reason.NO_HANDS} if is_pressed else {Reason.CLUTCH}
        # the operator's hold at the end
        assert Reason(step.frame["reason"]) in expected | {Reason.OPERATOR}, step.tick
        assert (step.frame["mode"] == Mode.FOLLOW) <= is_pressed, step.tick
