"""Measurement of the loop's timing on this machine, compared with an empty loop of the same rate,
which shows the limits of the machine, and with the core alone.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from thirdhand.client import Client, open_session
from thirdhand.core.frame import STAGES, TIMING
from thirdhand.daemon.launch import launched
from thirdhand.process.progress import say
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.shipped import SHIPPED_SKILL, cell_of, recordings
from thirdhand.settings.config import RecordingSettings
from thirdhand.workbench.timing.probe import EDGES_US, figures, percentiles
from thirdhand.workbench.timing.probe_processes import ProbeError, echo, family, probe

PROGRAM = ("-m", "thirdhand")
# the duration is divided into two parts for each of the empty loop, the core and the whole
DURATION_PARTS = 6
MISSED_MORE = 0.0005  # the whole may miss this share of deadlines more than the empty loop
KERNEL = (
    (
        "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
        "performance",
        "`performance` holds the clock rate",
    ),
    (
        "/proc/sys/kernel/sched_rt_runtime_us",
        "-1",
        "-1 does not limit the time of a real-time loop",
    ),
    ("/sys/kernel/realtime", "1", "a kernel with PREEMPT_RT would bound the lateness"),
)
PERCENTILE_NAMES = ("p50", "p99", "p99.9", "max")
LOOP_KINDS = (("empty", "empty loop"), ("core", "core alone"), ("whole", "whole"))
# added to both medians of lateness, because the ratio of two small numbers means nothing
NOTHING_US = 10.0
SLOWER = 1.15  # accepted latency / (half a period + round trip + work)


def bench(args: argparse.Namespace) -> int:
    """Measure, print the report, and return exit code 0 for any result."""
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
    settings = cell_of(args.arm, rate_hz=args.rate)
    report = run(settings.rate_hz, args.seconds, arm=args.arm, keep=args.output)
    if args.output is not None:
        (args.output / "bench.json").write_text(json.dumps(report, indent=2) + "\n")
        draw(report, args.output / "bench.png")
    print(json.dumps(report, indent=2) if args.json else text(report))
    return 0


def run(
    rate_hz: int,
    seconds: float,
    *,
    arm: str = "wam",
    program: tuple[str, ...] = PROGRAM,
    keep: Path | None = None,
) -> dict[str, Any]:
    """Measure for about `seconds` [s]: empty loop, core, whole, core, empty loop.

    The recording of the whole remains in the folder `keep`. Raises ProbeError and LaunchError.
    """
    part_s = seconds / DURATION_PARTS
    skill = str(recordings() / SHIPPED_SKILL)
    kinds = {"empty": (rate_hz, part_s), "core": (skill, rate_hz, part_s, arm)}
    results: dict[str, list[dict[str, Any]]] = {"empty": [], "core": []}
    whole: dict[str, Any] = {}
    for kind in ("empty", "core", "whole", "core", "empty"):
        if kind == "whole":
            say(f"whole: daemon with recorder and viewer, a tracker, {2 * part_s:g} s")
            whole = _whole(rate_hz, 2 * part_s, skill, arm, program, keep)
        else:
            say(f"{kind}: {part_s:g} s")
            results[kind].append(probe(kind, *kinds[kind]))
    report = {
        "rate_hz": rate_hz,
        "cores": len(os.sched_getaffinity(0)),
        "granted": whole.pop("granted"),
    }
    report |= {kind: _joined(parts) for kind, parts in results.items()} | {"whole": whole}
    return report | {"ratios": _ratios(report)}


def _whole(
    rate_hz: int,
    seconds: float,
    skill: str,
    arm: str,
    program: tuple[str, ...],
    keep: Path | None,
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name, echo() as echo_at:
        folder = keep or Path(name)
        arguments = ("--joints", "assumed", "--rate", str(rate_hz))
        before = set(folder.glob("*.mcap"))
        # the timing of each tick is recorded with its frame
        settings = msgspec.structs.replace(cell_of(arm), recording=RecordingSettings(frames_hz=0))
        cell: dict[str, Any] = {"settings": settings, "record": folder, "program": program}
        with launched(Path(name), *arguments, **cell, say=say) as service:
            heard = probe("tracker", skill, service.endpoint, echo_at, seconds)
            with open_session(connect=[service.endpoint]) as session:
                status = Client(session).status()
            processes = {
                process_name: {
                    "cpu_s": round(sum(process.cpu_times()[:2]), 2),
                    "memory_mb": round(process.memory_info().rss / 1e6, 1),
                }
                for process_name, process in family(service.process.pid).items()
            }
            if service.stop() != 0:
                raise ProbeError(f"the service failed: {service.log.read_text()[-500:]}")
        recorded = sorted(set(folder.glob("*.mcap")) - before)
        steps = itertools.chain.from_iterable(Recording.open(path).steps() for path in recorded)
        timing = np.array([step.timing for step in steps if step.timing], TIMING)
        timing = timing[timing["tick"] > timing["tick"][-1] - round(seconds * rate_hz)]
        began = service.log.read_text().partition("started in ")[2].partition("\n")[0]
    return heard | {
        "start": began,
        "granted": {"realtime": status.realtime, "memory_locked": status.memory_locked},
        "ticks": int(timing["tick"][-1] - timing["tick"][0]),
        "missed": int(timing["missed"][-1] - timing["missed"][0]),
        **figures(timing["lateness_us"], timing["work_us"]),
        "stages_us": {
            name: percentiles(timing["stages_us"][:, i]) for i, name in enumerate(STAGES)
        },
        "processes": processes,
    }


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The merged parts of one kind: sums of counts, means of percentiles, the maximum of maxima."""
    out: dict[str, Any] = {name: sum(part[name] for part in parts) for name in ("ticks", "missed")}
    for name in ("lateness_us", "work_us"):
        means = {
            share: round(float(np.mean([part[name][share] for part in parts])), 2)
            for share in parts[0][name]
        }
        out[name] = means | {"max": max(part[name]["max"] for part in parts)}
    for name in ("lateness_counts", "work_counts"):
        out[name] = np.sum([part[name] for part in parts], axis=0).tolist()
    return out


