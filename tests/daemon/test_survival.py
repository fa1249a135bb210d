"""Survival and end of a daemon: failing parts, signals, a second daemon of its cell, and its child
processes when it is killed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from support.cell import LISTENING, Daemon, Tracker, is_running, serving, thirdhand, until
from support.paths import ROOT
from support.sabotage import SABOTAGE, fail
from thirdhand.client import Client, RefusedError, UnreachableError, open_session
from thirdhand.daemon.launch import free_port
from thirdhand.daemon.single_instance import Lock
from thirdhand.recordings.replay import replay


def children(pid: int) -> list[int]:
    """The child processes of a process that still run."""
    done = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False
    )
    return [int(line) for line in done.stdout.split()]


def until_gone(pids: list[int], within_s: float) -> None:
    until(lambda: not any(map(is_running, pids)), "processes are left", within_s=within_s)


def is_at_fault(status: dict[str, Any]) -> bool:
    return (status["mode"], status["reason"]) == ("fault", "service")


def test_failed_part_is_a_fault_and_all_goes_on(tmp_path: Path) -> None:
    """The fault is reported, and the other parts continue. Nothing is rehearsed: a tick whose
    rehearsal fails is not lost.
    """
    records = tmp_path / "records"
    with (
        serving(
            tmp_path,
            "--joints",
            "assumed",
            "--record",
            str(records),
            before=SABOTAGE.format(folder=str(tmp_path)),
            network=f"{LISTENING}[loop]\nprepare = false\n",
        ) as daemon,
        Tracker(daemon.session),
    ):
        for name, provoke in {
            "status": lambda: None,
            "enqueue": lambda: daemon.client.ask("resume"),
            "note": lambda: daemon.client.ask("resume"),
            "step": lambda: None,
            "outgoing": lambda: None,
        }.items():
            daemon.until(lambda status: status["mode"] == "follow")
            fail(tmp_path, name, "once")
            with contextlib.suppress(UnreachableError):  # the request is not answered
                provoke()
            daemon.until(is_at_fault)
            assert f"{name} is sabotaged" in daemon.log.read_text()
            daemon.client.ask("hold")
            daemon.client.ask("reset")
            daemon.client.ask("resume")
        daemon.until(lambda status: status["mode"] == "follow")
        # the recording is incomplete, and its last line says so
        assert daemon.end() == 1
        assert daemon.log.read_text().endswith("ticks are not recorded\n")
    (recording,) = records.glob("*.mcap")
    result = replay(recording)
    assert result.identical == result.ticks > 0, result.text()
    assert [gap.lost for gap in result.missing] == [1, 1]  # the ticks at which the loop failed


def test_failure_while_following_is_a_fault_too(tmp_path: Path) -> None:
    """Each rehearsal and each tick fail until the tick that takes in the fault."""
    sabotage = SABOTAGE.format(folder=str(tmp_path))
    with (
        serving(tmp_path, "--joints", "assumed", before=sabotage) as daemon,
        Tracker(daemon.session),
    ):
        daemon.until(lambda status: status["mode"] == "follow")
        fail(tmp_path, "follow")
        daemon.until(is_at_fault)
        (tmp_path / "follow").unlink()
        for request in ("hold", "reset", "resume"):
            daemon.client.ask(request)
        daemon.until(lambda status: status["mode"] == "follow")


def test_a_loop_that_cannot_go_on_ends_the_daemon_with_words(tmp_path: Path) -> None:
    """The daemon has no folder for its lock, and serves nevertheless."""
    (tmp_path / "state").write_text("a file where a folder is needed")
    with serving(
        tmp_path, "--joints", "assumed", before=SABOTAGE.format(folder=str(tmp_path))
    ) as daemon:
        started = children(daemon.process.pid)
        daemon.until(lambda status: status["tick"] > 0)
        assert (
            "a second daemon of this cell is only detected through Zenoh" in daemon.log.read_text()
        )
        fail(tmp_path, "step")
        assert daemon.process.wait(20) == 1
        assert "step is sabotaged" in daemon.log.read_text()
        assert "the arm gets no more commands" in daemon.log.read_text()
        until_gone(started, 10)


def test_a_lock_that_is_a_link_or_a_pipe_is_left_alone(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("untouched")
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "daemon.lock").symlink_to(victim)
    (tmp_path / "pipe").mkdir()
    os.mkfifo(tmp_path / "pipe" / "daemon.lock")
    for name in ("link", "pipe"):
        lock = Lock(tmp_path / name, "thirdhand")
        lock.announce(["tcp/127.0.0.1:1"])
        lock.close()
    assert victim.read_text() == "untouched"


@pytest.mark.parametrize(
    "signals", [[signal.SIGHUP], [signal.SIGINT] * 5, [signal.SIGTERM, signal.SIGHUP]]
)
@pytest.mark.one_case
def test_the_arm_is_stopped_and_files_are_closed_on(tmp_path: Path, signals: list[int]) -> None:
    """`resume` is requested all the time, but nobody can cancel the stop of a daemon that ends."""
    records = tmp_path / "records"
    with (
        serving(tmp_path, "--joints", "assumed", "--record", str(records)) as daemon,
        Tracker(daemon.session) as tracker,
    ):
        daemon.until(lambda status: status["mode"] == "follow")
        tracker.left = (0.8, -0.25, 0.2)  # moves the arm
        ended = threading.Event()

        def resume() -> None:
            while not ended.is_set():
                with contextlib.suppress(UnreachableError, RefusedError):
                    daemon.client.ask("resume")

        asking = threading.Thread(target=resume)
        asking.start()
        time.sleep(0.2)
        for number in signals:
            daemon.process.send_signal(number)
            time.sleep(0.02)
        assert daemon.process.wait(30) == 0
        ended.set()
        asking.join(20)
        log = daemon.log.read_text()
        assert "Traceback" not in log
        assert "did not come to rest" not in log  # the stop did not time out
    (recording,) = records.glob("*.mcap")
    last = log.splitlines()[-1]
    assert last.endswith(
        f" ended: the daemon of cell thirdhand; its newest recording is {recording}"
    )
    # its own stop is no operator's hold, which `resume` would end
    assert "operator" not in log
    result = replay(recording)
    assert result.exact, result.text()


def test_paused_daemon_counts_what_it_missed(tmp_path: Path) -> None:
    """The daemon continues after the pause."""
    with serving(tmp_path, "--joints", "assumed") as daemon, Tracker(daemon.session):
        before = daemon.until(lambda now: now["mode"] == "follow")
        daemon.process.send_signal(signal.SIGSTOP)
        time.sleep(1.0)
        daemon.process.send_signal(signal.SIGCONT)
        after = daemon.until(
            lambda now: now["tick"] > before["tick"] + 400 and now["mode"] == "follow"
        )
        assert after["missed"] - before["missed"] >= 400
        assert after["tick"] - before["tick"] > after["missed"] - before["missed"]


def test_a_second_daemon_of_a_cell_does_not_start(tmp_path: Path) -> None:
    """The second daemon does not start even if Zenoh does not show it the first one. A daemon of
    another cell starts. That a cell is free after the end of its daemon is tested in
    test_via_points_survive_a_restart.
    """
    with serving(tmp_path, "--joints", "assumed") as daemon:
        arguments = (
            "serve",
            "--joints",
            "assumed",
            "--listen",
            "tcp/127.0.0.1:0",
            "--connect",
            daemon.endpoint,
        )
        refused = thirdhand(*arguments, env=os.environ | {"HOME": str(tmp_path / "home")})
        assert refused.returncode == 1
        assert "cell thirdhand is already served" in refused.stderr
        assert f"listening on {daemon.endpoint}" in refused.stderr
        assert "Traceback" not in refused.stderr
        unseen = thirdhand("serve", "--joints", "assumed", "--config", str(tmp_path / "cell.toml"))
        assert unseen.returncode == 1
        assert "cell thirdhand is already served on this machine" in unseen.stderr
        assert f"process {daemon.process.pid}, listening on {daemon.endpoint}" in unseen.stderr
        assert "Traceback" not in unseen.stderr
        lock = tmp_path / "state" / "thirdhand" / "daemon.lock"
        assert stat.S_IMODE(lock.stat().st_mode) == 0o600
        assert stat.S_IMODE(lock.parent.stat().st_mode) == 0o700
        other = tmp_path / "other"
        other.mkdir()
        with serving(
            other, "--joints", "assumed", "--connect", daemon.endpoint, "--cell", "bench/2"
        ):
            assert daemon.client.status().cell == "thirdhand"
        assert daemon.end() == 0


def test_killed_skill_worker_changes_nothing(tmp_path: Path) -> None:
    """A killed daemon leaves no child process."""
    records = tmp_path / "records"
    with serving(tmp_path, "--joints", "assumed", "--record", str(records)) as daemon:

        def skill_worker() -> int:
            names = {
                pid: Path(f"/proc/{pid}/comm").read_text().strip()
                for pid in children(daemon.process.pid)
            }
            assert len(names) == 3  # one is the process that forks the others
            assert set(names.values()) >= {"scribe", "skill worker"}
            return next(pid for pid, name in names.items() if name == "skill worker")

        taught = teach(daemon, 3)
        tick = daemon.client.status().tick
        # The worker also computes the tool's limits. Kill it when it has nothing else to do.
        daemon.until(lambda status: status["tick"] > tick and status["tool_limits"])
        first = skill_worker()
        os.kill(first, signal.SIGSTOP)
        killing = threading.Timer(0.3, os.kill, [first, signal.SIGKILL])
        killing.start()
        with pytest.raises(
            RefusedError, match="ended while it worked; nothing was changed, try again"
        ):
            teach(daemon, 5)
        killing.join()
        assert daemon.client.ask("via_points", {"op": "list"})["points"] == taught
        with contextlib.suppress(RefusedError):  # the new process may start late on a busy machine
            teach(daemon, 5)
        assert len(teach(daemon, 5)) == 5

        busy = skill_worker()
        started = children(daemon.process.pid)
        assert busy != first
        daemon.until(lambda status: status["tick"] > 600)
        os.kill(busy, signal.SIGSTOP)  # it cannot notice the daemon's end
        daemon.process.kill()
        daemon.process.wait()
        until_gone([pid for pid in started if pid != busy], 20)
        os.kill(busy, signal.SIGCONT)
        until_gone([busy], 10)
    (recording,) = records.glob("*.mcap")
    assert replay(recording).exact


def teach(daemon: Daemon, count: int) -> list[dict[str, Any]]:
    """The via-points in force after teaching this number of them."""
    others = {"right": [0.98, 0.32, 0.06], "tool": [0.62, -0.28, 0.3], "std": 0.01}
    points = [
        {"name": f"p{i}", "left": [0.6 + 0.02 * i, -0.28, 0.3], **others} for i in range(count)
    ]
    points_in_force: list[dict[str, Any]] = daemon.client.ask(
        "via_points", {"op": "add", "points": points}
    )["points"]
    return points_in_force


@pytest.mark.parametrize(
    "streams", ["> /dev/full", "2> /dev/full", "> >(true)", ">&-", "2>&-", "<&- >&- 2>&-"]
)
@pytest.mark.one_case
def test_arm_does_not_depend_on_readers_of_the_output(tmp_path: Path, streams: str) -> None:
    """The readers of standard output and standard error end."""
    (tmp_path / "cell.toml").write_text(f'[files]\nstate = "{tmp_path}"\n')
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = (
        f"exec {sys.executable} -m thirdhand serve --joints assumed --config {tmp_path}/cell.toml "
        f"--listen {endpoint}"
    )
    running = subprocess.Popen(
        ["bash", "-c", f"{command} {streams}"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        with open_session(connect=[endpoint], timeout_s=60.0) as session:
            status = Client(session).wait_until_ready()
            time.sleep(0.5)
            assert (status.mode, Client(session).status().reason) == ("hold", "no_hands")
        running.terminate()
        output, _ = running.communicate(timeout=30)
        assert running.returncode == 0, output
        assert "Traceback" not in output
        if streams == "> /dev/full":
            assert (
                f"listening on {endpoint} as cell thirdhand (standard output: No space left on "
                "device" in output
            )
    finally:
        running.kill()
        running.wait()


def test_a_child_at_work_ends_with_its_parent(tmp_path: Path) -> None:
    """The child never reads its socket; the parent's thread that started it ends before the
    parent.
    """
    (tmp_path / "busy.py").write_text(
        "import time\nfrom thirdhand.process import child\n"
        "def run(channel):\n    child.end_with_parent()\n    while True: time.sleep(0.01)\n"
    )
    parent = (
        "import socket, sys, threading, time\nfrom thirdhand.process import child\nstarted = []\n"
        "thread = threading.Thread(target=lambda: started.append(child.start('busy', 'busy', "
        "socket.SOCK_STREAM)))\n"
        "thread.start()\nthread.join()\nassert started[0].has_begun(60)\n"
        "print(started[0].pid, flush=True)\ntime.sleep(60)\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    running = subprocess.Popen(
        [sys.executable, "-c", parent],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert running.stdout is not None
    busy = int(running.stdout.readline())
    time.sleep(0.5)
    assert is_running(busy)
    running.kill()
    running.wait()
    running.stdout.close()
    until_gone([busy], 5)
