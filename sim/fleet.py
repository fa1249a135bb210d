"""`python -m sim.fleet`: many cells behind two routers, of which each is killed once. It counts the
lost statuses, and measures how soon all are connected again, and a real daemon's latency.

    tracker, driver, observer -> router b <- router a <- daemon
           half of the cells ---^              ^--- half of the cells

A cell is a Zenoh session that publishes a real daemon's status under its own name.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import contextlib
import functools
import json
import math
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from service.client import Client, Tracker, open_session
from service.contract import cdr, channels
from service.contract.requests import Status
from service.daemon.launch import free_port, launched

STATUS_HZ, TRACKED_HZ = 10, 100
BATCH = 25  # cells in one process
DOWN_S = 1.0  # a killed router is started again after this time
CONNECTED_WITHIN_S = 10.0  # time in which all are to be connected again
OPEN_S = 60.0
RESTING_HANDS = {"left": (0.98, -0.32, 0.06), "right": (0.98, 0.32, 0.06)}  # [m]
SWAYING_M, SWAYING_HZ = 0.03, 0.3
REAL_CELL = "real"  # name of the real daemon's cell


class Observer:
    """The statuses of each cell: how many arrived, how many were lost by number, and when."""

    def __init__(self, session: zenoh.Session) -> None:
        self.received, self.lost = defaultdict[str, int](int), defaultdict[str, int](int)
        self.at_s: dict[str, float] = {}
        self._number: dict[str, int] = {}
        self._subscriber = session.declare_subscriber("**/status", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        if (info := sample.source_info) is None:
            return
        cell = str(sample.key_expr).removesuffix("/status")
        self.lost[cell] += info.source_sn - self._number.get(cell, info.source_sn - 1) - 1
        self.received[cell] += 1
        self._number[cell], self.at_s[cell] = info.source_sn, time.monotonic()

    def first_after(self, at_s: float, cells: list[str], *, timeout_s: float) -> dict[str, float]:
        """The time [s] from `at_s` to the first later status of each cell that has one."""
        found: dict[str, float] = {}
        while len(found) < len(cells) and time.monotonic() < at_s + timeout_s:
            time.sleep(0.002)
            found |= {cell: self.at_s[cell] - at_s for cell in cells if cell not in found and self.at_s[cell] > at_s}
        return found


class Latency:
    """Times from a hand's stamp to the arrival of the first command that answers it [ms]."""

    def __init__(self, session: zenoh.Session) -> None:
        self.times_ms: list[float] = []
        self._answered_ns = 0
        self._subscriber = session.declare_subscriber(channels.key(REAL_CELL, "joints/command"), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        if sample.attachment is not None:
            stamp_ns = cdr.decode_attachment(sample.attachment.to_bytes()).hand_stamp_ns
            if stamp_ns > self._answered_ns:
                self._answered_ns = stamp_ns
                self.times_ms.append((now_ns - stamp_ns) / 1e6)

    def over(self, seconds: float) -> dict[str, float]:
        """Percentiles of the answers in the next seconds."""
        begin = len(self.times_ms)
        time.sleep(seconds)
        found = self.times_ms[begin:]
        p50, p99, largest = np.percentile(found, (50, 99, 100)).round(2).tolist() if found else (math.nan,) * 3
        return {"p50_ms": p50, "p99_ms": p99, "max_ms": largest, "answers": len(found)}


class Router:
    """A router in a process of its own, which can be killed and started again."""

    def __init__(self, *connect: str) -> None:
        self.endpoint, self._connect = f"tcp/127.0.0.1:{free_port()}", connect
        self.start()

    def start(self) -> float:
        """Start it and return the time at which its port first accepts a connection [s]."""
        command = [sys.executable, "-m", "sim.fleet", "--route", self.endpoint, *self._connect]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        host, port = self.endpoint.removeprefix("tcp/").split(":")
        listens_s = None
        while listens_s is None:
            with contextlib.suppress(ConnectionRefusedError):
                socket.create_connection((host, int(port)), timeout=1.0).close()
                listens_s = time.monotonic()
            time.sleep(0.002)
        self._process.stdout.readline()
        return listens_s

    def kill(self) -> None:
        """Kill it without a goodbye."""
        self._process.kill()
        self._process.communicate()


def route(endpoint: str, connect: list[str]) -> None:
    """Route until standard input ends."""
    with open_session(listen=[endpoint], connect=connect, more={"mode": "router", "connect/exit_on_failure": False}):
        print("listening", flush=True)
        sys.stdin.read()


def answer(payload: bytes, query: zenoh.Query) -> None:
    """Answer a request for a status."""
    with query:
        query.reply(query.key_expr, payload)


def publish(endpoint: str, cells: list[str]) -> None:
    """Publish the status of standard input's first line as each cell's, until standard input ends;
    then print how many were sent.
    """
    status = msgspec.json.decode(sys.stdin.readline(), type=Status)
    sessions = [open_session(connect=[endpoint], timeout_s=OPEN_S) for _ in cells]
    tokens = [
        session.liveliness().declare_token(channels.presence(cell, str(session.zid())))
        for cell, session in zip(cells, sessions, strict=True)
    ]
    payloads = [msgspec.json.encode(msgspec.structs.replace(status, cell=cell)) for cell in cells]
    publishers = [
        session.declare_publisher(channels.key(cell, "status"), congestion_control=zenoh.CongestionControl.DROP)
        for cell, session in zip(cells, sessions, strict=True)
    ]
    queryables = [
        session.declare_queryable(one.key_expr, functools.partial(answer, payload))
        for session, one, payload in zip(sessions, publishers, payloads, strict=True)
    ]
    print("publishing", flush=True)
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    number, due_s = 0, time.monotonic()
    while not ended.wait(max(0.0, due_s - time.monotonic())):
        for one, payload in zip(publishers, payloads, strict=True):
            one.put(payload, source_info=zenoh.SourceInfo(one.id, number))
        number, due_s = number + 1, due_s + 1.0 / STATUS_HZ
    print(number, flush=True)
    del tokens, queryables
    for session in sessions:
        session.close()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def cells_of(endpoint: str, cells: list[str], status: Status) -> Iterator[list[int]]:
    """Run cells behind a router; the yielded list has, at the end, the statuses that each sent."""
    batches = [cells[i : i + BATCH] for i in range(0, len(cells), BATCH)]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "sim.fleet", "--publish", endpoint, *batch],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for batch in batches
    ]  # fmt: skip
    sent: list[int] = []
    try:
        for process in processes:
            assert process.stdin is not None
            process.stdin.write(msgspec.json.encode(status).decode() + "\n")
            process.stdin.flush()
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield sent
    finally:
        for process, batch in zip(processes, batches, strict=True):
            output = process.communicate(timeout=OPEN_S)[0]
            sent += [int(output or 0)] * len(batch)


