"""What two statuses of a cell say of it: what was found, what is wanted, what to do."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence

import msgspec

from service.cli.status import AHEAD_MS
from service.contract.channels import BY_KEY, key
from service.contract.incidents import FREE_THE_MACHINE, SOURCE_NAMES, Evidence, explained, in_brief, remedy
from service.contract.messages import Vector3
from service.contract.records import SIDES, Reason
from service.contract.requests import Source, Status

KEYS = {"left": "hands/left", "right": "hands/right", "arm": "joints/state"}
LATE_MS = 100.0  # a stamp that is older at its arrival tells of clocks, or of a slow way
SLACK = 0.9  # of the least rate
OFTEN = 0.05  # share of what comes that is rejected, above which it is no accident
NOISY_MM = 8.0  # of a hand's samples, each axis: no tracker that sees it well
MOST_OTHERS = 4  # keys that are named
ROOM_MB, LASTS_H = 2000.0, 1.0  # of free space, and how long that is to last at least
MISSED, LATE_US = 0.01, 1000.0  # share of deadlines, and 99th percentile of lateness
OUTSIDE_M = 0.15  # a hand this far from where it was demonstrated is somewhere else
TOLD_RAD, STUCK = 0.03, 0.1  # what a joint is told to travel before it can be stuck, and the share that it did
OFF_M, LONG_S = 0.05, 1.5  # a tool farther off its target, and for longer, does not only lag
LEVEL_M, RAISED_M = 0.03, 0.10  # of hands: the span of z, and of y, by which y looks to be the height
Y_UP = (0.0, 0.0, 0.0, 0.7071, 0.0, 0.0, 0.7071)  # base_from_tracker of a tracker whose y points up
MACHINE = "machine"
LEVELS = ("wrong", "note", "ok")
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
    *seen: Status,
    own_ns: int,
    own_version: str,
    published: Sequence[str] = (),
    travels: Mapping[str, tuple[float, float]] | None = None,
) -> list[Finding]:
    """What is to be said of a cell by its statuses: what is wrong first, causes before what follows
    from them.

    `own_ns` and `own_version` are time and version here, `published` the keys on which hands and
    joints were heard, in whatever cell, and `travels` how far each joint was told to go, and went,
    since the first status [rad].
    """
    found = list(_in_order_of_cause(seen, own_ns, own_version, published, travels or {}))
    if any(finding.level == "wrong" for finding in found):  # it may be the machine that makes it look so
        found = [wrong(*msgspec.structs.astuple(one)[1:]) if one.what == MACHINE else one for one in found]
    return sorted(found, key=lambda finding: LEVELS.index(finding.level))


def _in_order_of_cause(
    seen: Sequence[Status],
    own_ns: int,
    own_version: str,
    published: Sequence[str],
    travels: Mapping[str, tuple[float, float]],
) -> Iterator[Finding]:
    before, now = seen[0], seen[-1]
    listens = f"listens on {', '.join(now.endpoints)}" if now.endpoints else "listens nowhere, it connects"
    found, wanted = f"version {now.version}, {listens}", f"version {own_version}, as here"
    yield judged(now.version == own_version, "daemon", found, wanted, "update the older one")
    if now.tick < 0:
        yield wrong("loop", "no tick yet", "ticks", "wait: it begins once the recorder listens")
        return
    yield from _machine(before, now)
    for name in now.sources:
        yield from _source(before, now, name, published)
    yield _driver(before, now)
    yield from _drives(travels)
    yield from _hands_and_skill(seen)
    yield _mode(now)
    yield from _tool(seen)
    yield from _privileges_and_recording(now)
    apart_s = (own_ns - now.time_ns) / 1e9
    if abs(apart_s) > OWN_CLOCK_S:
        told = f"{abs(apart_s):.3g} s {'ahead of' if apart_s > 0 else 'behind'} the daemon's"
        yield Finding("note", "clock here", told, f"within {OWN_CLOCK_S:g} s", "synchronise the clocks (chrony, PTP)")


def _mode(now: Status) -> Finding:
    told = in_brief(now.mode, now.reason) + (f", {', '.join(now.flags)}" if now.flags else "")
    told += f": {now.because}" if now.because else ""
    advice = now.remedy
    if now.reason == "arm_error":
        advice += "; if it has not moved since commands began: are the drives on?"
    level = "ok" if now.mode == "follow" else "note" if now.reason == "operator" else "wrong"
    return Finding(level, "mode", told, "follow", advice)


def _drives(travels: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """The joint that was told to go farthest of those that did not."""
    stuck = {name: told for name, (told, went) in travels.items() if told > TOLD_RAD and went < STUCK * told}
    if stuck:
        name = max(stuck, key=lambda joint: stuck[joint])
        found = f"{name} was told to go {stuck[name]:.2f} rad and it has not moved since commands began"
        advice = "are the drives on? Look at their power, brakes and emergency stop; then `thirdhand reset`"
        yield wrong("arm's drives", found, "joints that go where they are told", advice)


def _tool(seen: Sequence[Status]) -> Iterator[Finding]:
    """Whether the tool is off its target for long."""
    offs = [
        math.dist(one.tool_measured_m or one.tool_m, one.target_m)
        for one in seen
        if one.mode == "follow" and one.tool_m is not None and one.target_m is not None
    ]
    lasts_s, flags = (seen[-1].time_ns - seen[0].time_ns) / 1e9, seen[-1].flags
    if len(offs) == len(seen) and lasts_s > LONG_S and min(offs) > OFF_M:
        found = f"off its target by {100 * min(offs):.0f} cm or more for {lasts_s:.1f} s"
        advice = "; ".join(map(remedy, flags)) or "see that the arm's driver follows commands, and as fast"
        level = "note" if flags else "wrong"
        yield Finding(level, "tool", found, f"within {100 * OFF_M:.0f} cm once the hands rest", advice)


def _source(before: Status, now: Status, name: str, published: Sequence[str]) -> Iterator[Finding]:
    source, what = now.sources[name], SOURCE_NAMES[name]
    least, most = map(int, re.findall(r"\d+", BY_KEY[KEYS[name]].rate))
    wanted = f"{least} to {most} Hz on {key(now.cell, KEYS[name])}, " + (
        f"joints {', '.join(now.joints)}"
        if name == "arm"
        else f"frame {' or '.join(repr(frame) for frame in now.frames if frame)} or none"
    )
    if not source.rate_hz and name in SIDES and name not in now.needed:
        yield Finding("ok", what, "nothing comes, and the skill does without it")
        return
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
    advice = "" if source.fresh else _of_unit(source) or source.advice or remedy(source.cause)
    rejected = list(_rejected(before, now, name))
    yield from rejected
    if source.age_ms is None and any(one.level == "wrong" for one in rejected):
        return  # nothing is accepted of it, and why is said
    yield judged(fine, what, told, wanted, advice or "let it publish as often, and without pauses")
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
            advice = (_of_unit(source) or source.advice if cause == source.cause else "") or remedy(cause)
            yield Finding(level, what, f"{rate:.0f} messages/s rejected as {cause}{why}", "none", advice)
    noisy = source.fresh and source.scatter_mm is not None and source.scatter_mm > NOISY_MM
    if share > OFTEN or noisy:
        seen = Evidence({name: msgspec.structs.replace(source, contested=share)}, OFTEN, NOISY_MM)
        found = explained(Reason.TWO_SOURCES, seen)
        wanted = f"one publisher of {key(now.cell, KEYS[name])}, and a tracker that sees well"
        yield wrong(what, found.why, wanted, found.what_to_do)


def _of_unit(source: Source) -> str:
    """What to write or publish where what was refused looks to be in another unit."""
    looks = re.search(r"looks like (\w+)", source.refused)
    if looks is None or source.cause != "out_of_range":
        return ""
    if looks[1] == "degrees":
        return "publish joints in radians"
    return f'write unit = "{looks[1]}" under [hands] in the cell\'s settings, and start the daemon anew'


def _driver(before: Status, now: Status) -> Finding:
    if "arm" not in now.sources:
        return Finding("note", "arm", "assumed, not measured", "", "with an arm start the daemon with --joints state")
    commands, heard = key(now.cell, "joints/command"), before.command_heard and now.command_heard
    told = f"{'somebody' if heard else 'nobody'} listens to {commands}"
    return judged(heard, "arm's driver", told, "a driver", f"let the arm's driver subscribe to {commands}")


def _hands_and_skill(seen: Sequence[Status]) -> Iterator[Finding]:
    now, boxes = seen[-1], seen[-1].demonstrated_m
    there = {side: now.hands_m[side] for side in SIDES if side in boxes and now.sources[side].fresh}
    off = {side: _outside(at, boxes[side]) for side, at in there.items()}
    crossed = [
        _outside(at, boxes[other]) for side, at in there.items() if (other := SIDES[1 - SIDES.index(side)]) in boxes
    ]
    swapped = len(off) == len(SIDES) and max(crossed) < OUTSIDE_M < min(off.values())
    advice = (
        "left and right look swapped: publish each under the other's key"
        if swapped
        else "bring it there, or demonstrate this too; see that [hands] unit and base_from_tracker are right"
    )
    if off and max(off.values()) > OUTSIDE_M and _is_y_up(seen):
        written = "[{}]".format(", ".join(f"{v:g}" for v in Y_UP))
        yield wrong(
            "tracker's axes",
            "z of the hands stays as it is while y moves like a height",
            "z up, as in frame base",
            f"if y is up, write base_from_tracker = {written} under [hands]; its first three are where the tracker's "
            "origin is in base [m]",
        )
    for side, at in there.items():
        told = f"at {_point(at)} m, {off[side]:.2f} m from where the skill knows it"
        wanted = " to ".join(map(_point, boxes[side])) + " m"
        yield judged(off[side] <= OUTSIDE_M, f"{SOURCE_NAMES[side]}'s place", told, wanted, advice)
    if now.deviation_m is not None:
        told = f"hands deviate by {100 * now.deviation_m:.1f} cm from what it knows"
        wanted = f"up to {100 * now.threshold_m:.1f} cm"
        yield judged(now.deviation_m <= now.threshold_m, "skill", told, wanted, remedy("far_from_demonstrations"))


def _is_y_up(seen: Sequence[Status]) -> bool:
    """Whether y looks to be the hands' height: alike for both, and changing while z does not."""
    at = [one.hands_m for one in seen if all(side in one.hands_m for side in SIDES)]
    heights = [[hands[side][1] for hands in at] for side in SIDES]
    levels = [[hands[side][2] for hands in at] for side in SIDES]
    return (
        bool(at)
        and all(max(level) - min(level) < LEVEL_M for level in levels)
        and any(max(height) - min(height) > RAISED_M for height in heights)
        and abs(heights[0][0] - heights[1][0]) < 3 * RAISED_M
    )


