"""Start of a daemon as a process of its own, on a free port and with its files in one folder, for
the demo, experiments and tests.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import select
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.requests import STARTING
from thirdhand.process.child import python
from thirdhand.settings.config import Settings

START_STALL_S = 60.0  # a start without a new report for this time has stalled
START_POLL_S = 0.1
STOP_TIMEOUT_S = 60.0
BENCH_TIMEOUT_S = 120.0
# physics of the bench; the first installed one is the default
ENGINES = {
    "pybullet": "PyBullet",
    "mujoco": "MuJoCo",
}


class LaunchError(ExplainedError, RuntimeError):
    """A daemon or the bench did not start or end; the message has its output."""


def engine_of(wanted: str | None = None) -> str:
    """The physics engine of the bench: `wanted`, or else the first of ENGINES that is installed.

    Raises LaunchError if it is not installed.
    """
    for name in (wanted,) if wanted else ENGINES:
        # raised for a module that was removed from sys.modules
        with contextlib.suppress(ValueError):
            if importlib.util.find_spec(name) is not None:
                return name
    needed = (
        f"{ENGINES[wanted]}, which is not"
        if wanted
        else f"{' or '.join(ENGINES.values())}, none of which is"
    )
    raise LaunchError(
        f"the bench needs {needed} installed: pip install 'thirdhand[sim]' (PyBullet has wheels up "
        "to Python 3.11 only)"
    )


@dataclass(frozen=True)
class Launched:
    """A running daemon: its process, its configuration, its endpoint, and its log."""

    process: subprocess.Popen[str]
    config: Path
    endpoint: str
    log: Path

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> int:
        """Stop the daemon and return its exit code. Raises LaunchError after `timeout_s` [s]."""
        self.process.terminate()
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise LaunchError(
                f"the service did not end within {timeout_s:g} s after SIGTERM"
            ) from None

    def missing(self) -> str:
        """A message on ticks that were not recorded, from the end of the log; empty if none."""
        # its import is slow, and a launch must begin at once
        from thirdhand.scribe.scribe import NOT_RECORDED

        last_lines = self.log.read_text().splitlines()[-1:]
        return "".join(
            line.split(maxsplit=2)[-1] for line in last_lines if line.endswith(NOT_RECORDED)
        )


@contextlib.contextmanager
def launched(
    folder: Path,
    *arguments: str,
    record: Path | None = None,
    settings: Settings | None = None,
    program: tuple[str, ...] = ("-m", "thirdhand"),
    network: str = '[network]\nlisten = ["tcp/127.0.0.1:0"]\n',
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[Launched]:
    """A daemon (`thirdhand serve` with the arguments) that ends with the context.

    Its configuration, log and saved via-points are in `folder`, its recordings in `record`. The
    cell is described by `settings`; `network` is the section [network] of its configuration. Raises
    LaunchError.
    """
    config = folder / "cell.toml"
    log = folder / "service.log"
    base_settings = settings or Settings()
    # followed from the start on, because nobody resumes it
    followed = msgspec.structs.replace(
        base_settings, arm=msgspec.structs.replace(base_settings.arm, start="follow")
    )
    files = {"state": folder / "state", "record": record}
    config.write_text(
        "# A cell with a free port and its own files.\n"
        f"{described(followed)}{network}[files]\n"
        + "".join(
            f"{name} = {json.dumps(str(path.absolute()))}\n"
            for name, path in files.items()
            if path is not None
        )
    )
    command = python(*program, "serve", "--config", str(config), *_end_with_this(), *arguments)
    log.write_text("")
    with log.open("a") as errors:  # others may append to it, or cut it
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
    with process:
        try:
            yield Launched(process, config, _endpoint(process, log, say), log)
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()


def described(settings: Settings) -> str:
    """The settings that differ from the defaults as TOML, without name, network and files."""
    values = msgspec.to_builtins(settings)
    usual = msgspec.to_builtins(Settings())
    changed = {name: values[name] for name in values if values[name] != usual[name]}
    rate = f"rate_hz = {changed['rate_hz']}\n" if "rate_hz" in changed else ""
    return rate + "".join(
        f"[{name}]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in section.items())
        for name, section in changed.items()
        if isinstance(section, dict) and name not in ("network", "files")
    )


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _endpoint(process: subprocess.Popen[str], log: Path, say: Callable[[str], None]) -> str:
    """The endpoint at which a daemon listens, read from its output.

    `say` is called with the progress of the start. Waiting continues while there is progress.
    Raises LaunchError.
    """
    assert process.stdout is not None
    moved_s = time.monotonic()
    last = "nothing"
    with log.open() as lines:
        while time.monotonic() - moved_s < START_STALL_S:
            if select.select([process.stdout], [], [], START_POLL_S)[0]:
                line = process.stdout.readline()
                if line.startswith("listening on "):
                    return line.split()[2].rstrip(",")
                if not line:
                    raise LaunchError(
                        "the service did not start: "
                        f"{log.read_text().strip() or 'it gave no reason'}"
                    )
            for line in lines:
                if STARTING in line:
                    moved_s = time.monotonic()
                    last = line.partition(STARTING)[2].strip()
                    say(f"  {STARTING}{last}")
    raise LaunchError(
        f"the start of the service has made no progress for {START_STALL_S:g} s. Start it again on "
        f"a machine with a free core; compiled functions are kept. Its last report: {last}"
    )


def played(
    endpoint: str,
    *arguments: str,
    say: Callable[[str], None] = lambda line: None,
    begun: Callable[[subprocess.Popen[str]], None] = lambda process: None,
    reported: Callable[[], object] = lambda: None,
    timeout_s: float = BENCH_TIMEOUT_S,
) -> str:
    """The report in JSON of one run of the bench (`python -m thirdhand_sim` with the arguments).
    `say` is called with its progress, from another thread, and `begun` with its process.

    `reported` is called once the report has arrived; the bench follows commands a moment longer, in
    which the service can be stopped: an arm that disappears is a fault. Raises LaunchError.
    """
    connection = ("--connect", endpoint, "--cell", "thirdhand")
    command = python(
        "-m", "thirdhand_sim", *connection, *_end_with_this(), "--once", "--output", "-", *arguments
    )
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    clock = threading.Timer(timeout_s, process.kill)
    clock.start()
    begun(process)
    lines: list[str] = []

    def hear() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            lines.append(line.rstrip())
            say(f"  {lines[-1]}")

    hearing = threading.Thread(target=hear, name="bench", daemon=True)
    hearing.start()
    with process:
        try:
            assert process.stdout is not None
            report = next((line for line in process.stdout if line.startswith("{")), "")
            if report:
                reported()
            code = process.wait()
        finally:
            clock.cancel()
            process.kill()
            hearing.join()
    if code != 0:
        raise LaunchError(
            f"the bench ended with code {code}: {lines[-1] if lines else 'it gave no reason'}"
        )
    return report


def _end_with_this() -> tuple[str, str]:
    """The option by which a command ends with this process, also if this one is killed."""
    return "--end-with", str(os.getpid())


def free_port() -> int:
    """A free TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