def _ratios(report: dict[str, Any]) -> dict[str, float]:
    empty = report["empty"]
    whole = report["whole"]
    work_ms = whole["work_us"]["p50"] / 1e3
    least_ms = 500.0 / report["rate_hz"] + whole["round_trip_ms"]["p50"] + work_ms
    ratios = {
        "missed_more": whole["missed"] / max(1, whole["ticks"])
        - empty["missed"] / max(1, empty["ticks"]),
        "lateness_p50": (whole["lateness_us"]["p50"] + NOTHING_US)
        / (empty["lateness_us"]["p50"] + NOTHING_US),
        "lateness_p99": whole["lateness_us"]["p99"] / max(1.0, empty["lateness_us"]["p99"]),
        "lateness_p99.9": whole["lateness_us"]["p99.9"] / max(1.0, empty["lateness_us"]["p99.9"]),
        "latency": whole["latency_ms"]["p50"] / least_ms,
        "work_to_fixed_work": whole["work_us"]["p50"] / empty["work_us"]["p50"],
        "core_to_fixed_work": report["core"]["work_us"]["p50"] / empty["work_us"]["p50"],
    }
    return {name: round(value, 4) for name, value in ratios.items()}


def _row(label: str, values: Mapping[str, float], digits: int) -> str:
    """A row of percentiles, below their names."""
    return f"    {label:<34}" + "".join(
        f"{values[share]:9.{digits}f}" for share in PERCENTILE_NAMES
    )


