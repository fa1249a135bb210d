"""Viewers that lag: data that they do not read is omitted, not queued, and later viewers see new
data.
"""

from __future__ import annotations

import contextlib
import http.client
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from support.cell import until
from support.recorded import drawn, ticks, values
from thirdhand.scribe.process import LiveView
from thirdhand.scribe.protocol import TickMessage
from thirdhand.settings.config import WAM, Settings
from thirdhand.viewer.stream import Viewer, rerun_program

pytestmark = pytest.mark.thorough

# speed over real time, and duration of the scene [s] at 500 ticks a second
TIMES_REAL = 4
SCENE_S = 48
BOUND_MB = 100.0
TIMEOUT_S = 60.0
# the path at which browsers request the stream
STREAM = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"


def resident_mb() -> float:
    """The resident memory of this process [MB]."""
    (line,) = (
        row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmRSS")
    )
    return int(line.split()[1]) / 1000


class Fed:
    """A live view that is fed continuously."""

    def __init__(self) -> None:
        self.view = LiveView(lambda: Viewer(urdf=WAM, settings=Settings(), live_port=0))
        self.view.is_paused = False
        self.last = 0
        self.url = until(lambda: self.view.url, within_s=TIMEOUT_S)
        self._ticks = ticks(1_000_000)

    def feed(self, scene_s: float) -> None:
        """Feed a part of the scene [s], at four times the real speed."""
        began = time.monotonic()
        for k in range(round(scene_s * 500)):
            tick, frame, timing = next(self._ticks)
            self.view.add(TickMessage(tick, frame, timing, None, None, 0))
            self.last = tick.index
            time.sleep(max(0.0, began + k / 500 / TIMES_REAL - time.monotonic()))


@contextlib.contextmanager
def browser(url: str) -> Iterator[None]:
    """A connection that requested the stream and reads nothing."""
    connection = http.client.HTTPConnection(
        urlsplit(url.removeprefix("rerun+")).netloc, timeout=TIMEOUT_S
    )
    kind = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"}
    connection.request("POST", STREAM, bytes(5), kind)
    with contextlib.closing(connection):
        yield


@contextlib.contextmanager
def program(url: str, file: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's program, which saves the received stream."""
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        [str(rerun_program()), "--save", str(file), url], stdout=quiet, stderr=quiet
    ) as viewer:
        try:
            yield viewer
        finally:
            viewer.kill()


@contextlib.contextmanager
def stopped(url: str, file: Path) -> Iterator[None]:
    """Rerun's program, stopped once it receives."""
    with program(url, file) as viewer:
        until(lambda: file.is_file() and file.stat().st_size > 10_000, within_s=TIMEOUT_S)
        viewer.send_signal(signal.SIGSTOP)
        yield


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the file is still being written
def test_memory_is_bounded_beside_stopped_viewers(tmp_path: Path) -> None:
    """Later viewers see new data."""
    fed = Fed()
    fed.feed(4.0)
    with browser(fed.url), stopped(fed.url, tmp_path / "stopped.rrd"):
        before_mb = resident_mb()
        fed.feed(SCENE_S)
        assert resident_mb() - before_mb < BOUND_MB
    connected = fed.last
    with program(fed.url, tmp_path / "later.rrd") as viewer:
        end_s = time.monotonic() + TIMEOUT_S
        newest_tick = -1
        while newest_tick <= connected:
            assert viewer.poll() is None
            assert time.monotonic() < end_s
            fed.feed(4.0)
            # the file may be empty, or end within a message
            with contextlib.suppress(OSError, KeyError, RuntimeError):
                newest_tick = values(drawn(tmp_path / "later.rrd")["/joints/position"], "tick")[-1]
    fed.view.close()
    assert fed.view.problems == []
