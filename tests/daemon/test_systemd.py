"""The daemon under a service manager: notifications to systemd, the watchdog of the loop, restarts
that follow hands only after `resume`, and the unit in examples/.
"""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell import LISTENING, Daemon, Tracker, serving, told
from support.paths import ROOT
from support.small_disk import fill, small_disk
from thirdhand.client import Client, RefusedError
from thirdhand.command_line import parser
from thirdhand_sim.scene import Scene

UNIT = ROOT / "examples" / "thirdhand@.service"
PING_S = 0.2
STANDS_STILL = """
import pathlib, time
from thirdhand.core import controller

def step(self, tick, *rest, honest=controller.Controller.step):
    while pathlib.Path({mark!r}).exists():
        time.sleep(0.01)
    return honest(self, tick, *rest)

controller.Controller.step = step
"""


class Manager:
    """The service manager's socket for notifications."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))

    def heard(self, seconds: float, until: str = "\n") -> list[str]:
        """The assignments that arrive within this time, at most up to the expected one."""
        assignments = list[str]()
        end = time.monotonic() + seconds
        while until not in assignments and (left := end - time.monotonic()) > 0:
            self.socket.settimeout(left)
            try:
                assignments += self.socket.recv(4096).decode().splitlines()
            except TimeoutError:
                break
        return assignments


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    """The manager that daemons of the test notify."""
    systemd = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", str(round(2e6 * PING_S)))
    with systemd.socket:
        yield systemd


@pytest.mark.thorough
def test_pings_follow_the_loop(manager: Manager, tmp_path: Path) -> None:
    """After a restart, hands are followed only after `resume`."""
    mark = tmp_path / "mark"
    arguments = ("--joints", "assumed")
    before = STANDS_STILL.format(mark=str(mark))
    with serving(tmp_path, *arguments, "--hold", before=before) as daemon, Tracker(daemon.session):
        started = manager.heard(30, "READY=1")
        assert started[-1] == "READY=1"
        assert "STATUS=starting: importing" in started[0]
        assert any(line.startswith("EXTEND_TIMEOUT_USEC=") for line in started)
        for _ in range(3):
            assert manager.heard(20, "WATCHDOG=1")[-1] == "WATCHDOG=1"

        engaged_by_resume(daemon)
        mark.touch()
        manager.heard(3 * PING_S)  # a ping for the last tick may be under way
        tick = daemon.client.ask("status")["tick"]
        assert "WATCHDOG=1" not in manager.heard(8 * PING_S)
        assert daemon.client.ask("status")["tick"] == tick  # everything but the loop continues
        mark.unlink()
        assert manager.heard(20, "WATCHDOG=1")[-1] == "WATCHDOG=1"

        daemon.process.send_signal(signal.SIGKILL)
        daemon.process.wait(20)
    manager.heard(0.1)
    held = LISTENING + '[arm]\nstart = "held"\n'
    with serving(tmp_path, *arguments, network=held) as daemon, Tracker(daemon.session):
        assert manager.heard(30, "READY=1")[-1] == "READY=1"
        engaged_by_resume(daemon)
        assert daemon.end() == 0
    assert {"STOPPING=1"} < set(manager.heard(1.0))


DEAF = """
import pathlib
from thirdhand.daemon import own_answers, queryables

class Deaf(queryables.RequestQueue):
    def enqueue(self, request):
        if not pathlib.Path({mark!r}).exists():
            super().enqueue(request)

