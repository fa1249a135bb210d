"""Measurement of a cell's traffic on a network, and an estimate for a router of many cells.

python -m sim.traffic [--seconds S] [--cells N]

A service, the bench and an observer of all streams, each connected to one router through a relay
that counts bytes.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import psutil
import zenoh

from service.client import Client, open_session
from service.contract.explain import ExplainedError, in_words
from service.daemon.launch import launched
from sim.parts import CELL, CellPart, PartError
from sim.sockets import CountingRelay

READY_S = 60.0  # the service must follow the bench within this time
TRAFFIC_SETTLE_S = 2.0
OURS = {"service": "daemon", "bench": "arm and tracker", "observer": "observer of every stream"}


class Traffic(NamedTuple):
    """Rates [messages/s, bytes/s] by key, bytes per second that each of OURS sent to and received
    from the router, and the share of a core that the router used.
    """

    messages: dict[str, float]
    payload: dict[str, float]
    sent: dict[str, float]
    received: dict[str, float]
    router_cores: float


def measured(seconds: float) -> Traffic:
    """Measure one cell's traffic over a time [s]. Raises ExplainedError, PartError."""
    with contextlib.ExitStack() as closing:
        folder = Path(closing.enter_context(tempfile.TemporaryDirectory()))
        router = closing.enter_context(contextlib.closing(CellPart("router", "0")))
        relays = {who: closing.enter_context(CountingRelay(router.endpoint)) for who in OURS}
        network = f'[network]\nlisten = []\nconnect = ["{relays["service"].endpoint}"]\n'
        closing.enter_context(launched(folder, network=network))
        bench = subprocess.Popen(
            [sys.executable, "-m", "sim", "--connect", relays["bench"].endpoint],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        closing.callback(bench.wait)
        closing.callback(bench.kill)
        session = closing.enter_context(open_session(connect=[relays["observer"].endpoint]))
        client = Client(session, CELL)
        _until_following(client)
        time.sleep(TRAFFIC_SETTLE_S)
        messages, payload, lock = Counter[str](), Counter[str](), threading.Lock()

        def count(sample: zenoh.Sample) -> None:
            with lock:
                messages[str(sample.key_expr)] += 1
                payload[str(sample.key_expr)] += len(sample.payload)

        heard = session.declare_subscriber(f"{CELL}/**", count)
        closing.callback(heard.undeclare)
        process = psutil.Process(router.process.pid)
        before = {who: relay.counted() for who, relay in relays.items()}
        cpu, began = sum(process.cpu_times()[:2]), time.monotonic()
        time.sleep(seconds)
        lasted = time.monotonic() - began
        rates = {
            who: [(a - b) / lasted for a, b in zip(relay.counted(), before[who], strict=True)]
            for who, relay in relays.items()
        }
        if (now := client.status()).mode == "fault":
            raise ExplainedError(f"the service is in fault ({now.reason}): try again on a machine with less load")
        with lock:
            return Traffic(
                {key: count / lasted for key, count in sorted(messages.items())},
                {key: size / lasted for key, size in sorted(payload.items())},
                {who: rate[0] for who, rate in rates.items()},
                {who: rate[1] for who, rate in rates.items()},
                (sum(process.cpu_times()[:2]) - cpu) / lasted,
            )


def _until_following(client: Client) -> None:
    end = time.monotonic() + READY_S
    while (now := client.status()).mode != "follow":
        if time.monotonic() > end:
            raise ExplainedError(f"the service does not follow the bench: {now.mode} ({now.reason})")
        time.sleep(0.1)


def text(one: Traffic, cells: int) -> str:
    """The measurement as a table in text, and an estimate for many cells."""
    lines = [f"{'':<28}{'messages/s':>12}{'payload kB/s':>14}"]
    for key in one.messages:
        lines.append(f"  {key:<26}{one.messages[key]:12.1f}{one.payload[key] / 1e3:14.1f}")
    lines.append(f"  {'all':<26}{sum(one.messages.values()):12.1f}{sum(one.payload.values()) / 1e3:14.1f}")
    lines += ["", f"{'on the wire [Mbit/s]':<28}{'to router':>12}{'from router':>14}"]
    for who, about in OURS.items():
        lines.append(f"  {about:<26}{_mbit(one.sent[who]):12.2f}{_mbit(one.received[who]):14.2f}")
    status = one.payload.get(f"{CELL}/status", 0.0)
    passed = sum((one.sent[who] + one.received[who]) for who in ("service", "bench"))
    lines += [
        f"  router: {100 * one.router_cores:.0f} % of a core",
        "",
        f"estimate for {cells} such cells on one router:",
        f"  {_mbit(cells * passed):.0f} Mbit/s through it, {2 * cells} sessions, "
        f"at most {cells * one.router_cores:.1f} cores (this router passes each stream to an observer too)",
        f"  one more observer of every status: {_mbit(cells * status):.1f} Mbit/s; of every stream: "
        f"{_mbit(cells * one.received['observer']):.0f} Mbit/s",
    ]
    return "\n".join(lines)


def _mbit(bytes_per_s: float) -> float:
    return 8e-6 * bytes_per_s


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; exit code 0, 1 on failure, 2 on bad usage."""
    p = argparse.ArgumentParser(prog="python -m sim.traffic", description=__doc__)
    p.formatter_class = argparse.RawDescriptionHelpFormatter
    p.add_argument(
        "--seconds", metavar="S", type=float, default=8.0, help="measure for this time (default: %(default)g)"
    )
    p.add_argument("--cells", metavar="N", type=int, default=100, help="estimate for this many (default: %(default)s)")
    args = p.parse_args(arguments)
    try:
        print(text(measured(args.seconds), args.cells))
    except (ExplainedError, PartError, OSError) as error:
        print(f"python -m sim.traffic: {in_words(error)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
