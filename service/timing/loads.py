"""Loads beside a running daemon, and beside an empty loop in its place, for `thirdhand bench
--loads`.

`python -m service.timing.loads KIND ENDPOINT` is a process that sends requests or hands.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import contextlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kmp import KMP, GaussianKernel, Gaussians
from service.client import Client, RefusedError, UnreachableError, open_session
from service.contract.explain import ExplainedError
from service.contract.requests import ViaPoint
from service.daemon.launch import Launched, free_port, launched
from service.files.replay import replay
from service.files.shipped import SHIPPED_SKILL, recordings, shipped_skill
from service.learning.skill_file import with_file
from service.process.progress import say
from service.settings.config import Settings
from service.timing.probe import TRACKER_HZ, hands_of
from service.timing.probe_processes import probe
from service.viewer.stream import rerun_program

QUERIES_HZ, TEACHING_HZ, BURST_HZ, COLLECTIONS_HZ = 200.0, 10.0, 5000.0, 10.0
LARGE_SKILL = "large"
LARGE_POINTS = 100_000  # points of that skill
LOAD_SETTLE_S = 2.0
COLLECTING = f"""
from service.process import one_blas_thread
import gc, sys, threading, time
from service.cli.main import main

def collect():
    while True:
        time.sleep({1 / COLLECTIONS_HZ})
        gc.collect()

threading.Thread(target=collect, daemon=True).start()
sys.exit(main(sys.argv[1:]))
"""


class LoadError(ExplainedError):
    """A load could not be applied; the message has the cause."""


@dataclass(frozen=True)
class LoadedCell:
    """A running daemon under load, with a client and the port of its live view."""

    service: Launched
    client: Client
    live_port: int

    def scribe(self) -> int:
        """The process id of its scribe. Raises LoadError."""
        pid = self.client.status().scribe["pid"]
        if pid is None:
            raise LoadError("the daemon has no scribe")
        return int(pid)


@contextlib.contextmanager
def _frozen(cell: LoadedCell) -> Iterator[None]:
    pid = cell.scribe()
    os.kill(pid, signal.SIGSTOP)
    yield
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def _killed(cell: LoadedCell) -> Iterator[None]:
    os.kill(cell.scribe(), signal.SIGKILL)
    yield


@contextlib.contextmanager
def _full(cell: LoadedCell) -> Iterator[None]:
    """Limit the size of the scribe's files, which fails like a full disk."""
    pid, none = cell.scribe(), resource.RLIM_INFINITY
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096, none))
    yield
    with contextlib.suppress(ProcessLookupError):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (none, none))


@contextlib.contextmanager
def _stalled(cell: LoadedCell) -> Iterator[None]:
    """Run a viewer that connects and then stops reading."""
    with tempfile.TemporaryDirectory() as folder:
        url = f"rerun+http://127.0.0.1:{cell.live_port}/proxy"
        with _process([str(rerun_program()), "--save", str(Path(folder) / "live.rrd"), url]) as viewer:
            time.sleep(LOAD_SETTLE_S)
            if viewer.poll() is not None:
                raise LoadError(f"Rerun's program ended with code {viewer.returncode}")
            viewer.send_signal(signal.SIGSTOP)
            yield


@contextlib.contextmanager
def _beside(kind: str, cell: LoadedCell) -> Iterator[None]:
    """Run one of CLIENTS, which must not end before the load ends."""
    with running_client(kind, cell.service.endpoint) as process:
        yield
        if process.poll() is not None:
            raise LoadError(f"the client {kind!r} ended with code {process.returncode}")


@dataclass(frozen=True)
class Load:
    """A load: its title, and the context that applies it."""

    what: str
    put_on: Callable[[LoadedCell], contextlib.AbstractContextManager[object]] = contextlib.nullcontext
    program: tuple[str, ...] = ("-m", "service")


def _repeat(rate_hz: float, act: Callable[[int], object]) -> None:
    """Call `act` at a rate, or as fast as possible, until killed."""
    began, k = time.monotonic(), 0
    while True:
        with contextlib.suppress(RefusedError):
            act(k)
        if k == 0:
            print("begun", flush=True)
        k += 1
        time.sleep(max(0.0, began + k / rate_hz - time.monotonic()))