def sway(tracker: Tracker, ended: threading.Event) -> None:
    """Publish swaying hands until the end."""
    while not ended.wait(1.0 / TRACKED_HZ):
        y = SWAYING_M * math.sin(2 * math.pi * SWAYING_HZ * time.monotonic())
        for side, at in RESTING_HANDS.items():
            tracker.publish(side, (at[0], at[1] + y, at[2]))


def measured(count: int, seconds: float) -> dict[str, Any]:
    """The figures of a run."""
    a = Router()
    b = Router(a.endpoint)
    routers = {"a": a, "b": b}
    behind = {name: [f"lab/{name}{i}" for i in range(count // 2)] for name in routers}
    every = [cell for cells in behind.values() for cell in cells]
    config = f'cell = "{REAL_CELL}"\n[network]\nlisten = ["tcp/127.0.0.1:0"]\nconnect = ["{a.endpoint}"]\n'
    out: dict[str, Any] = {"cells": len(every), "status_hz": STATUS_HZ, "hands_hz": TRACKED_HZ}
    ended = threading.Event()
    with contextlib.ExitStack() as stack:
        for one in routers.values():
            stack.callback(one.kill)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(launched(folder, "--joints", "assumed", network=config))
        session = stack.enter_context(open_session(connect=[b.endpoint]))
        client = Client(session, REAL_CELL)
        client.wait_until_ready(timeout_s=OPEN_S)
        latency, observer = Latency(session), Observer(session)
        threading.Thread(target=sway, args=(Tracker(session, REAL_CELL), ended), daemon=True).start()
        stack.callback(ended.set)
        time.sleep(2.0)
        out["hand_to_command_alone"] = latency.over(seconds)
        status = client.status()
        out["status_bytes"] = len(msgspec.json.encode(status))
        sent = {
            name: stack.enter_context(cells_of(one.endpoint, behind[name], status)) for name, one in routers.items()
        }
        time.sleep(2.0)
        begin, lost = sum(observer.received.values()), sum(observer.lost.values())
        out["hand_to_command_beside_cells"] = latency.over(seconds)
        out["undisturbed"] = {
            "received": sum(observer.received.values()) - begin,
            "lost": sum(observer.lost.values()) - lost,
            "cells_seen": sum(cell in observer.at_s for cell in every),
        }
        for name, one in routers.items():
            lost = sum(observer.lost.values())
            one.kill()
            killed_s = time.monotonic()
            time.sleep(DOWN_S)
            back_s = one.start()
            cut_off = [*every, REAL_CELL] if name == "b" else behind[name]
            found = observer.first_after(back_s, cut_off, timeout_s=CONNECTED_WITHIN_S)
            times_s = sorted(found.values())
            time.sleep(2.0)
            out[f"router_{name}_killed"] = {
                "down_s": round(back_s - killed_s, 2),
                "cells": len(found),
                "first_status_after_its_port_opens_s": {
                    "median": round(float(np.median(times_s)), 3), "p90": round(float(np.percentile(times_s, 90)), 3),
                    "last": round(times_s[-1], 3),
                } if times_s else None,
                "statuses_lost": sum(observer.lost.values()) - lost,
            }  # fmt: skip
        time.sleep(1.0)
        received, lost_of = dict(observer.received), dict(observer.lost)
        out["hand_to_command_afterwards"] = latency.over(min(seconds, 5.0))
    out["sent"] = sum(map(sum, sent.values()))
    out["received"], out["lost"] = (sum(found.get(cell, 0) for cell in every) for found in (received, lost_of))
    return out


def main() -> int:
    """The exit code: 0."""
    p = argparse.ArgumentParser(prog="python -m sim.fleet", description="Many cells behind two routers.")
    p.add_argument("--cells", metavar="N", type=int, default=100, help="number of cells (default: %(default)s)")
    p.add_argument("--seconds", metavar="S", type=float, default=20.0, help="time of each measurement")
    p.add_argument("--route", nargs="+", help=argparse.SUPPRESS)
    p.add_argument("--publish", nargs="+", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.route:
        route(args.route[0], args.route[1:])
    elif args.publish:
        publish(args.publish[0], args.publish[1:])
    else:
        print(json.dumps(measured(args.cells, args.seconds), indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
