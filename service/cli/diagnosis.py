"""What two statuses of a cell say of it: what was found, what is wanted, what to do."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence

import msgspec

from service.cli.status import AHEAD_MS
from service.contract.channels import BY_KEY, key
from service.contract.incidents import SOURCE_NAMES, Evidence, explained, in_brief, remedy
from service.contract.messages import Vector3
from service.contract.records import SIDES, Reason
from service.contract.requests import Source, Status

KEYS = {"left": "hands/left", "right": "hands/right", "arm": "joints/state"}
LATE_MS = 100.0  # a stamp that is older at its arrival tells of clocks, or of a slow way
SLACK = 0.9  # of the least rate
OFTEN = 0.05  # share of what comes that is rejected, above which it is no accident
NOISY_MM = 8.0  # of a hand's samples, each axis: no tracker that sees it well
MOST_OTHERS = 4  # keys that are named
ROOM_MB = 2000.0
MISSED, LATE_US = 0.01, 1000.0  # share of deadlines, and 99th percentile of lateness
OUTSIDE_M = 0.15  # a hand this far from where it was demonstrated is somewhere else
OWN_CLOCK_S = 0.5  # a status is up to 0.1 s old


class Finding(msgspec.Struct, frozen=True):
    """One thing that was looked at; `level` is ok, note or wrong."""

    level: str
    what: str
    found: str
    wanted: str = ""
    remedy: str = ""

    def line(self) -> str:
        """All of it in one line."""
        said = [f"{self.level:<5}  {self.what:<18} {self.found}"]
        if self.level != "ok":
            said += [f"wanted: {self.wanted}"] if self.wanted else []
            said += [f"what to do: {self.remedy}"] if self.remedy else []
        return " | ".join(said)


wrong = functools.partial(Finding, "wrong")  # what needs to be mended


def judged(fine: bool, what: str, found: str, wanted: str, remedy: str) -> Finding:
    """What is right, or needs to be mended."""
    return Finding("ok" if fine else "wrong", what, found, wanted, remedy)


def findings(
    before: Status, now: Status, *, own_ns: int, own_version: str, published: Sequence[str] = ()
) -> Iterator[Finding]:
    """What is to be said of a cell; `own_ns` and `own_version` are time and version here, and
    `published` the keys on which hands and joints were heard, in whatever cell.
    """
    listens = f"listens on {', '.join(now.endpoints)}" if now.endpoints else "listens nowhere, it connects"
    found, wanted = f"version {now.version}, {listens}", f"version {own_version}, as here"
    yield judged(now.version == own_version, "daemon", found, wanted, "update the older one")
    if now.tick < 0:
        yield wrong("loop", "no tick yet", "ticks", "wait: the first start on a machine compiles for half a minute")
        return
    yield _mode(now)
    for name in now.sources:
        yield from _source(before, now, name, published)
    yield _driver(now)
    yield from _hands_and_skill(now)
    yield from _machine(before, now)
    apart_s = (own_ns - now.time_ns) / 1e9
    if abs(apart_s) > OWN_CLOCK_S:
        told = f"{abs(apart_s):.3g} s {'ahead of' if apart_s > 0 else 'behind'} the daemon's"
        yield Finding("note", "clock here", told, f"within {OWN_CLOCK_S:g} s", "synchronise the clocks (chrony, PTP)")


def _mode(now: Status) -> Finding:
    told = in_brief(now.mode, now.reason) + (f", {', '.join(now.flags)}" if now.flags else "")
    level = "ok" if now.mode == "follow" else "note" if now.reason == "operator" else "wrong"
    return Finding(level, "mode", told + (f": {now.because}" if now.because else ""), "follow", now.remedy)


def _source(before: Status, now: Status, name: str, published: Sequence[str]) -> Iterator[Finding]:
    source, what = now.sources[name], SOURCE_NAMES[name]
    least, most = map(int, re.findall(r"\d+", BY_KEY[KEYS[name]].rate))
    wanted = f"{least} to {most} Hz on {key(now.cell, KEYS[name])}, " + (
        f"joints {', '.join(now.joints)}"
        if name == "arm"
        else f"frame {' or '.join(repr(frame) for frame in now.frames if frame)} or none"
    )
    if not source.rate_hz:
        told = "nothing comes" if source.age_ms is None else f"nothing came for {source.age_ms / 1000:.1f} s"
        group = KEYS[name].rpartition("/")[0]
        ours = {key(now.cell, wanted_key) for wanted_key in KEYS.values()}
        others = [one for one in published if f"/{group}/" in one and one not in ours][:MOST_OTHERS]
        told += f", but on {', '.join(others)}" if others else ""
        start = f"start {'the driver' if name == 'arm' else 'the tracker'}, connected to "
        rename = f"let it publish {key(now.cell, KEYS[name])}; or " if others else ""
        yield wrong(what, told, wanted, rename + start + (", ".join(now.endpoints) or "where the daemon connects"))
        return
    told = f"{source.rate_hz:.0f} Hz, " + ("none accepted" if source.age_ms is None else f"{source.age_ms:.0f} ms old")
    told += f", {len(now.joints)} joints" if name == "arm" else f", frame {source.frame!r}"
    fine = source.fresh and source.rate_hz >= SLACK * least
    advice = "" if source.fresh else remedy(source.cause)
    yield judged(fine, what, told, wanted, advice or "let it publish as often, and without pauses")
    yield from _rejected(before, now, name)
    if source.clock_ms is not None and not AHEAD_MS <= source.clock_ms <= LATE_MS:
        way = "before it comes" if source.clock_ms > 0 else "after it comes: its clock is ahead"
        told = f"a sample is stamped {abs(source.clock_ms) / 1000:.3g} s {way}"
        advice = "synchronise its clock (chrony, PTP), or stamp as it is sent; no latency can be told until then"
        level = "note" if name == "arm" else "wrong"  # of the arm's nothing is told
        yield Finding(level, f"{what}'s clock", told, f"less than {LATE_MS / 1000:g} s", advice)


def _rejected(before: Status, now: Status, name: str) -> Iterator[Finding]:
    source, what, seconds = now.sources[name], SOURCE_NAMES[name], max((now.time_ns - before.time_ns) / 1e9, 0.1)
    earlier, came = before.sources.get(name, Source()).rejected, max(source.rate_hz, 1.0)
    rates = {cause: (count - earlier.get(cause, 0)) / seconds for cause, count in source.rejected.items()}
    share = max(source.contested, (rates.get("older", 0.0) + rates.get("jumped", 0.0)) / came)
    for cause, rate in rates.items():
        if rate and not (share > OFTEN and cause in ("older", "jumped")):  # said below
            why = f": {source.refused}" if cause == source.cause and source.refused else ""
            level = "wrong" if rate > OFTEN * came else "note"
            yield Finding(level, what, f"{rate:.0f} messages/s rejected as {cause}{why}", "none", remedy(cause))
    noisy = source.fresh and source.scatter_mm is not None and source.scatter_mm > NOISY_MM
    if share > OFTEN or noisy:
        seen = Evidence({name: msgspec.structs.replace(source, contested=share)}, OFTEN, NOISY_MM)
        found = explained(Reason.TWO_SOURCES, seen)
        wanted = f"one publisher of {key(now.cell, KEYS[name])}, and a tracker that sees well"
        yield wrong(what, found.why, wanted, found.what_to_do)


def _driver(now: Status) -> Finding:
    if "arm" not in now.sources:
        return Finding("note", "arm", "assumed, not measured", "", "with an arm start the daemon with --arm state")
    commands = key(now.cell, "joints/command")
    told = f"{'somebody' if now.command_heard else 'nobody'} listens to {commands}"
    return judged(now.command_heard, "arm's driver", told, "a driver", f"let the arm's driver subscribe to {commands}")


def _hands_and_skill(now: Status) -> Iterator[Finding]:
    boxes = now.demonstrated_m
    there = {side: now.hands_m[side] for side in SIDES if side in boxes and now.sources[side].fresh}
    off = {side: _outside(at, boxes[side]) for side, at in there.items()}
    crossed = [_outside(at, boxes[SIDES[1 - SIDES.index(side)]]) for side, at in there.items()]
    swapped = len(off) == len(SIDES) and max(crossed) < OUTSIDE_M < min(off.values())
    advice = (
        "left and right look swapped: publish each under the other's key"
        if swapped
        else "bring it there, or demonstrate this too; see that [hands] unit and base_from_tracker are right"
    )
    for side, at in there.items():
        told = f"at {_point(at)} m, {off[side]:.2f} m from where the skill knows it"
        wanted = " to ".join(map(_point, boxes[side])) + " m"
        yield judged(off[side] <= OUTSIDE_M, f"{SOURCE_NAMES[side]}'s place", told, wanted, advice)
    if now.deviation_m is not None:
        told = f"hands deviate by {100 * now.deviation_m:.1f} cm from what it knows"
        wanted = f"up to {100 * now.threshold_m:.1f} cm"
        yield judged(now.deviation_m <= now.threshold_m, "skill", told, wanted, remedy("far_from_demonstrations"))


def _machine(before: Status, now: Status) -> Iterator[Finding]:
    missed, ticks, late_us = now.missed - before.missed, max(now.tick - before.tick, 1), now.lateness_us.p99
    told = f"{now.rate_hz:.1f} Hz, {missed} of {ticks} deadlines missed, late by {late_us:.0f} µs (p99)"
    wanted = f"less than {MISSED:.0%} missed, and {LATE_US:.0f} µs"
    advice = "see what else runs there; `thirdhand bench` measures it"
    yield judged(missed <= MISSED * ticks and late_us <= LATE_US, "loop", told, wanted, advice)
    told, wanted = ("" if now.realtime else "not ") + "granted", "SCHED_FIFO for the daemon's user"
    yield judged(now.realtime, "real time", told, wanted, "raise its rtprio limit, as docs/hardware.md says")
    told, wanted = ("" if now.memory_locked else "not ") + "locked", "memory that is not paged out"
    yield judged(now.memory_locked, "memory", told, wanted, "raise its memlock limit, as docs/hardware.md says")
    scribe = now.scribe
    state, lost, free_mb = scribe.get("state", "off"), scribe.get("lost", 0), scribe.get("free_mb")
    if state == "off":
        yield Finding("note", "recording", "none is asked for", "", "`thirdhand serve --record DIR`")
        return
    told = "; ".join([f"{state}, {lost} ticks lost", *(scribe.get("errors") or ())])
    advice = "see that the folder is there and has room; `thirdhand replay` says what is missing"
    yield judged(state != "interrupted" and not lost, "recording", told, "recording, none lost", advice)
    if free_mb is not None:
        told, wanted = f"{free_mb / 1000:.1f} GB free where it records", f"more than {ROOM_MB / 1000:g} GB"
        yield judged(free_mb > ROOM_MB, "disk", told, wanted, "make room, or lower [files] keep_mb")


def _outside(at: Vector3, box: tuple[Vector3, Vector3]) -> float:
    """How far a point is outside of a box [m]."""
    gaps = (max(low - v, 0.0, v - high) for v, low, high in zip(at, *box, strict=True))
    return float(sum(gap * gap for gap in gaps) ** 0.5)


def _point(values: Vector3) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*values)