def _status(client: Client, session: Any) -> None:
    _repeat(QUERIES_HZ, lambda k: client.status())


def _teaching(client: Client, session: Any) -> None:
    """Teach one via-point again and again, alternating by a millimetre."""
    skill = shipped_skill()
    x, tool = skill.hands[0].tolist(), skill.mean(skill.hands[:1])[0].tolist()
    left, right = tuple(x[:3]), tuple(x[3:])
    _repeat(TEACHING_HZ, lambda k: client.add([ViaPoint("here", left, right, (*tool[:2], tool[2] + 0.001 * (k % 2)))]))


def _loading(client: Client, session: Any) -> None:
    names = (LARGE_SKILL, SHIPPED_SKILL.removesuffix(".npz"))
    _repeat(0.5, lambda k: client.load_skill(names[k % 2]))


def _hands(rate_hz: float, client: Client, session: Any) -> None:
    publish = hands_of(session, shipped_skill())

    def put(k: int) -> None:
        now_ns = time.time_ns()
        publish(now_ns % 10**13 / 1e9, now_ns)

    _repeat(rate_hz, put)


CLIENTS: dict[str, Callable[[Client, Any], None]] = {
    "hands": partial(_hands, TRACKER_HZ),
    "bursts": partial(_hands, BURST_HZ),
    "status": _status,
    "teaching": _teaching,
    "loading": _loading,
}
LOADS = (
    Load("nothing more"),
    Load("scribe frozen", _frozen),
    Load("scribe killed", _killed),
    Load("viewer stalled", _stalled),
    Load("disk full", _full),
    Load(f"{QUERIES_HZ:.0f} status queries a second", partial(_beside, "status")),
    Load(f"taught each {1e3 / TEACHING_HZ:.0f} ms", partial(_beside, "teaching")),
    Load(f"skills of {LARGE_POINTS} points loaded", partial(_beside, "loading")),
    Load(f"hands at {BURST_HZ / 1e3:g} kHz", partial(_beside, "bursts")),
    Load(f"{COLLECTIONS_HZ:.0f} collections a second", program=("-c", COLLECTING)),
)


def run(rate_hz: int, seconds: float, *, settings: Settings | None = None) -> list[dict[str, Any]]:
    """A row for each load: missed deadlines and lateness of the daemon's loop over `seconds` [s],
    of an empty loop under the same load, and the number of recorded ticks that replay identically.

    Raises LoadError and LaunchError.
    """
    with tempfile.TemporaryDirectory() as name:
        skills = Path(name)
        shutil.copy(recordings() / SHIPPED_SKILL, skills)
        say(f"making a skill of {LARGE_POINTS} points")
        (skills / f"{LARGE_SKILL}.npz").write_bytes(large_skill())
        rows = []
        for load in LOADS:
            say(f"{load.what}: {2 * seconds:g} s")
            rows.append({"load": load.what} | _row(load, rate_hz, seconds, skills, settings))
        return rows


