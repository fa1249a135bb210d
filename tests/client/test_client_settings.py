"""How clients reach a cell: by option, environment or file; and whoever is started first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell import serving, thirdhand
from support.paths import ROOT
from thirdhand.client import (
    Client,
    UnreachableError,
    client_settings,
    endpoints,
    open_session,
)
from thirdhand.command_line import main
from thirdhand.contract import cdr
from thirdhand.daemon.launch import free_port
from thirdhand.settings.config import Settings
from thirdhand.settings.file_content import SettingsError

VARIABLES = ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG")


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the client's file is looked for; nothing is given otherwise."""
    for name in VARIABLES:
        monkeypatch.delenv(f"THIRDHAND_{name}", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "thirdhand").mkdir()
    return tmp_path / "thirdhand" / "client.toml"


def test_an_option_goes_before_the_environment_the_file_and_the_default(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (client_settings().cell, client_settings().connect) == ("thirdhand", ())
    file.write_text('connect = "tcp/127.0.0.1:1"\ncell = "filed"\ncertificate = "secrets/operator"\n')
    found = client_settings()
    assert (found.cell, found.connect) == ("filed", ("tcp/127.0.0.1:1",))
    assert found.certificate == str(file.parent / "secrets" / "operator")
    monkeypatch.setenv("THIRDHAND_CELL", "told")
    monkeypatch.setenv("THIRDHAND_CONNECT", "tcp/127.0.0.1:2, tcp/127.0.0.1:3")
    found = client_settings()
    assert (found.cell, found.connect) == ("told", ("tcp/127.0.0.1:2", "tcp/127.0.0.1:3"))
    found = client_settings(cell="said", connect=["tcp/127.0.0.1:4"], certificate="mine")
    assert (found.cell, found.connect, found.certificate) == ("said", ("tcp/127.0.0.1:4",), "mine")


def test_the_certificate_of_a_client_is_not_that_of_a_daemon_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THIRDHAND_CERTIFICATE", str(tmp_path / "secrets"))
    open_session(listen=["tcp/127.0.0.1:0"], certificate=Settings().network.certificate).close()
    with pytest.raises(UnreachableError, match=r"cannot read .*secrets/certificate\.pem"):
        open_session(listen=["tcp/127.0.0.1:0"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cell = ", r"client\.toml: "),
        ('cel = "lab"', r"client\.toml: unknown field 'cel'; known are connect, cell, certificate, zenoh_config"),
        ('cell = "*"', r"client\.toml: cell: '\*' given; words joined by"),
        ('cell = "a/.."', r"client\.toml: cell: 'a/\.\.' given; no \. or"),
        ('connect = "127.0.0.1:1"', r"client\.toml: connect, entry 1: .*: tcp/127\.0\.0\.1:1 \?"),
        ("connect = 3", r"client\.toml: connect: 3 given; an endpoint, or a list"),
    ],
)
def test_a_wrong_file_is_told_with_what_is_accepted(
    file: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(text)
    with pytest.raises(SettingsError, match=said):
        client_settings()
    assert main(["status"]) == 2
    assert str(file) in capsys.readouterr().err


def test_endpoint_and_cell_are_given_once(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(tmp_path, "--cell", "lab/bench2", "--joints", "assumed") as daemon:
        file.write_text(f'connect = "{daemon.endpoint}"\ncell = "lab/bench2"\n')
        for command in (["status"], ["hold"], ["resume"], ["via-points", "list"], ["status", "--all"]):
            assert main(command) == 0, capsys.readouterr().err
        settings = client_settings()
        with settings.session() as session:
            assert Client(session, settings.cell).status().cell == "lab/bench2"


# --- whoever is started first --------------------------------------------------------------------


class Example:
    """A program of examples/ as a process; its words go to a file."""

    def __init__(self, folder: Path, name: str, *arguments: str) -> None:
        self.said = folder / f"{name}.said"
        command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *arguments]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("THIRDHAND_")}
        with self.said.open("w") as said:
            self.process = subprocess.Popen(
                command, stdout=said, stderr=subprocess.STDOUT, env=environment | {"PYTHONPATH": str(ROOT)}
            )

    def waits(self, times: int = 1) -> None:
        """Until it said that it waits."""
        end = time.monotonic() + 30
        while self.said.read_text().count("waiting, until Ctrl-C: ") < times:
            assert time.monotonic() < end
            assert self.process.poll() is None, self.said.read_text()
            time.sleep(0.05)

    def interrupted(self) -> str:
        """What it said, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(20) in (0, 130, -signal.SIGINT)
        return self.said.read_text()


@pytest.fixture
def started() -> Iterator[list[Example]]:
    """The programs that a test started; those that are left are ended."""
    programs: list[Example] = []
    yield programs
    for one in programs:
        one.process.kill()
        one.process.wait()


@pytest.mark.thorough
def test_the_examples_wait_for_record_and_are_recorded(file: Path, tmp_path: Path, started: list[Example]) -> None:
    """The tutorial's first step with a tracker and an arm of one's own, all started before it."""
    at = f"tcp/127.0.0.1:{free_port()}"
    posture = [0.1, 0.5, 0.2, 1.5, 0.3, -1.0, 0.4]
    config = tmp_path / "cell.toml"
    config.write_text(f"[arm]\nposture = {posture}\n")
    started += [
        Example(tmp_path, "tracker", "--connect", at),
        Example(tmp_path, "own_arm", "--connect", at, "--config", str(config)),
    ]
    for one in started:
        one.waits()
    record = ("record", "take", "--folder", str(tmp_path / "takes"), "--listen", at, "--seconds", "2")
    for name in ("one", "two"):  # and they stay for the next take
        done = thirdhand(*record[:1], name, *record[2:])
        assert (done.returncode, "joints" in done.stdout or "tool" in done.stdout) == (0, True), done.stderr
    told = [one.interrupted() for one in started]
    assert all(text.count("waiting, until Ctrl-C: ") <= 2 for text in told)
    assert not any("Traceback" in text for text in told)


def test_own_arm_begins_at_the_posture_of_the_cells_settings(
    file: Path, tmp_path: Path, started: list[Example]
) -> None:
    posture = [0.1, 0.5, 0.2, 1.5, 0.3, -1.0, 0.4]
    config = tmp_path / "cell.toml"
    config.write_text(f'cell = "lab"\n[arm]\nposture = {posture}\n')
    with open_session(listen=["tcp/127.0.0.1:0"]) as session:
        told = session.declare_subscriber("lab/joints/state")
        started.append(Example(tmp_path, "own_arm", "--connect", *endpoints(session), "--config", str(config)))
        state = cdr.decode_joints(told.recv().payload.to_bytes())  # type: ignore[no-untyped-call]
    assert (state.names, list(state.position)) == (Settings().joints.names, posture)
    started[0].interrupted()