def _machine(before: Status, now: Status) -> Iterator[Finding]:
    missed, ticks, late_us = now.missed - before.missed, max(now.tick - before.tick, 1), now.lateness_us.p99
    if now.busy:
        advice = FREE_THE_MACHINE.replace("`", "")
        wanted = "time for all that runs in real time; else arm, network and clocks seem to fail"
        yield Finding("note", MACHINE, f"too busy: {now.busy}", wanted, advice)
    told = f"{now.rate_hz:.1f} Hz, {missed} of {ticks} deadlines missed, late by {late_us:.0f} µs (p99)"
    most_us = max(LATE_US, 0.5e6 / max(now.rate_hz, 1.0))  # half of a period
    wanted = f"less than {MISSED:.0%} missed, and {most_us:.0f} µs"
    advice = "see what else runs there; `thirdhand bench` measures it"
    yield judged(missed <= MISSED * ticks and late_us <= most_us, "loop", told, wanted, advice)


def _privileges_and_recording(now: Status) -> Iterator[Finding]:
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
        yield _disk(free_mb, scribe.get("mb_per_hour"), scribe.get("keep_mb_left"))


def _disk(free_mb: float, mb_per_hour: float | None, keep_mb_left: float | None) -> Finding:
    """Free space where the cell records, and how long it lasts."""
    told, lasts = f"{free_mb / 1000:.1f} GB free where it records", True
    if mb_per_hour:
        told += f", {mb_per_hour / 1000:.2g} GB an hour written"
        if keep_mb_left is not None and keep_mb_left < free_mb:
            told += f": in {_hours(keep_mb_left / mb_per_hour)} the oldest recordings begin to be removed"
        else:
            told += f": full in {_hours(free_mb / mb_per_hour)}"
            lasts = free_mb / mb_per_hour > LASTS_H
    wanted = f"more than {ROOM_MB / 1000:g} GB, and {LASTS_H:g} h"
    advice = "make room, or lower [files] keep_mb, or rerun_mb_per_hour"
    return judged(free_mb > ROOM_MB and lasts, "disk", told, wanted, advice)


def _hours(hours: float) -> str:
    return f"{hours:.1f} h" if hours < 48 else f"{hours / 24:.0f} days"


def _outside(at: Vector3, box: tuple[Vector3, Vector3]) -> float:
    """How far a point is outside of a box [m]."""
    gaps = (max(low - v, 0.0, v - high) for v, low, high in zip(at, *box, strict=True))
    return float(sum(gap * gap for gap in gaps) ** 0.5)


def _point(values: Vector3) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*values)