queryables.RequestQueue = Deaf
own_answers.DEAF_AFTER_S, own_answers.ASK_EVERY_S = 1.5, 0.3
"""


@pytest.mark.thorough
def test_unresponsive_daemon_stops_its_pings(manager: Manager, tmp_path: Path) -> None:
    """A daemon that answers no request stops its pings, and logs this."""
    mark = tmp_path / "mark"
    with serving(tmp_path, "--joints", "assumed", before=DEAF.format(mark=str(mark))) as daemon:
        for _ in range(10):  # longer than two of the daemon's requests to itself
            assert manager.heard(20, "WATCHDOG=1")[-1] == "WATCHDOG=1"
        mark.touch()
        while "WATCHDOG=1" in manager.heard(8 * PING_S, "WATCHDOG=1"):
            pass
        mark.unlink()
        assert manager.heard(20, "WATCHDOG=1")[-1] == "WATCHDOG=1"
        assert daemon.end() == 0
        assert (
            daemon.log.read_text().count(
                "the daemon has not answered on its own endpoint tcp/127.0.0.1:"
            )
            == 1
        )


def engaged_by_resume(daemon: Daemon) -> None:
    """Assert that the arm holds, with both hands in sight, until an operator's `resume`."""
    daemon.until(
        lambda now: len(now["hand_age_ms"]) == 2 and max(now["hand_age_ms"].values()) < 100
    )
    client = Client(daemon.session)
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        now = client.status()
        assert (now.mode, now.reason) == ("hold", "operator")
    with pytest.raises(RefusedError, match="does not hold the arm"):
        client.resume("somebody")
    client.resume()
    daemon.until(lambda now: now["mode"] == "follow")


def commands() -> dict[str, list[str]]:
    """The commands of the unit by their setting, split into words."""
    lines = (line.partition("=") for line in UNIT.read_text(encoding="utf-8").splitlines())
    return {name: value.split() for name, _, value in lines if name.startswith("Exec")}


def test_the_commands_of_the_unit_are_commands_of_this_version() -> None:
    options = {name: parser().parse_args(words[1:]) for name, words in commands().items()}
    assert [options[name].run for name in ("ExecStartPre", "ExecStart")] == [
        "thirdhand.cli.serve_check.check",
        "thirdhand.cli.serve.serve",
    ]
    assert options["ExecStart"].hold
    # this setting would not apply to the check's exit code
    assert "RestartPreventExitStatus" not in UNIT.read_text(encoding="utf-8")
    assert {str(parsed.config) for parsed in options.values()} == {"/etc/thirdhand/%i.toml"}


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    program = tmp_path / "thirdhand"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / UNIT.name
    text = UNIT.read_text(encoding="utf-8").replace(commands()["ExecStart"][0], str(program))
    # the refusal of the second text shows that the tool reads the file
    for spoilt in ("", "WatchdogSec=soon\n"):
        unit.write_text(text.replace("[Install]", f"{spoilt}[Install]"))
        done = subprocess.run(
            ["systemd-analyze", "verify", str(tmp_path / "thirdhand@bench.service")],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert bool(done.returncode or done.stderr) == bool(spoilt), done.stderr


def test_full_disk_ends_no_daemon(manager: Manager, tmp_path: Path) -> None:
    """The check and the request to teach report the full disk."""
    with small_disk(tmp_path / "disk", "8m") as disk:
        filled = disk / "filled"
        (disk / "state").mkdir()
        (tmp_path / "state").symlink_to(disk / "state")
        fill(filled)
        with serving(tmp_path, "--joints", "assumed", "--record", str(disk / "records")) as daemon:
            checked = told(
                "serve",
                "--check",
                "--config",
                str(tmp_path / "cell.toml"),
                "--record",
                str(disk / "records"),
            )
            assert (checked.returncode, "wrong  disk" in checked.stdout) == (1, True), (
                checked.stdout
            )
            assert manager.heard(30, "READY=1")[-1] == "READY=1"
            with pytest.raises(
                RefusedError, match=r"cannot save via-points in .*: No space left on device"
            ):
                Client(daemon.session).add(Scene().via_points())
            assert Client(daemon.session).status().via_points == ()
            assert manager.heard(20, "WATCHDOG=1")[-1] == "WATCHDOG=1"
            filled.unlink()
            Client(daemon.session).add(Scene().via_points())
            daemon.until(lambda now: now["scribe"]["state"] == "recording", 30)
            assert daemon.end() == 1  # the recording lacks ticks, counted in the last line
            assert daemon.log.read_text().endswith("ticks are not recorded\n")
        assert len(list((disk / "state" / "thirdhand").glob("via-points-*.json"))) == 1
