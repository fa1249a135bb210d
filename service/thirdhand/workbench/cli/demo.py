"""The soldering scenario in closed loop: bench, service and scribe as separate processes, with
via-points taught over Zenoh.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Set
from pathlib import Path
from typing import Any

import zenoh

from thirdhand.client import Client, Tracker, UnreachableError, no_room_to_brake, open_session
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.contract.requests import Add, Reply, Status, decode_request
from thirdhand.daemon.launch import engine_of, launched, played
from thirdhand.daemon.machine import LATE_LOOP_MS, MISSED_SHARE
from thirdhand.process.child import python
from thirdhand.process.progress import progress, say
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.workbench.cli.hands import invite
from thirdhand.workbench.cli.web_address import live_url, page_served, web_address
from thirdhand.workbench.trackers.address import Address
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.mouse_page import MousePage, PlayedTask

DEMO_CELL = "thirdhand"  # name of the demo's cell
SCENE_TIMEOUT_S = 60.0
DEMO_ATTEMPTS = 3  # a task that fails while the machine is too busy is tried again
TOO_BUSY = "too-busy"  # folder in --output for the recordings of such attempts
# at 500 Hz, a browser without a GPU, or a compiler, leaves too little of two cores for the arm
SLOW_RATE_HZ = 100
PLAY_S = 180.0  # a person has this time for the task, after both hands are seen
PAGE_WAIT_S = 600.0  # the page is opened within this time
PLAY_TIMEOUT_S = PAGE_WAIT_S + PLAY_S + 120.0  # the bench ends within this time
OUTCOME_S = 1.0  # the page shows the outcome before its server ends
NEVER_THERE = "the hands were never at its places"
# a line of the bench
REACHED_LINE = re.compile(r"\s*(handover|grasp|carry): ([\d.]+ mm) at [\d.]+ s")
CAUSE_AFTER_S = 1.0  # the cause of a missed event is searched until 1 s after the closest approach
VIA_POINT_OF_EVENT = {"handover": "handover", "grasp": "glass", "carry": "soldering"}
EVENT_TITLES = {
    "handover": "board handed over",
    "grasp": "magnifying glass fetched",
    "carry": "glass held over the board",
}


class DemoError(ExplainedError):
    """The demo could not be run; the message has the cause."""


def demo(args: argparse.Namespace) -> int:
    """Run the demo, print its report and return its exit code."""
    page = web_address("--mouse", args.mouse) if args.mouse is not None else None
    busy_rate_hz = _busy_rate_hz(args)
    rate_hz = busy_rate_hz if page or args.open else args.rate
    for left in reversed(range(DEMO_ATTEMPTS)):
        before = set(args.output.glob("*.mcap"))
        is_last = page is not None or not left
        try:
            report = run(args, rate_hz, page)
        except UnreachableError as error:
            if is_last:
                raise
            reason = in_words(error)
        else:
            reason = _too_busy_for(report)
            if is_last or not reason:
                break
        rate_hz = busy_rate_hz
        say(f"{reason}: it is tried again" + f" at {rate_hz} Hz" * (rate_hz is not None))
        _set_aside(args.output, before)
    report["rrd"] = _drawn(Path(report["recording"]))
    print(json.dumps(report, indent=2) if args.json else text(report))
    return exit_code(report)


def _busy_rate_hz(args: argparse.Namespace) -> int | None:
    """The rate on a machine that is too busy; None for that of the cell."""
    rate_hz: int | None = args.rate
    return SLOW_RATE_HZ if rate_hz is None and args.arm in ARMS else rate_hz


def _set_aside(folder: Path, before: Set[Path]) -> None:
    """Move the new recordings into a folder of their own."""
    aside = folder / TOO_BUSY
    aside.mkdir(exist_ok=True)
    for recording in set(folder.glob("*.mcap")) - before:
        shutil.move(recording, aside)


def _too_busy_for(report: dict[str, Any]) -> str:
    """The reason why a task that failed is tried again; empty if the machine is not the cause."""
    is_valid = report["success"] or report["missing"] or not report["busy"]
    return "" if is_valid else f"the task failed on a machine that was too busy, {report['busy']}"


def _drawn(recording: Path) -> str | None:
    """The path of the drawing of a recording, beside it; None if it cannot be drawn."""
    from thirdhand.workbench.cli.view import convert  # its import is slow

    rrd = recording.with_suffix(".rrd")
    try:
        with progress(f"drawing {recording.name}") as done:
            convert(recording, rrd, say=say, progress=done)
    except (ExplainedError, OSError) as error:
        say(f"there is no drawing: {in_words(error)}")
        return None
    return str(rrd)


def exit_code(report: dict[str, Any]) -> int:
    """Exit code 0 only if the task succeeded and the recording is complete."""
    return 0 if report["success"] and not report["missing"] else 1


def run(args: argparse.Namespace, rate_hz: int | None, page: Address | None) -> dict[str, Any]:
    """Run the scenario once and return its report. With the address of a `page`, a person plays the
    hands there. Raises DemoError, SettingsError.
    """
    out = args.output
    engine = engine_of(args.engine)
    settings = cell_of(args.arm, rate_hz=rate_hz)
    scene = [str(args.scene)] if args.scene else []
    if reason := no_room_to_brake(settings.period_s):
        raise DemoError(reason)
    say("starting: the scene, then the service")
    out.mkdir(parents=True, exist_ok=True)
    request = _output("thirdhand_sim.scene", "--arm", args.arm, *scene)
    add = decode_request(request.encode(), Add)
    live = ("--live", "0") if args.open and not page else ()
    with launched(
        out, "--joints", "state", *live, settings=settings, record=out, say=say
    ) as service:
        say(f"service at {service.endpoint}")
        with open_session(connect=[service.endpoint]) as session:
            client = Client(session)
            reply = client.add(add.points, tolerance=add.tolerance)
            say(f"taught while it runs, in force since tick {reply.tick}: {_missed_by(reply)}")
            bench = [
                "--engine",
                engine,
                "--arm",
                str(service.config),
                *(["--scene", *scene] if scene else []),
            ]
            # The service ends before the bench: an arm that disappears is a fault.
            ends: list[tuple[Status, int]] = []
            play = functools.partial(
                played,
                service.endpoint,
                *bench,
                reported=lambda: ends.append((client.status(), service.stop())),
            )
            report = _play(session, client, play, page, browser=args.open)
        ((status, code),) = ends
        missing = service.missing()
        if code != 0 and not missing:
            raise DemoError(f"the service ended with code {code}; its log is {service.log}")
    return _report(report, status) | {"missing": missing}


def _missed_by(reply: Reply) -> str:
    """The via-points in a reply, each with the distance by which the skill misses it."""
    return ", ".join(
        f"{point.name} (missed by {1000 * point.missed_by_m:.1f} mm)"
        for point in reply.points or ()
    )


def _play(
    session: zenoh.Session,
    client: Client,
    play: Callable[..., str],
    page: Address | None,
    *,
    browser: bool,
) -> dict[str, Any]:
    """The report of the bench, which `play` runs: with a person's hands on a page, if there is an
    address for it, or else with the live view in a browser.
    """
    if page:
        return _played_on_page(session, client, play, page, browser=browser)
    with _live_view(session, client) if browser else contextlib.nullcontext():
        report: dict[str, Any] = json.loads(play(say=say))
    return report


@contextlib.contextmanager
def _live_view(session: zenoh.Session, client: Client) -> Iterator[None]:
    """Show the live view in this machine's browser while the context lasts. Raises UsageError,
    ViewerError.
    """
    from thirdhand.workbench.cli.live_page import live_page  # its import is slow

    stream = live_url(lambda: client.status().scribe)
    with (
        live_page(session, client, DEMO_CELL, stream) as page,
        page_served(page.server, "--open", Address("127.0.0.1", 0)) as address,
    ):
        url = f"http://{address}/"
        say(f"  {url}")
        invite(url, address, browser=True, to_do="watch the arm")
        yield


def _played_on_page(
    session: zenoh.Session,
    client: Client,
    play: Callable[..., str],
    listen: Address,
    *,
    browser: bool,
) -> dict[str, Any]:
    """The report of the bench, which `play` runs and whose hands a person plays on a page. Raises
    LaunchError, UsageError.
    """
    running: list[subprocess.Popen[str]] = []

    def end() -> None:
        for process in running:
            process.terminate()

    task = PlayedTask(end)

    def heard(line: str) -> None:
        say(line)
        if match := REACHED_LINE.fullmatch(line):
            task.lines.append(f"{EVENT_TITLES[match[1]]}, the tool was {match[2]} off")

    with Tracker(session) as tracker:
        page = MousePage(tracker, client, Latest(session, DEMO_CELL), cell=DEMO_CELL, task=task)
        with page_served(page.server, "--mouse", listen) as address:
            url = f"http://{address}/?token={page.server.token}"
            say(f"  {url}")
            invite(url, address, browser=browser)
            report: dict[str, Any] = json.loads(
                play(
                    "--tracked-hands",
                    str(PLAY_S),
                    "--wait",
                    str(PAGE_WAIT_S),
                    say=heard,
                    begun=running.append,
                    timeout_s=PLAY_TIMEOUT_S,
                )
                or "null"
            )
            if report is None:
                raise DemoError("the task was ended before both hands were seen on the page")
            reached = sum(event["reached"] for event in report["events"].values())
            task.is_done = report["success"]
            task.outcome = f"the task has ended: {reached} of {len(EVENT_TITLES)} events reached"
            time.sleep(OUTCOME_S)
    return report


def _report(report: dict[str, Any], status: Status) -> dict[str, Any]:
    # its import is slow: the first messages must come before
    from thirdhand.workbench.report.report import reported

    recording = status.scribe["recording"]
    if recording is None:
        raise DemoError(
            "nothing was recorded: "
            f"{'; '.join(status.scribe['errors']) or 'the scribe gave no reason'}"
        )
    recorded_report = reported(recording)
    timing = recorded_report.columns.timing
    bench = too_busy(report)
    begun_s = (report["begun_ns"] - recorded_report.columns.start_ns) / 1e9
    for name, event in report["events"].items():
        if event["error_mm"] is None:
            event["why"] = NEVER_THERE
        elif not event["reached"]:
            event["why"] = _why(recorded_report, begun_s, report["events"], name)
    return {
        "success": report["success"],
        "events": report["events"],
        "ticks": len(recorded_report.columns.frames),
        "missed": recorded_report.missed,
        "rate_hz": round(recorded_report.rate_hz, 3),
        "latency_ms": report["latency_ms"],
        "lateness_us": _percentiles(timing["lateness_us"]),
        "work_us": _percentiles(timing["work_us"]),
        "realtime": status.realtime,
        "busy": ", ".join(filter(None, (bench, status.busy))),
        "recording": recording,
    }


def too_busy(report: dict[str, Any]) -> str:
    """A message on a machine that was too busy for the bench; empty if it was not."""
    periods, skipped, pause_ms = (
        report[name] for name in ("periods", "skipped", "longest_pause_ms")
    )
    messages = []
    if skipped > MISSED_SHARE * periods:
        messages.append(f"the bench missed {skipped} of its {periods} periods")
    if pause_ms > LATE_LOOP_MS:
        messages.append(f"the bench paused for {pause_ms:.0f} ms")
    return ", ".join(messages)


def _why(found: Any, begun_s: float, events: dict[str, Any], name: str) -> str:
    """The cause of a missed event, from the recording after the event before it."""
    from thirdhand.workbench.report.report import why_missed

    names = list(events)
    before = [events[event]["time_s"] for event in names[: names.index(name)]]
    until_s = events[name]["time_s"] + CAUSE_AFTER_S
    return why_missed(
        found,
        VIA_POINT_OF_EVENT[name],
        begun_s=begun_s,
        start_s=max(before, default=0.0),
        end_s=until_s,
    )


def _percentiles(values: Any) -> dict[str, float]:
    import numpy as np

    return dict(
        zip(
            ("p50", "p99", "max"),
            np.percentile(values, (50, 99, 100)).round(1).tolist(),
            strict=True,
        )
    )


def text(report: dict[str, Any]) -> str:
    """The report in text, with each cause of a failure once."""
    lines, causes = _events(report["events"])
    busy = ", ".join(part for part in report["busy"].split(", ") if part not in " ".join(causes))
    latency = report["latency_ms"]
    late = report["lateness_us"]
    work = report["work_us"]
    lines += [
        "",
        f"  loop     {report['rate_hz']:.2f} Hz, {report['ticks']} ticks, {report['missed']} missed"
        f"{'' if report['realtime'] else ' (real-time scheduling was not granted)'}",
        f"  latency  hand published to command received: p50 {latency['p50']:.2f}, "
        f"p99 {latency['p99']:.2f}, max {latency['max']:.2f} ms",
        f"  late     p50 {late['p50']:.0f}, p99 {late['p99']:.0f}, max {late['max']:.0f} µs;  "
        f"work p50 {work['p50']:.0f}, p99 {work['p99']:.0f}, max {work['max']:.0f} µs",
        *([f"  machine  too busy: {busy}"] if busy else []),
        "",
        f"  thirdhand replay {_shown(report['recording'])}",
        f"  thirdhand view {_shown(report['rrd'] or report['recording'])}",
        f"  thirdhand report {_shown(report['recording'])}",
        *([f"  The recording is not complete: {report['missing']}."] if report["missing"] else []),
        "",
        "The robot handed the board over, fetched the glass and held it over the board."
        if report["success"]
        else "The task failed: see the events marked MISSED.",
    ]
    return "\n".join(lines)


def _events(events: dict[str, Any]) -> tuple[list[str], list[str]]:
    """The events in text, and the causes of those that were missed."""
    lines = list[str]()
    causes = list[str]()
    for name, title in EVENT_TITLES.items():
        event = events[name]
        if event["error_mm"] is None:
            lines.append(f"  {title:<26} {'MISSED':>27}")
            lines.append(f"      because {event['why']}")
            continue
        outcome = "reached" if event["reached"] else "MISSED"
        lines.append(
            f"  {title:<26} {event['error_mm']:5.1f} mm  at {event['time_s']:4.1f} s   {outcome}"
        )
        if why := event.get("why"):
            lines.append("      for the same reason" if why in causes else f"      because {why}")
            causes.append(why)
    return lines, causes


def _shown(path: str) -> str:
    with contextlib.suppress(ValueError):
        return str(Path(path).relative_to(Path.cwd()))
    return path


def _output(module: str, *arguments: str) -> str:
    command = python("-m", module, *arguments)
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=SCENE_TIMEOUT_S, check=False
    )
    if done.returncode != 0:
        raise DemoError(
            done.stderr.strip() or f"{' '.join(command)} ended with code {done.returncode}"
        )
    for line in done.stderr.splitlines():
        say(line)
    return done.stdout