def text(report: dict[str, Any]) -> str:
    """The report for people to read."""
    rows = [
        f"{report['rate_hz']} Hz on {report['cores']} cores "
        f"{'':>18}{''.join(f'{name:>9}' for name in PERCENTILE_NAMES)}"
    ]
    for kind, label in LOOP_KINDS:
        loop = report[kind]
        share = 100 * loop["missed"] / max(1, loop["ticks"])
        rows.append(
            f"  {label:<11} {loop['missed']} of {loop['ticks']} deadlines missed ({share:.2f} %)"
        )
        for name, unit in (("lateness_us", "late µs"), ("work_us", "work µs")):
            rows.append(_row(unit, loop[name], 1))
    whole = report["whole"]
    ratios = report["ratios"]
    for name, label in (
        ("latency_ms", "hand to command ms"),
        ("round_trip_ms", "there and back by Zenoh ms"),
    ):
        rows.append(_row(label, whole[name], 2))
    rows += [_row(f"stage {name} µs", stage, 1) for name, stage in whole["stages_us"].items()]
    rows += [
        f"    {process:<12}{usage['memory_mb']:6.0f} MB, {usage['cpu_s']:5.1f} s of processor"
        for process, usage in whole["processes"].items()
    ]
    granted = report["granted"]
    rows += [
        f"    {'real-time scheduling' if granted['realtime'] else 'ordinary scheduling'}, memory "
        f"{'locked' if granted['memory_locked'] else 'not locked'}",
        *([f"    started in {whole['start']}"] if whole.get("start") else []),
        "",
        f"  late, 99th and 99.9th percentile: {ratios['lateness_p99']:.2f} and "
        f"{ratios['lateness_p99.9']:.2f} times the empty loop's;",
        f"  missed deadlines: {100 * ratios['missed_more']:+.2f} % compared with the empty loop",
        f"  hand to command: {ratios['latency']:.2f} times the sum of half a period, the round "
        "trip and the work",
        "",
        _verdict(report),
    ]
    return "\n".join(rows)


def draw(report: dict[str, Any], path: Path) -> None:
    """Draw histograms of lateness and work of the empty loop, the core and the whole as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2, sharey=True), ("lateness", "work"), strict=True):
        for (kind, label), colour in zip(
            LOOP_KINDS, ("#999999", "#0072b2", "#d55e00"), strict=True
        ):
            counts = np.array(report[kind][f"{name}_counts"])
            axes.stairs(
                counts / max(1, counts.sum()), EDGES_US, label=label, color=colour, linewidth=1.4
            )
        axes.axvline(1e6 / report["rate_hz"], color="black", linestyle=":", linewidth=1)
        axes.set(
            xscale="log", yscale="log", xlabel=f"{name} [µs], dotted: the period", xlim=(1, 2e4)
        )
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("share of ticks")
    figure.axes[0].legend()
    figure.suptitle(f"A loop at {report['rate_hz']} Hz on {report['cores']} cores")
    figure.savefig(path, dpi=120)


def _verdict(report: dict[str, Any]) -> str:
    advice = "; ".join(_kernel())
    if not report["granted"]["realtime"]:
        return (
            "Real-time scheduling was not granted. To grant it: `ulimit -r 90` as root before the "
            "service starts, a line `<user> - rtprio 90` in /etc/security/limits.conf, or "
            "AmbientCapabilities=CAP_SYS_NICE in its unit."
        )
    if report["cores"] < 2:
        return "One core is too few: loop, recorder and viewer need two."
    if report["empty"]["missed"] > 0.001 * report["empty"]["ticks"]:
        return f"Even an empty loop misses deadlines on this machine: stop other programs. {advice}"
    if report["ratios"]["missed_more"] > MISSED_MORE or report["ratios"]["latency"] > SLOWER:
        return (
            "The loop misses more deadlines, or answers later, than this machine would allow. "
            f"{advice}"
        )
    return "The loop meets its deadlines on this machine."


def _kernel() -> list[str]:
    """Messages on kernel settings that disturb a loop's timing."""
    messages = []
    for path, good, advice in KERNEL:
        try:
            value = Path(path).read_text().strip()
        except OSError:
            continue
        if value != good:
            messages.append(f"{path} is {value}, {advice}")
    return messages or ["No readable setting of the kernel disturbs the loop"]
