"""A connection where nobody answers or listens, and in a forked process."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time

import pytest
import zenoh

from support.cell import until
from support.cell_commands import python
from thirdhand.client import Connection, UnreachableError, Watch, connect, endpoints, open_session
from thirdhand.client import connection as calls

CONNECT = """
import sys, thirdhand
thirdhand.connect(sys.argv[1], timeout_s=60)
"""
FORK = """
import os, signal, sys, thirdhand
cell = thirdhand.connect(sys.argv[1], cell="bench")
watch = cell.watch("status")
def connected():
    thirdhand.connect(sys.argv[1], cell="bench", timeout_s=None)
def ready():
    cell.wait_until_ready(timeout_s=None)
if os.fork():
    os.wait()
    sys.exit(0)
signal.alarm(20)
for call in (connected, ready, cell.status, lambda: cell.clutch(True), lambda: next(watch)):
    try:
        call()
    except thirdhand.UnreachableError as error:
        print("spawn" in str(error), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no signal can be sent to one process")
def test_connecting_ends_soon_after_ctrl_c() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(20)
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        command = [sys.executable, "-c", CONNECT, endpoint]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as program:
            silent.accept()[0].close()
            program.send_signal(signal.SIGINT)
            _, report = program.communicate(timeout=10)
    assert report.endswith(b"KeyboardInterrupt\n"), report.decode()


def test_connecting_is_tried_until_its_timeout() -> None:
    """A daemon that begins to listen meanwhile is reached; without one, the time is kept."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        begun_s = time.monotonic()
        with pytest.raises(UnreachableError, match="nobody answers at"):
            connect(f"tcp/127.0.0.1:{silent.getsockname()[1]}", timeout_s=1.5)
        assert 1.5 < time.monotonic() - begun_s < 15.0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_a_fork_of_a_connected_program_says_so(listener: zenoh.Session) -> None:
    done = python(FORK, *endpoints(listener), env=os.environ | {"PYTHONWARNINGS": "ignore"})
    assert (done.returncode, done.stdout) == (0, "True\n" * 5), done.stderr


def test_publishing_fails_once_a_daemon_is_gone_for_long(
    listener: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At first a daemon may restart; it is heard again as soon as it listens."""
    monkeypatch.setattr(calls, "LISTENER_TIMEOUT_S", 2.0)

    def is_refused() -> bool:
        try:
            cell.hands(left=(0, 0, 0))
        except UnreachableError as error:
            return "nobody listens to bench/hands/left" in str(error)
        return False

    with Connection(open_session(connect=endpoints(listener)), "bench") as cell:
        with Watch(listener, "bench", "hands/left"):
            cell.hands(left=(0, 0, 0))
        assert not is_refused()
        until(is_refused)
        with Watch(listener, "bench", "hands/left", timeout_s=0.1) as watch:
            until(lambda: not is_refused())
            until(lambda: next(watch) is not None)
