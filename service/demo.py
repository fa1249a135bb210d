"""The soldering scenario, closed loop: bench, service and scribe as separate processes, places taught over Zenoh as any client would."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from service.client import Client, open_session
from service.config import ExplainedError
from service.frame import TIMING
from service.recording import Recording
from service.wire import Add, decode_request

START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 60.0
BENCH_TIMEOUT_S = 120.0
EVENTS = {"handover": "board handed over", "grasp": "magnifying glass fetched", "carry": "glass held over the board"}


class DemoError(ExplainedError):
    """The demonstration could not be run; the message says what failed."""


def demo(out: Path, *, scene: Path | None, say: Any) -> dict[str, Any]:
    """Runs the scenario once and returns its report. Raises DemoError."""
    out.mkdir(parents=True, exist_ok=True)
    request = _output([sys.executable, "-m", "sim.scene", *([str(scene)] if scene else [])])
    add = decode_request(request.encode(), Add)
    with _service(out) as (service, endpoint):
        say(f"service at {endpoint}")
        with open_session(connect=[endpoint]) as session:
            client = Client(session)
            reply = client.add(add.points, tolerance=add.tolerance)
            names = ", ".join(f"{point['name']} (missed by {1000 * point['missed_by_m']:.1f} mm)" for point in reply["points"])
            say(f"taught while it runs, in force since tick {reply['tick']}: {names}")
            report = json.loads(_bench(endpoint, scene))
            status = client.status()
        service.send_signal(signal.SIGTERM)
        try:
            code = service.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise DemoError(f"the service did not end within {END_TIMEOUT_S:g} s of being asked to") from None
        if code != 0:
            raise DemoError(f"the service ended with code {code}; its log is {out / 'service.log'}")
    return _report(report, status)


def _report(report: dict[str, Any], status: dict[str, Any]) -> dict[str, Any]:
    recording, rrd = status["scribe"]["recording"], status["scribe"]["rrd"]
    if recording is None:
        raise DemoError(f"nothing was recorded: {'; '.join(status['scribe']['errors']) or 'the scribe gave no reason'}")
    steps = [step.timing for step in Recording.open(recording).steps() if step.timing is not None]
    timing = np.array(steps, TIMING)
    span_s = (timing["time_ns"][-1] - timing["time_ns"][0]) / 1e9
    return {
        "success": report["success"],
        "events": report["events"],
        "ticks": len(timing),
        "missed": int(timing["missed"][-1] - timing["missed"][0]),
        "rate_hz": round((len(timing) - 1) / span_s, 3),
        "latency_ms": report["latency_ms"],
        "lateness_us": _percentiles(timing["lateness_us"]),
        "work_us": _percentiles(timing["work_us"]),
        "realtime": status["realtime"],
        "recording": recording,
        "rrd": rrd,
    }


def _percentiles(values: Any) -> dict[str, float]:
    return dict(zip(("p50", "p99", "max"), np.percentile(values, (50, 99, 100)).round(1).tolist(), strict=True))


def text(report: dict[str, Any]) -> str:
    """The report for people to read."""
    lines = []
    for name, what in EVENTS.items():
        event = report["events"][name]
        lines.append(f"  {what:<26} {event['error_mm']:5.1f} mm  at {event['time_s']:4.1f} s   {'reached' if event['reached'] else 'MISSED'}")
    latency, late, work = report["latency_ms"], report["lateness_us"], report["work_us"]
    lines += [
        "",
        f"  loop     {report['rate_hz']:.2f} Hz, {report['ticks']} ticks, {report['missed']} missed"
        f"{'' if report['realtime'] else ' (real-time scheduling was not granted)'}",
        f"  latency  hand published to command received: p50 {latency['p50']:.2f}, p99 {latency['p99']:.2f}, max {latency['max']:.2f} ms",
        f"  late     p50 {late['p50']:.0f}, p99 {late['p99']:.0f}, max {late['max']:.0f} µs;  "
        f"work p50 {work['p50']:.0f}, p99 {work['p99']:.0f}, max {work['max']:.0f} µs",
        "",
        f"  thirdhand replay {_shown(report['recording'])}",
        f"  thirdhand view {_shown(report['rrd'])}",
        "",
        "The robot handed the board over, fetched the glass and held it over the board."
        if report["success"]
        else "The task failed: see the events marked MISSED.",
    ]
    return "\n".join(lines)


def _shown(path: str) -> str:
    with contextlib.suppress(ValueError):
        return str(Path(path).relative_to(Path.cwd()))
    return path


def _output(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=START_TIMEOUT_S, check=False)
    if done.returncode != 0:
        raise DemoError(done.stderr.strip() or f"{' '.join(command)} ended with code {done.returncode}")
    return done.stdout


def _bench(endpoint: str, scene: Path | None) -> str:
    """One run of the bench: its report as JSON. Its progress goes to standard error."""
    command = [sys.executable, "-m", "sim", "--connect", endpoint, "--once", "--json", "-", *(["--scene", str(scene)] if scene else [])]
    bench = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert bench.stderr is not None
        assert bench.stdout is not None
        for line in bench.stderr:
            if not line.startswith("pybullet build time"):
                print(f"  {line.rstrip()}", file=sys.stderr, flush=True)
        result = bench.stdout.read()
        if bench.wait(BENCH_TIMEOUT_S) != 0:
            raise DemoError(f"the bench ended with code {bench.returncode}")
    finally:
        bench.kill()
        bench.wait()
    return result


@contextlib.contextmanager
def _service(out: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A daemon of its own on a free port, with its files in `out`; ended with the context."""
    config = out / "cell.toml"
    config.write_text(
        "# The demo's cell: a free port, its own files.\n"
        '[network]\nlisten = ["tcp/127.0.0.1:0"]\n'
        f"[files]\nrecord = {json.dumps(str(out.absolute()))}\nstate = {json.dumps(str((out / 'state').absolute()))}\n"
    )
    log = out / "service.log"
    with log.open("w") as errors:
        command = [sys.executable, "-m", "service", "serve", "--config", str(config), "--arm", "state"]
        service = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            yield service, _endpoint(service, log)
        finally:
            if service.poll() is None:
                service.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    service.wait(10)
            service.kill()
            service.wait()


def _endpoint(service: subprocess.Popen[str], log: Path) -> str:
    """Where a daemon says that it listens."""
    assert service.stdout is not None
    until = time.monotonic() + START_TIMEOUT_S
    for line in service.stdout:
        if line.startswith("listening on "):
            return line.split()[2].rstrip(",")
        if time.monotonic() > until:
            break
    raise DemoError(f"the service did not start: {log.read_text().strip() or 'it gave no reason'}")
