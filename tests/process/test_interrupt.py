"""Ctrl-C at many moments of real processes: one line, exit 130, no traceback, nothing left."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.cell_commands import python
from support.paths import RECORDINGS, ROOT

SAID = "thirdhand: interrupted"
DELAYS_S = (0.0, 0.1, 0.5, 1.5)  # since the process handles interrupts
OTHERS = ("demo", "replay", "learn", "status", "play")
GOLDEN = str(RECORDINGS / "golden.mcap")
DEMONSTRATIONS = [str(RECORDINGS / f"demonstration-{number}.mcap") for number in range(1, 6)]
CLEAN_UP_SLOWLY = """
import time
from thirdhand.process import interrupt
interrupt.watch()
with interrupt.clean_up_first():
    try:
        print("begun", flush=True)
        time.sleep(60)
    finally:
        print("putting away", flush=True)
        time.sleep(60)
"""


INTERRUPTED_JUST_BEFORE = """
import os, signal, sys, time
from thirdhand.process import interrupt
interrupt.watch()
sys.setswitchinterval(60)  # the thread gets its turn only when this one waits
os.kill(os.getpid(), signal.SIGINT)
with interrupt.clean_up_first():
    time.sleep(5)
"""


def wait_for(what: Callable[[], bool], timeout_s: float = 60.0) -> None:
    end = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.fixture
def nobody() -> Iterator[str]:
    """An endpoint that accepts connections and never answers, so that commands wait."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield f"tcp/127.0.0.1:{listening.getsockname()[1]}"


def begun(arguments: list[str], said: Path) -> subprocess.Popen[bytes]:
    """A running command that handles interrupts; a second thread shows that it does."""
    with said.open("wb") as errors:
        command = [sys.executable, "-m", "thirdhand", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, cwd=ROOT)
    wait_for(lambda: process.poll() is not None or len(os.listdir(f"/proc/{process.pid}/task")) > 1)
    return process


INTERRUPTED_AT_AN_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "MODULE":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from thirdhand.__main__ import main
main()
"""


@pytest.mark.parametrize(
    "module",
    [
        "thirdhand.process.interrupt",
        "contextlib",
        "thirdhand.cli",
        "thirdhand.client",
        "thirdhand.cli.status",
    ],
)
def test_interrupt_during_imports_leaves_no_traceback(module: str) -> None:
    """Any import after the first line of the program; Python's own imports come before."""
    code = f"import sys\nsys.path[:0] = {sys.path}\n" + INTERRUPTED_AT_AN_IMPORT.replace(
        "MODULE", module
    )
    command = [sys.executable, "-S", "-c", code, "status", "--connect", "tcp/127.0.0.1:1"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, cwd=ROOT
    )
    assert "Traceback" not in done.stderr
    assert done.returncode in (130, -signal.SIGINT)


@pytest.mark.parametrize(
    ("name", "delay_s"),
    [
        *(("serve", delay_s) for delay_s in DELAYS_S),
        *((name, 0.1) for name in OTHERS),
        ("demo", 1.5),
    ],
)
@pytest.mark.one_case
def test_an_interrupt_ends_a_command_with_one_line(
    tmp_path: Path, nobody: str, name: str, delay_s: float
) -> None:
    (tmp_path / "cell.toml").write_text(
        f'[network]\nlisten = ["tcp/127.0.0.1:0"]\n[files]\nstate = "{tmp_path}"\n'
    )
    arguments = {
        "serve": ["--config", str(tmp_path / "cell.toml"), "--connect", nobody],
        "demo": ["--output", str(tmp_path / "demo")],
        "replay": [GOLDEN],
        "learn": [*DEMONSTRATIONS, "--output", str(tmp_path / "skill.npz")],
        "status": ["--connect", nobody],
        "play": [GOLDEN, "--connect", nobody],
    }[name]
    output = tmp_path / "said"
    process = begun([name, *arguments], output)
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 130
    text = output.read_text()
    assert text.splitlines()[-1] == SAID
    assert text.count(SAID) == 1
    assert "Traceback" not in text


@pytest.mark.thorough
def test_interrupt_after_the_work_keeps_the_exit_code(tmp_path: Path) -> None:
    output = tmp_path / "said"
    skill = tmp_path / "skill.npz"
    process = begun(["learn", *DEMONSTRATIONS, "--output", str(skill)], output)
    wait_for(skill.exists)
    while process.poll() is None:  # also while the interpreter shuts down
        process.send_signal(signal.SIGINT)
        time.sleep(0.001)
    assert process.returncode in (0, 130)
    assert "Traceback" not in output.read_text()


@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda number: number.name
)
@pytest.mark.thorough
def test_a_demo_that_is_ended_leaves_no_process_behind(
    tmp_path: Path, number: signal.Signals
) -> None:
    output = tmp_path / "said"
    process = begun(["demo", "--output", str(tmp_path / "demo")], output)
    wait_for(lambda: "commands arrive" in output.read_text(), 100)

    def services() -> list[bytes]:
        lines = subprocess.run(
            ["ps", "-ewwo", "args"], capture_output=True, check=True
        ).stdout.splitlines()
        return [line for line in lines if str(tmp_path).encode() in line and b"defunct" not in line]

    assert len(services()) == 3  # the demo, its daemon and its bench
    process.send_signal(number)
    assert process.wait(60) == (130 if number == signal.SIGINT else -number)
    if number == signal.SIGINT:
        assert services() == []
        assert output.read_text().splitlines()[-1] == SAID
    wait_for(lambda: not services())
    assert "Traceback" not in output.read_text()


def test_silent_bench_ends_with_its_parent(tmp_path: Path) -> None:
    """A bench that prints would end by its closed pipe anyway."""
    output = tmp_path / "said"
    with subprocess.Popen(["sleep", "600"]) as runs_it:
        bench = begun(
            ["sim", "--listen", "tcp/127.0.0.1:0", "--end-with", str(runs_it.pid)], output
        )
        try:
            wait_for(lambda: "listening on" in output.read_text(), 100)
            assert bench.poll() is None
            runs_it.kill()
            runs_it.wait()
            assert bench.wait(30) == 0
        finally:
            bench.kill()
            runs_it.kill()


def test_a_second_interrupt_does_not_wait_for_what_is_put_away() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", CLEAN_UP_SLOWLY],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "putting away\n"
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, error_text = process.communicate(timeout=10)
    assert (process.returncode, error_text) == (130, f"{SAID}\n")


def test_early_interrupt_is_not_lost() -> None:
    """The interrupt arrives just before the code that cleans up is entered."""
    done = python(INTERRUPTED_JUST_BEFORE)
    assert (done.returncode, done.stderr) == (130, f"{SAID}\n")


def test_an_interrupt_that_is_ignored_stays_so() -> None:
    """A shell ignores interrupts for background commands."""
    code = (
        "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nfrom thirdhand.process "
        "import interrupt\n"
        "interrupt.watch()\nsignal.raise_signal(signal.SIGINT)\nprint('goes on')"
    )
    done = python(code)
    assert (done.returncode, done.stdout) == (0, "goes on\n")
