"""Clocks that are set while the daemon serves: its own by libfaketime, which does not change the
monotonic clock, and the tracker's.
"""

from __future__ import annotations

import glob
import itertools
from pathlib import Path

import pytest
import zenoh

from support.cell import Daemon, Tracker, serving, told, until
from support.cell_commands import succeeded
from thirdhand.contract import cdr

LIBRARY = next(iter(glob.glob("/usr/lib/*/faketime/libfaketimeMT.so.1")), "")
OFFSETS_S = (0.3, 0.0, 3600.0, 0.0, 10 * 365 * 86_400.0)  # the clock is set ahead and back in turn
RATE_HZ = 100
# libfaketime refuses the call by which Python's sleep waits on the monotonic clock. Each process of
# Python first imports sitecustomize, where sleep is replaced.
SLEEP = "import select, time\ntime.sleep = lambda seconds: select.select([], [], [], seconds)\n"


class Commands:
    """The stamps [ns] of all commands of a daemon."""

    def __init__(self, session: zenoh.Session) -> None:
        self.stamps: list[int] = []
        self._subscriber = session.declare_subscriber("thirdhand/joints/command", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        self.stamps.append(cdr.decode_joints(sample.payload.to_bytes()).stamp_ns)


def follows(daemon: Daemon, tick: int) -> None:
    """Wait until the arm follows, some ticks after this one."""
    status = daemon.until(
        lambda now: now["mode"] == "follow" and now["tick"] > tick + RATE_HZ, 60.0
    )
    assert not any("fault" in line for line in daemon.log.read_text().splitlines()), status


def assert_replays(folder: Path) -> None:
    """Assert that the recordings in a folder replay identically."""
    files = sorted(map(str, folder.glob("*.mcap")))
    done = succeeded("replay", "--exact", *files)
    assert "identical" in done.stdout
    succeeded("report", *files)


@pytest.mark.skipif(not LIBRARY, reason="needs libfaketime: on Debian, apt install libfaketime")
def test_a_daemon_whose_clock_is_set_follows_on_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offset = tmp_path / "offset"
    records = tmp_path / "records"
    offset.write_text("+0")
    (tmp_path / "sitecustomize.py").write_text(SLEEP)
    faked = {
        "LD_PRELOAD": LIBRARY,
        "FAKETIME_TIMESTAMP_FILE": str(offset),
        "PYTHONPATH": str(tmp_path),
    }
    for name, value in (
        faked | {"FAKETIME_CACHE_DURATION": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    ).items():
        monkeypatch.setenv(name, value)
    arguments = ("--joints", "assumed", "--rate", str(RATE_HZ), "--record", str(records))
    with serving(tmp_path, *arguments) as daemon:
        monkeypatch.undo()  # processes started from here on have the true clock
        commands = Commands(daemon.session)
        with Tracker(daemon.session):
            follows(daemon, 0)
            for before_s, after_s in itertools.pairwise((0.0, *OFFSETS_S)):
                tick = daemon.client.ask("status")["tick"]
                offset.write_text(f"{after_s:+.3f}")
                how = "ahead" if after_s > before_s else "back"
                words = f"the system clock was set: {how} by {abs(after_s - before_s):.1f}"
                until(
                    lambda words=words: words in daemon.log.read_text(),
                    f"not in the log: {words}",
                    within_s=60.0,
                )
                follows(daemon, tick)
            words = "hand's stamps are 3650 days behind the daemon's clock"
            until(
                lambda: words in told("status", "--connect", daemon.endpoint).stdout,
                f"not in the status: {words}",
            )
            stamps = tuple(commands.stamps)
        assert daemon.end() == 0
    assert len(stamps) > RATE_HZ * len(OFFSETS_S)
    assert all(a < b for a, b in itertools.pairwise(stamps))
    assert_replays(records)
