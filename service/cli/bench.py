"""How the loop keeps its time on this machine: beside an empty loop of the same rate, which tells
what the machine allows, and with the core alone.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from service.cli.usage import SHIPPED_SKILL, recordings
from service.client import Client, open_session
from service.contract.explain import ExplainedError
from service.core.frame import TIMING
from service.launch import launched
from service.recorder.recording import Recording
from service.shell.probe import percentiles

PROGRAM = ("-m", "service")
PROBE = [sys.executable, "-m", "service.shell.probe"]
PARTS = 6  # of the time: the empty loop before and after, the core before and after, the whole for two
MISSED_MORE = 0.0005  # share of deadlines that the whole may miss more than the empty loop
NOTHING_US = 10.0  # of lateness, that ratios of medians be none of two nothings
SLOWER = 1.15  # than half a period, the way to the daemon and back, and the work


class BenchError(ExplainedError):
    """The measurement could not be made; the message says what failed."""


def bench(args: argparse.Namespace) -> int:
    """Exit code 0 once measured, whatever was found."""
    report = run(args.rate, args.seconds, say=lambda line: print(line, file=sys.stderr, flush=True))
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
        (args.output / "bench.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2) if args.json else text(report))
    return 0


def run(
    rate_hz: int, seconds: float, *, say: Callable[[str], None] = lambda line: None, program: tuple[str, ...] = PROGRAM
) -> dict[str, Any]:
    """Measures for about so many seconds: the empty loop, the core, the whole, the core, the empty
    loop. Raises BenchError and LaunchError.
    """
    part_s = seconds / PARTS
    skill = str(recordings() / SHIPPED_SKILL)
    kinds = {"empty": ("empty", str(rate_hz), str(part_s)), "core": ("core", skill, str(rate_hz), str(part_s))}
    found: dict[str, list[dict[str, Any]]] = {"empty": [], "core": []}
    whole: dict[str, Any] = {}
    for kind in ("empty", "core", "whole", "core", "empty"):
        if kind == "whole":
            say(f"whole: daemon with recorder and viewer, a tracker, {2 * part_s:g} s")
            whole = _whole(rate_hz, 2 * part_s, skill, program, say)
        else:
            say(f"{kind}: {part_s:g} s")
            found[kind].append(_probe(*kinds[kind]))
    report = {"rate_hz": rate_hz, "cores": len(os.sched_getaffinity(0)), "realtime": whole.pop("realtime")}
    report |= {kind: _joined(parts) for kind, parts in found.items()} | {"whole": whole}
    return report | {"ratios": _ratios(report)}


def _whole(
    rate_hz: int, seconds: float, skill: str, program: tuple[str, ...], say: Callable[[str], None]
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name, _echo() as echo_at:
        folder = Path(name)
        arguments = ("--arm", "assumed", "--rate", str(rate_hz))
        with launched(folder, *arguments, record=folder, program=program, say=say) as service:
            heard = _probe("tracker", skill, service.endpoint, echo_at, str(seconds))
            with open_session(connect=[service.endpoint]) as session:
                status = Client(session).status()
            cpu_s, memory_mb = _used(service.process.pid)
            if service.stop() != 0:
                raise BenchError(f"the service failed: {service.log.read_text()[-500:]}")
        timing = np.array([s.timing for s in Recording.open(status["scribe"]["recording"]).steps() if s.timing], TIMING)
        timing = timing[timing["tick"] > timing["tick"][-1] - round(seconds * rate_hz)]
    return heard | {
        "realtime": status["realtime"],
        "ticks": int(timing["tick"][-1] - timing["tick"][0]),
        "missed": int(timing["missed"][-1] - timing["missed"][0]),
        "lateness_us": percentiles(timing["lateness_us"]),
        "work_us": percentiles(timing["work_us"]),
        "memory_mb": memory_mb,
        "cpu_s": cpu_s,
    }


def _probe(*arguments: str) -> dict[str, Any]:
    done = subprocess.run([*PROBE, *arguments], capture_output=True, text=True, timeout=600, check=False)
    if done.returncode != 0:
        raise BenchError(f"{arguments[0]} could not be measured: {done.stderr.strip()[-500:]}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@contextlib.contextmanager
def _echo() -> Iterator[str]:
    """Where an echo listens."""
    process = subprocess.Popen([*PROBE, "echo"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.stdin.close()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


def _used(pid: int) -> tuple[float, float]:
    """Processor time [s] and memory [MB] of a process so far; zeros where nothing tells."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return round(used, 2), round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    return 0.0, 0.0


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The blocks of one kind as one: counts added, of each percentile the mean, of maxima the
    greatest.
    """
    out: dict[str, Any] = {name: sum(part[name] for part in parts) for name in ("ticks", "missed")}
    for name in ("lateness_us", "work_us"):
        means = {share: round(float(np.mean([part[name][share] for part in parts])), 2) for share in parts[0][name]}
        out[name] = means | {"max": max(part[name]["max"] for part in parts)}
    return out


def _ratios(report: dict[str, Any]) -> dict[str, float]:
    empty, whole = report["empty"], report["whole"]
    work_ms = whole["work_us"]["p50"] / 1e3
    least_ms = 500.0 / report["rate_hz"] + whole["round_trip_ms"]["p50"] + work_ms
    found = {
        "missed_more": whole["missed"] / max(1, whole["ticks"]) - empty["missed"] / max(1, empty["ticks"]),
        "lateness_p50": (whole["lateness_us"]["p50"] + NOTHING_US) / (empty["lateness_us"]["p50"] + NOTHING_US),
        "lateness_p99": whole["lateness_us"]["p99"] / max(1.0, empty["lateness_us"]["p99"]),
        "latency": whole["latency_ms"]["p50"] / least_ms,
        "work_to_fixed_work": whole["work_us"]["p50"] / empty["work_us"]["p50"],
        "core_to_fixed_work": report["core"]["work_us"]["p50"] / empty["work_us"]["p50"],
    }
    return {name: round(value, 4) for name, value in found.items()}


def text(report: dict[str, Any]) -> str:
    """The report for people to read."""
    names = ("p50", "p99", "p99.9", "max")
    rows = [f"{report['rate_hz']} Hz on {report['cores']} cores {'':>18}{''.join(f'{name:>9}' for name in names)}"]
    for kind, what in (("empty", "empty loop"), ("core", "core alone"), ("whole", "whole")):
        one = report[kind]
        share = 100 * one["missed"] / max(1, one["ticks"])
        rows.append(f"  {what:<11} {one['missed']} of {one['ticks']} deadlines missed ({share:.2f} %)")
        for name, unit in (("lateness_us", "late µs"), ("work_us", "work µs")):
            rows.append(f"    {unit:<34}" + "".join(f"{one[name][share]:9.1f}" for share in names))
    whole, ratios = report["whole"], report["ratios"]
    for name, what in (("latency_ms", "hand to command ms"), ("round_trip_ms", "there and back by Zenoh ms")):
        rows.append(f"    {what:<34}" + "".join(f"{whole[name][share]:9.2f}" for share in names))
    rows += [
        f"    daemon: {whole['memory_mb']:.0f} MB, {whole['cpu_s']:.1f} s of processor",
        "",
        f"  late, 99th percentile: {ratios['lateness_p99']:.2f} times the empty loop's; "
        f"missed {100 * ratios['missed_more']:+.2f} % of deadlines beside it",
        f"  hand to command: {ratios['latency']:.2f} times half a period, the way by Zenoh and the work",
        "",
        _verdict(report),
    ]
    return "\n".join(rows)


def _verdict(report: dict[str, Any]) -> str:
    if not report["realtime"]:
        return (
            "Real-time scheduling was not granted. To grant it: `ulimit -r 90` as root before the service starts, a "
            "line `<user> - rtprio 90` in /etc/security/limits.conf, or AmbientCapabilities=CAP_SYS_NICE in its unit."
        )
    if report["cores"] < 2:
        return "One core is too few: loop, recorder and viewer want two."
    if report["empty"]["missed"] > 0.001 * report["empty"]["ticks"]:
        return "This machine does not keep even an empty loop's time: look for what else runs on it."
    if report["ratios"]["missed_more"] > MISSED_MORE or report["ratios"]["latency"] > SLOWER:
        return "The machine would allow better: the service misses more deadlines, or answers later, than it could."
    return "The loop keeps its time here."
