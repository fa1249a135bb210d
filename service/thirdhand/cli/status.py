"""`thirdhand status`: the status of a running daemon, once or live."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Generator, Iterator, Mapping
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import RingChannel

from thirdhand.cli.clients import ask
from thirdhand.cli.usage import reached
from thirdhand.client import Client, UnreachableError, decoded, why_silent
from thirdhand.contract import channels
from thirdhand.contract.evidence import lasting
from thirdhand.contract.incidents import (
    SOURCE_NAMES,
    in_brief,
    input_name,
    what_happened,
    what_to_do,
    word,
)
from thirdhand.contract.records import SIDES, Flag
from thirdhand.contract.requests import Percentiles, Source, Status
from thirdhand.process import interrupt

POLL_S = 0.02
LINE_S = 0.5  # interval of the lines of --watch
SILENT_S = 2.0  # a daemon without a status for this time does not answer
# a sample's stamp beyond these shows that clocks differ
SHOWN_LATE_MS = 1000.0
AHEAD_MS = -5.0
NOTHING_DECIDED = "starting: nothing has been decided yet"
MODE_STYLES = {"follow": "green", "hold": "yellow", "fault": "bold red"}
STUCK_WORD = word(Flag.STUCK)  # its explanation is already in `because`


def status(args: argparse.Namespace) -> int:
    """Print the status; exit code 0 if a daemon answers, 1 at a fault with --exit-code, and when
    --watch ends.
    """
    if args.watch:
        return _watch(args)
    now = msgspec.convert(ask(args, "status"), Status)
    code = int(args.exit_code and now.mode == "fault")
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(now)).decode())
        return code
    texts = rows(now)
    width = max(map(len, texts))
    for name, text in texts.items():
        print(f"{name:<{width}}  {text}")
    return code


def _watch(args: argparse.Namespace) -> int:
    with reached(args) as session:
        arriving = statuses(session, args.cell)
        if args.json:
            for now in arriving:
                print(msgspec.json.encode(now).decode(), flush=True)
        elif sys.stdout.isatty():
            _draw(arriving)
        else:
            last_s = 0.0
            outcome = ("", "")
            for now in arriving:
                if time.monotonic() - last_s >= LINE_S or (now.mode, now.reason) != outcome:
                    last_s = time.monotonic()
                    outcome = (now.mode, now.reason)
                    print(line(now), flush=True)
    return 1


def statuses(session: zenoh.Session, cell: str) -> Generator[Status, None, None]:
    """The status now, and each one that arrives. Raises UnreachableError when no more arrive."""
    key = channels.key(cell, "status")
    yield Client(session, cell).status()
    with session.declare_subscriber(key, RingChannel(1)) as subscriber:
        arrived_s = time.monotonic()
        while time.monotonic() - arrived_s < SILENT_S:
            if (sample := subscriber.try_recv()) is None:
                time.sleep(POLL_S)
                continue
            arrived_s = time.monotonic()
            yield decoded(sample.payload.to_bytes(), Status)
    raise UnreachableError(f"nothing arrives on {key}: {why_silent(session, cell)}")


def _draw(arriving: Iterator[Status]) -> None:
    """Draw each status over the previous one."""
    from rich.live import Live  # imported here because most calls draw nothing
    from rich.table import Table
    from rich.text import Text

    with interrupt.clean_up_first(), Live(refresh_per_second=10) as live:  # it hides the cursor
        for now in arriving:
            table = Table.grid(padding=(0, 2))
            for name, text in rows(now).items():
                table.add_row(
                    Text(name, style="dim"),
                    Text(text, style=MODE_STYLES[now.mode] if name == "mode" else ""),
                )
            live.update(table)


def line(now: Status) -> str:
    """A status in one line."""
    parts = [
        f"tick {now.tick}",
        in_brief(now.mode, now.reason) + "".join(f" +{flag}" for flag in now.flags),
    ]
    if now.tick < 0:
        return NOTHING_DECIDED
    parts += [f"{side} {_where(now, side)}" for side in SIDES]
    parts.append(f"tool {_at(now.tool_m)}")
    if now.target_m is not None:
        parts.append(f"target {_uncertain(now)}")
    parts.append(_nearest(now))
    return " | ".join(parts)


def rows(now: Status) -> dict[str, str]:
    """A status as names and texts."""
    if now.tick < 0:
        return {
            "mode": NOTHING_DECIDED,
            "skill": now.skill,
            "listening": ", ".join(now.endpoints) or "no endpoint; it connects to others",
        }
    texts = {
        **_outcome(now),
        "skill": f"{now.skill}; via-points: {', '.join(now.via_points) or 'none'}",
        "residual risk": now.residual_risk,
        "loop": f"{now.rate_hz:.2f} Hz, tick {now.tick}, {now.missed} missed",
        "scheduling": _scheduling(now),
        "left hand": _where(now, "left"),
        "right hand": _where(now, "right"),
        "nearest": _nearest(now),
        "arm": _arm(now),
        "tool": _at(now.tool_m),
        "target": _target(now),
        "led by hand": "yes, as the arm's driver reports" if now.guided else "",
        "offer": now.offer,
        "segment": _segment(now),
        "turned": _turned(now),
        "tool's limits": "; ".join(
            f"{where} {limits.text}" for where, limits in now.tool_limits.items()
        ),
        "limited by": now.binding,
        "gripper": _gripper(now),
        "rejected": _all_rejected(now),
        **_recording(now.scribe),
        "lateness": _durations(now.lateness_us, "µs", digits=1),
        "work": _durations(now.work_us, "µs", digits=1),
        "latency": _latency(now),
    }
    return {name: text for name, text in texts.items() if text}


def _outcome(now: Status) -> dict[str, str]:
    """Mode, causes and remedies, by name."""
    flags = f"  {', '.join(now.flags)}" if now.flags else ""
    return {
        "mode": in_brief(now.mode, now.reason) + flags,
        "machine": f"too busy: {now.busy}" if now.busy else "",
        "why": now.because,
        "what to do": now.remedy,
        **{
            flag: f"{what_happened(flag)}. What to do: {what_to_do(flag)}"
            for flag in now.flags
            if flag != STUCK_WORD
        },
    }


def _scheduling(now: Status) -> str:
    granted = "real time" if now.realtime else "ordinary: real time was not granted"
    awake = ", processors stay awake" if now.awake else ""
    return f"{granted}, memory {'' if now.memory_locked else 'not '}locked{awake}"


def _target(now: Status) -> str:
    """Target, its uncertainty, and the distance of the tool from it."""
    if now.tool_m is None or now.target_m is None:
        if now.hands == "neither":
            return "none: no wish is followed"
        hands = "both hands" if now.needed == SIDES else f"the {now.hands} hand"
        return f"none: the skill needs {hands}"
    off_mm = 1000 * math.dist(now.tool_m, now.target_m)
    return f"{_uncertain(now)}, the tool is {off_mm:.1f} mm from it{_doubt(now)}"


def _uncertain(now: Status) -> str:
    """The target with its standard deviation."""
    return f"{_at(now.target_m)} ± {1000 * (now.std_m or 0.0):.1f} mm"


def _segment(now: Status) -> str:
    return f"{' -> '.join(now.segment)}, {now.segment_belief:.0%} probable" if now.segment else ""


def _gripper(now: Status) -> str:
    predicted = "" if now.closure is None else f", predicted {now.closure:.0%} closed"
    return now.gripper + predicted


def _all_rejected(now: Status) -> str:
    """Rejected messages of all inputs."""
    texts = [_rejected(name, source) for name, source in now.inputs.items() if source.rejected]
    return "; ".join(texts) or "none"


def _recording(scribe: Mapping[str, Any]) -> dict[str, str]:
    """The recording, its disk and its losses, by name."""
    return {
        "recording": scribe.get("recording") or f"none ({scribe.get('state', 'off')})",
        "disk": disk(scribe) if scribe.get("free_mb") is not None else "",
        "lost": f"{scribe['lost']} ticks are not recorded" if scribe.get("lost") else "",
        "trouble": "; ".join(scribe.get("errors") or ()),
    }


def _durations(values: Percentiles, unit: str, *, digits: int) -> str:
    """Percentiles of a duration with its unit."""
    if not values.max:
        return "none yet"
    return (
        f"p50 {values.p50:.{digits}f}, p99 {values.p99:.{digits}f}, "
        f"max {values.max:.{digits}f} {unit}"
    )


def _latency(now: Status) -> str:
    if clocks := differing_clocks(now):
        return f"unknown: {clocks}"
    return _durations(now.latency_ms, "ms", digits=2)


def hours_until_full(scribe: Mapping[str, Any]) -> float | None:
    """Time until the disk of the recordings is full [h]; None if it never is, or is not known."""
    free_mb, rate, left_mb = (
        scribe.get(name) for name in ("free_mb", "mb_per_hour", "keep_mb_left")
    )
    return (
        free_mb / rate
        if rate and free_mb is not None and (left_mb is None or left_mb >= free_mb)
        else None
    )


def disk(scribe: Mapping[str, Any]) -> str:
    """Free space where the scribe records, in words, and how long it lasts if that is known."""
    rate = scribe.get("mb_per_hour")
    text = f"{in_gb(scribe['free_mb'])} free where it records"
    if not rate:
        return text
    text += f", {rate / 1000:.2g} GB an hour written"
    if (full_h := hours_until_full(scribe)) is not None:
        return f"{text}: full in {lasting(3.6e6 * full_h)}"
    begins_ms = 3.6e6 * scribe["keep_mb_left"] / rate
    begins = f"in {lasting(begins_ms)} " if begins_ms else ""
    return f"{text}: never full, {begins}each new file takes an older one's place"


def in_gb(size_mb: float) -> str:
    """A size in words, in GB, below 0.1 GB in MB."""
    return f"{size_mb:.0f} MB" if size_mb < 100 else f"{size_mb / 1000:.1f} GB"


def _doubt(now: Status) -> str:
    """The error probability in words; empty if it is not known."""
    p = now.error_probability
    return (
        ""
        if p is None
        else f"; off by more than 10 cm with a probability of {100 * p:.{1 if p < 0.1 else 0}f} %"
    )


def differing_clocks(now: Status) -> str:
    """The sources whose clocks differ too much for a latency, and the differences; empty: none."""
    phrases = []
    for side in SIDES:
        apart_ms = getattr(now.sources.get(side), "clock_ms", None)
        if apart_ms is not None and not AHEAD_MS <= apart_ms <= SHOWN_LATE_MS:
            difference = f"{lasting(abs(apart_ms))} {'ahead of' if apart_ms < 0 else 'behind'}"
            phrases.append(f"the {SOURCE_NAMES[side]}'s stamps are {difference} the daemon's clock")
    return ", ".join(phrases)


def _at(point: tuple[float, float, float] | None) -> str:
    return "unknown" if point is None else "({:.3f}, {:.3f}, {:.3f}) m".format(*point)


def _where(now: Status, side: str) -> str:
    source = now.sources.get(side, Source())
    return (f"{_at(now.hands_m.get(side))}, " if source.fresh else "") + _arrival(
        source, "not seen"
    )


def _arrival(source: Source, missing: str) -> str:
    """Age and rate of a source's samples, or since when they are missing."""
    is_rejected = source.rate_hz > 0 and source.cause
    rejected = (
        f"; {source.rate_hz:.0f} messages/s are rejected as {source.cause}" if is_rejected else ""
    )
    if source.fresh:
        return f"{source.age_ms:.0f} ms old, {source.rate_hz:.0f} Hz"
    return (
        f"{missing} "
        f"{'yet' if source.age_ms is None else f'for {source.age_ms / 1000:.1f} s'}{rejected}"
    )