def _row(load: Load, rate_hz: int, seconds: float, skills: Path, settings: Settings | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        cell: dict[str, Any] = {"settings": settings, "skills": skills, "program": load.program}
        with running_cell(folder, rate_hz, "--live", str(port), **cell) as (service, client):
            loaded = LoadedCell(service, client, port)
            with load.put_on(loaded):
                before = loaded.client.status()
                time.sleep(seconds)
                after = loaded.client.status()
                realtime = _let_others_first(service.process.pid)
                empty = probe("empty", rate_hz, seconds)
            service.stop()
        ticks = after.tick - before.tick
        replayed = [replay(path) for path in sorted(folder.glob("*.mcap"))]
        return {
            "realtime": realtime,
            "mode": after.mode,
            "ticks": ticks,
            "places": after.places,
            "scribe": {name: after.scribe[name] for name in ("lost", "restarts", "errors")},
            "missed": (after.missed - before.missed) / max(1, ticks),
            "lateness_us": msgspec.to_builtins(after.lateness_us),
            "work_us": msgspec.to_builtins(after.work_us),
            "empty_missed": empty["missed"] / max(1, empty["ticks"]),
            "empty_lateness_us": {name: empty["lateness_us"][name] for name in ("p50", "p99", "max")},
            "recorded": sum(one.ticks for one in replayed),
            "identical": sum(one.identical for one in replayed),
        }


def _let_others_first(pid: int) -> bool:
    """Take real-time scheduling from a daemon's loop; True if it had it."""
    had = os.sched_getscheduler(pid) == os.SCHED_FIFO
    if had:
        os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
    return had


@contextlib.contextmanager
def running_cell(folder: Path, rate_hz: int, *arguments: str, **cell: Any) -> Iterator[tuple[Launched, Client]]:
    """A daemon that records to a folder and has followed played hands for LOAD_SETTLE_S, and its
    client; `arguments` and `cell` are as of `launched`. Raises LoadError and LaunchError.
    """
    rate = ("--joints", "assumed", "--rate", str(rate_hz))
    with (
        launched(folder, *rate, *arguments, record=folder, say=say, **cell) as service,
        open_session(connect=[service.endpoint]) as session,
        running_client("hands", service.endpoint),
    ):
        client, until = Client(session), time.monotonic() + 15.0
        while (now := client.status()).mode != "follow":
            if time.monotonic() > until:
                raise LoadError(f"the daemon does not follow the hands: {now.mode} ({now.reason})")
            time.sleep(0.1)
        time.sleep(LOAD_SETTLE_S)
        yield service, client


def large_skill() -> bytes:
    """The file of a skill with LARGE_POINTS: the shipped skill's points, repeated with noise."""
    skill = shipped_skill()
    model: Any = skill.model
    inputs, reference = model.primitive.inputs, model.primitive.reference
    pick = np.arange(LARGE_POINTS) % len(inputs)
    beside = np.random.default_rng(0).normal(scale=0.01, size=(LARGE_POINTS, inputs.shape[1]))
    moved = inputs[pick] + beside
    primitive = KMP.fit(
        moved,
        Gaussians(model.primitive.mean(moved), reference.covariance[pick]),
        kernel=GaussianKernel(5.0),
        rank_tolerance=1e-6,
        lambda_mean=model.primitive.lambda_mean,
        prior_mean=model.primitive.prior_mean,
    )
    large = replace(model, primitive=primitive)
    return with_file(replace(skill, name=LARGE_SKILL, model=large, via_points=())).file


@contextlib.contextmanager
def running_client(kind: str, endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    """One of CLIENTS as a process of its own. Raises LoadError."""
    with _process([sys.executable, "-m", "service.timing.loads", kind, endpoint]) as process:
        assert process.stdout is not None
        if not process.stdout.readline():
            raise LoadError(f"the client {kind!r} did not begin")
        yield process


@contextlib.contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=quiet, stdin=quiet) as process:
        try:
            yield process
        finally:
            process.kill()


def text(rows: list[dict[str, Any]]) -> str:
    """The rows as a table in text."""
    lines = [
        f"{'':<34}{'missed':>9}{'late p50':>10}{'p99 µs':>9}{'empty:':>10}{'p50':>8}{'p99':>9}  replayed identically"
    ]
    for row in rows:
        late, empty = row["lateness_us"], row["empty_lateness_us"]
        lines.append(
            f"  {row['load']:<32}{100 * row['missed']:8.2f}%{late['p50']:10.1f}{late['p99']:9.1f}"
            f"{100 * row['empty_missed']:9.2f}%{empty['p50']:8.1f}{empty['p99']:9.1f}"
            f"  {row['identical']} of {row['recorded']}"
        )
    return "\n".join(lines)


def main(kind: str, endpoint: str) -> int:
    """Run one of CLIENTS until it is killed."""
    with contextlib.suppress(UnreachableError), open_session(connect=[endpoint]) as session:
        CLIENTS[kind](Client(session), session)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