def _nearest(now: Status) -> str:
    fresh = [side for side in SIDES if now.sources.get(side, Source()).fresh]
    if not fresh:
        return "no hand is seen"
    near = (
        f"{100 * now.hand_distance_m:.1f} cm to a hand, at most {now.hand_limit_m_s:.2f} m/s "
        "toward it"
    )
    unseen_sides = [side for side in now.hand_age_ms if side not in fresh]
    return near + (
        f"; the {unseen_sides[0]} hand is assumed where it was last seen" if unseen_sides else ""
    )


def _arm(now: Status) -> str:
    if "arm" not in now.sources:
        return "assumed, not measured"
    listener = "somebody" if now.command_heard else "nobody"
    return f"{_arrival(now.sources['arm'], 'no joint states')}; {listener} listens to commands"


def _turned(now: Status) -> str:
    if now.turn_off_rad is None:
        return ""
    std = f" ± {math.degrees(now.turn_std_rad):.1f}°" if now.turn_std_rad is not None else ""
    return f"{math.degrees(now.turn_off_rad):.1f}° from the target{std}"


def _rejected(name: str, source: Source) -> str:
    newest = f" (newest as {source.cause}: {source.refused})" if source.refused else ""
    counts = ", ".join(f"{count} {cause}" for cause, count in source.rejected.items())
    return f"{input_name(name)} {counts}{newest}"
