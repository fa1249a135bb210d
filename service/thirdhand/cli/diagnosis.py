"""The diagnosis of a cell from its statuses: what was found, what is required, what to do."""

from __future__ import annotations

import functools
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from thirdhand.cli.status import AHEAD_MS, disk, hours_until_full
from thirdhand.contract.channels import BY_KEY, key
from thirdhand.contract.evidence import Evidence, explained, lasting, unit_advice
from thirdhand.contract.incidents import (
    SOURCE_NAMES,
    Condition,
    in_brief,
    input_name,
    what_to_do,
    word,
)
from thirdhand.contract.messages import Vector3
from thirdhand.contract.records import SIDES, Cause, Reason
from thirdhand.contract.requests import Source, Status
from thirdhand.contract.ros2 import NO_TYPE_HASH

KEYS = {"left": "hands/left", "right": "hands/right", "arm": "joints/state"}
# a stamp older than this at its arrival shows that clocks differ, or a slow network
LATE_MS = 100.0
LEAST_RATE_SHARE = 0.9  # smallest accepted rate / least rate of the key
REJECTED_SHARE = 0.05  # a larger share of rejected samples is no accident
SCATTER_MM = 8.0  # a tracker that sees a hand well scatters less, on each axis
MOST_OTHER_KEYS = 4  # keys that are named
FREE_MB = 2000.0  # least free space
DISK_LASTS_H = 1.0  # least time until the disk is full
MAX_MISSED_SHARE = 0.01  # largest share of missed deadlines
LATE_US = 1000.0  # largest 99th percentile of the lateness, unless half a period is longer
# a hand that is farther below the table top shows that the calibration is off
MAX_BELOW_TABLE_M = 0.03
OUTSIDE_M = 0.15  # a hand this far outside the demonstrated box is elsewhere
COMMANDED_RAD = 0.03  # a joint is judged once it was commanded to travel this far
LATE_ARM_MS = 30.0  # largest lag of an arm, with the delay of its driver's playback
BOUND_SHARE = 0.1  # a limit that binds in a larger share of the statuses is noted
MOVED_SHARE = 0.1  # a joint that moved less than this share of it has not moved
# a tool that is farther away for longer does not only lag
OFF_TARGET_M = 0.05
OFF_TARGET_S = 1.5
# if z spans less than the first and y more than the second, y is the height
LEVEL_M = 0.03
RAISED_M = 0.10
Y_UP = (0.0, 0.0, 0.0, 0.7071, 0.0, 0.0, 0.7071)  # base_from_tracker of a tracker whose y points up
MACHINE = "machine"
LEVELS = ("wrong", "note", "ok")
OWN_CLOCK_S = 0.5  # accepted difference; a status is up to 0.1 s old


class Finding(msgspec.Struct, frozen=True):
    """The finding on one thing; `level` is ok, note or wrong."""

    level: str
    what: str
    found: str
    wanted: str = ""
    remedy: str = ""

    def text(self) -> str:
        """The finding as text, with what is required and what to do on lines of their own."""
        parts = [f"{self.level:<5}  {self.what:<18} {self.found}"]
        if self.level != "ok":
            parts += [f"required: {self.wanted}"] if self.wanted else []
            parts += [f"what to do: {self.remedy}"] if self.remedy else []
        return f"\n{'':<26}".join(parts)


wrong = functools.partial(Finding, "wrong")


def judged(is_fine: bool, what: str, found: str, wanted: str, remedy: str) -> Finding:
    """A finding that is ok or wrong."""
    return Finding("ok" if is_fine else "wrong", what, found, wanted, remedy)


def findings(
    *seen: Status,
    own_ns: int,
    own_version: str,
    published: Sequence[str] = (),
    travels: Mapping[str, tuple[float, float]] | None = None,
    lag_ms: float | None = None,
) -> list[Finding]:
    """The findings on a cell, from its statuses: wrong ones first, causes before their effects.

    `own_ns` and `own_version` are time and version of this machine, `published` the keys of any
    cell on which hands and joints were received, `travels` the commanded and the measured travel of
    each joint since the first status [rad], and `lag_ms` the measured lag of the arm; None: it was
    not measured.
    """
    results = list(_in_order_of_cause(seen, own_ns, own_version, published, travels or {}, lag_ms))
    if any(finding.level == "wrong" for finding in results):  # a busy machine may be the cause
        results = [
            wrong(*msgspec.structs.astuple(finding)[1:]) if finding.what == MACHINE else finding
            for finding in results
        ]
    return sorted(results, key=lambda finding: LEVELS.index(finding.level))


def _in_order_of_cause(
    seen: Sequence[Status],
    own_ns: int,
    own_version: str,
    published: Sequence[str],
    travels: Mapping[str, tuple[float, float]],
    lag_ms: float | None,
) -> Iterator[Finding]:
    before = seen[0]
    now = seen[-1]
    yield _daemon(now, own_version)
    if now.tick < 0:
        yield wrong("loop", "no tick yet", "ticks", what_to_do(Condition.STARTING))
        return
    yield from _machine(before, now)

    for name in now.sources:
        yield from _source(before, now, name, published)
    yield from _humble(published)
    for name in now.streams:
        yield from _rejected(before, now, name)

    yield _driver(before, now)
    yield from _drives(travels)
    if "arm" in now.sources and now.command_heard:
        yield _lag(lag_ms)
    yield from _calibration(seen)
    yield from _places(seen)
    yield from _deviation(now)

    yield _mode(now)
    yield from _tool(seen)
    yield from _limits(seen)
    yield from _privileges_and_recording(now)
    yield from _own_clock(now, own_ns)


def _daemon(now: Status, own_version: str) -> Finding:
    listens = (
        f"listens on {', '.join(now.endpoints)}"
        if now.endpoints
        else "listens nowhere, it connects"
    )
    return judged(
        now.version == own_version,
        "daemon",
        f"version {now.version}, {listens}",
        f"version {own_version}, as here",
        what_to_do(Condition.VERSIONS_DIFFER),
    )


def _humble(published: Sequence[str]) -> Iterator[Finding]:
    """Keys that ROS 2 Humble publishes, which lack the hash of their type."""
    keys = [key_expr for key_expr in published if key_expr.endswith(f"/{NO_TYPE_HASH}")]
    if keys:
        yield Finding(
            "note",
            "ROS 2",
            f"Humble publishes {', '.join(keys[:MOST_OTHER_KEYS])}",
            "keys with the hash of their type, as of Iron and later",
            what_to_do(Condition.HUMBLE),
        )


def _own_clock(now: Status, own_ns: int) -> Iterator[Finding]:
    """A clock of this machine that differs from the daemon's."""
    ahead_s = (own_ns - now.time_ns) / 1e9
    if abs(ahead_s) > OWN_CLOCK_S:
        order = "ahead of" if ahead_s > 0 else "behind"
        actual = f"{lasting(1000 * abs(ahead_s))} {order} the daemon's"
        advice = what_to_do(Condition.CLOCKS_DIFFER)
        yield Finding("note", "clock here", actual, f"within {OWN_CLOCK_S:g} s", advice)


def _mode(now: Status) -> Finding:
    actual = in_brief(now.mode, now.reason) + (f", {', '.join(now.flags)}" if now.flags else "")
    actual += f": {now.because}" if now.because else ""
    level = "ok" if now.mode == "follow" else "wrong"
    if now.reason == "operator":
        level = "note"
    return Finding(level, "mode", actual, "follow", now.remedy)


def _drives(travels: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """The joint with the largest commanded travel of those that did not move, if any; `travels`:
    commanded and actual travel [rad] by joint.
    """
    still = {
        name: commanded
        for name, (commanded, moved) in travels.items()
        if commanded > COMMANDED_RAD and moved < MOVED_SHARE * commanded
    }
    if still:
        name = max(still, key=lambda joint: still[joint])
        actual = (
            f"{name} was commanded to move by {still[name]:.2f} rad, but has not moved since "
            "commands began"
        )
        yield wrong(
            "arm's drives",
            actual,
            "joints that follow their commands",
            what_to_do(Condition.DRIVES_OFF),
        )


def _lag(lag_ms: float | None) -> Finding:
    subject = "arm's lag"
    if lag_ms is None:
        return Finding(
            "ok",
            subject,
            "not measured, because the arm did not follow a motion evenly: "
            "move the hands meanwhile",
        )
    actual = f"the arm follows its commands {lag_ms:.0f} ms late"
    expected = f"up to {LATE_ARM_MS:.0f} ms"
    level = "ok" if lag_ms <= LATE_ARM_MS else "note"
    return Finding(level, subject, actual, expected, what_to_do(Condition.ARM_LATE))


def _limits(seen: Sequence[Status]) -> Iterator[Finding]:
    """Limits of the tool where the task is, and the one that binds most often."""
    if limits := seen[-1].tool_limits:
        yield Finding(
            "ok",
            "tool's limits",
            "; ".join(f"{where} {limit.text}" for where, limit in limits.items()),
        )
    bound = Counter(status.binding for status in seen if status.binding)
    name, count = bound.most_common(1)[0] if bound else ("", 0)
    if count > BOUND_SHARE * len(seen):
        actual = f"{name}, in {count / len(seen):.0%} of the time"
        expected = f"in less than {BOUND_SHARE:.0%}"
        yield Finding(
            "note", "limit that binds", actual, expected, what_to_do(Condition.LIMIT_BINDS)
        )


def _tool(seen: Sequence[Status]) -> Iterator[Finding]:
    """A tool that has been off its target for long."""
    distances_m = [
        math.dist(status.tool_measured_m or status.tool_m, status.target_m)
        for status in seen
        if status.mode == "follow" and status.tool_m is not None and status.target_m is not None
    ]
    lasts_s = (seen[-1].time_ns - seen[0].time_ns) / 1e9
    flags = seen[-1].flags
    if len(distances_m) == len(seen) and lasts_s > OFF_TARGET_S and min(distances_m) > OFF_TARGET_M:
        actual = f"{100 * min(distances_m):.0f} cm or more from its target for {lasts_s:.1f} s"
        advice = "; ".join(map(what_to_do, flags)) or what_to_do(Condition.OFF_TARGET)
        level = "note" if flags else "wrong"
        yield Finding(
            level, "tool", actual, f"within {100 * OFF_TARGET_M:.0f} cm once the hands rest", advice
        )


def _source(before: Status, now: Status, name: str, published: Sequence[str]) -> Iterator[Finding]:
    source = now.sources[name]
    if source.rate_hz:
        yield from _arriving(before, now, name)
    elif name in SIDES and name not in now.needed:
        yield Finding("ok", SOURCE_NAMES[name], "nothing arrives; the skill does not need it")
    else:
        yield _silent(now, name, published)


def _rates_hz(name: str) -> tuple[int, int]:
    """Least and highest accepted rate [Hz] of a source."""
    least, most = map(int, re.findall(r"\d+", BY_KEY[KEYS[name]].rate))
    return least, most


def _expected(now: Status, name: str) -> str:
    """The samples that are expected of a source, in words."""
    least, most = _rates_hz(name)
    content = (
        f"joints {', '.join(now.joints)}"
        if name == "arm"
        else f"frame {', '.join(repr(frame) for frame in now.frames if frame)} or none"
    )
    return f"{least} to {most} Hz on {key(now.cell, KEYS[name])}, {content}"


def _silent(now: Status, name: str, published: Sequence[str]) -> Finding:
    """A source of which nothing arrives, and other keys on which it may be published."""
    age_ms = now.sources[name].age_ms
    actual = "nothing arrives" if age_ms is None else f"nothing arrived for {age_ms / 1000:.1f} s"
    advice = what_to_do(Condition.JOINTS_SILENT if name == "arm" else Condition.HAND_SILENT)
    if now.endpoints:
        advice += f" ({', '.join(now.endpoints)})"

    if similar_keys := _similar_keys(now, name, published):
        actual += f", but on {', '.join(similar_keys)}"
        rename = f"{what_to_do(Condition.KEY_MISSPELT)}, {key(now.cell, KEYS[name])}"
        advice = f"{rename}; or {advice}"
    return wrong(SOURCE_NAMES[name], actual, _expected(now, name), advice)


def _similar_keys(now: Status, name: str, published: Sequence[str]) -> list[str]:
    """Published keys of a source's group that are none of this cell's."""
    group = KEYS[name].rpartition("/")[0]
    own_keys = {key(now.cell, suffix) for suffix in KEYS.values()}
    similar_keys = [
        key_expr
        for key_expr in published
        if f"/{group}/" in key_expr
        and key_expr not in own_keys
        and not key_expr.endswith(NO_TYPE_HASH)
    ]
    return similar_keys[:MOST_OTHER_KEYS]


def _arriving(before: Status, now: Status, name: str) -> Iterator[Finding]:
    """The findings on a source of which samples arrive."""
    source = now.sources[name]
    rejected = list(_rejected(before, now, name))
    yield from rejected
    if not source.fresh and any(finding.level == "wrong" for finding in rejected):
        return  # all of its samples are rejected; the reason is found above

    age = "none accepted" if source.age_ms is None else f"{source.age_ms:.0f} ms old"
    content = f"{len(now.joints)} joints" if name == "arm" else f"frame {source.frame!r}"
    least_hz, _ = _rates_hz(name)
    advice = (
        "" if source.fresh else _unit_advice(source) or source.advice or what_to_do(source.cause)
    )
    yield judged(
        source.fresh and source.rate_hz >= LEAST_RATE_SHARE * least_hz,
        SOURCE_NAMES[name],
        f"{source.rate_hz:.0f} Hz, {age}, {content}",
        _expected(now, name),
        advice or what_to_do(Condition.RATE_LOW),
    )
    yield from _source_clock(source, name)


def _source_clock(source: Source, name: str) -> Iterator[Finding]:
    """A source whose clock differs from the daemon's."""
    if source.clock_ms is None or AHEAD_MS <= source.clock_ms <= LATE_MS:
        return
    order = "before it arrives" if source.clock_ms > 0 else "after it arrives: its clock is ahead"
    yield Finding(
        "note" if name == "arm" else "wrong",  # no latency is computed from the arm's stamps
        f"{SOURCE_NAMES[name]}'s clock",
        f"a sample is stamped {lasting(abs(source.clock_ms))} {order}; no latency can be measured",
        f"less than {LATE_MS / 1000:g} s",
        what_to_do(Condition.CLOCKS_DIFFER),
    )


def _rejected(before: Status, now: Status, name: str) -> Iterator[Finding]:
    source = now.inputs[name]
    subject = input_name(name)
    rates_hz = _rejection_rates_hz(before, now, name)
    contradicting_hz = rates_hz.get("older", 0.0) + rates_hz.get("jumped", 0.0)
    contested = max(source.contested, contradicting_hz / max(source.rate_hz, 1.0))
    has_two_publishers = name == "arm" and contested > REJECTED_SHARE

    for cause, rate_hz in rates_hz.items():
        is_explained = has_two_publishers and cause in ("older", "jumped")
        if rate_hz and not is_explained:
            yield _rejection(source, subject, cause, rate_hz)
    if has_two_publishers:
        yield _two_publishers(now.cell, source, contested)
    if source.fresh and source.scatter_mm is not None and source.scatter_mm > SCATTER_MM:
        scatter = f"the samples scatter by {source.scatter_mm:.0f} mm on each axis"
        yield wrong(subject, scatter, f"at most {SCATTER_MM:.0f} mm", what_to_do(Condition.NOISY))


def _rejection_rates_hz(before: Status, now: Status, name: str) -> dict[str, float]:
    """Rejected messages of an input per second [Hz], by cause."""
    seconds = max((now.time_ns - before.time_ns) / 1e9, 0.1)
    earlier = before.inputs.get(name, Source()).rejected
    counts = now.inputs[name].rejected
    return {cause: (count - earlier.get(cause, 0)) / seconds for cause, count in counts.items()}


def _rejection(source: Source, subject: str, cause: str, rate_hz: float) -> Finding:
    """The finding on one cause of rejection; the newest one has its details."""
    why = ""
    advice = ""
    if cause == source.cause:
        why = f": {source.refused}" if source.refused else ""
        advice = _unit_advice(source) or source.advice
    level = "wrong" if rate_hz > REJECTED_SHARE * max(source.rate_hz, 1.0) else "note"
    actual = f"{rate_hz:.0f} messages/s rejected as {cause}{why}"
    return Finding(level, subject, actual, "none", advice or what_to_do(cause))


def _two_publishers(cell: str, source: Source, contested: float) -> Finding:
    """The finding on an arm with a share of contested states."""
    subject = input_name("arm")
    evidence = Evidence(
        {"arm": msgspec.structs.replace(source, contested=contested)}, REJECTED_SHARE
    )
    explanation = explained(Reason.TWO_SOURCES, evidence)
    return wrong(
        subject,
        explanation.why.removeprefix(f"{subject}, "),
        f"one publisher of {key(cell, KEYS['arm'])}",
        explanation.what_to_do,
    )


def _unit_advice(source: Source) -> str:
    """The remedy if the rejected samples seem to be in another unit; empty otherwise."""
    if source.unit and source.cause in ("", word(Cause.OUT_OF_RANGE)):
        return unit_advice(source.unit)
    return ""


def _driver(before: Status, now: Status) -> Finding:
    if "arm" not in now.sources:
        return Finding("note", "arm", "assumed, not measured", "", what_to_do(Condition.NO_ARM))
    commands = key(now.cell, "joints/command")
    heard = before.command_heard and now.command_heard
    actual = f"{'somebody' if heard else 'nobody'} listens to {commands}"
    return judged(heard, "arm's driver", actual, "a driver", what_to_do(Condition.NO_DRIVER))


def _calibration(seen: Sequence[Status]) -> Iterator[Finding]:
    """Hands that are below the table top all the time."""
    depths_m = {side: min(status.below_table_m.get(side, 0.0) for status in seen) for side in SIDES}
    if max(depths_m.values()) > MAX_BELOW_TABLE_M:
        depths = " and ".join(
            f"{SOURCE_NAMES[side]} {100 * depth_m:.0f} cm"
            for side, depth_m in depths_m.items()
            if depth_m > MAX_BELOW_TABLE_M
        )
        yield wrong(
            "calibration",
            f"below the table top: {depths}",
            "hands above the table",
            what_to_do(Condition.CALIBRATION_OFF),
        )


def _places(seen: Sequence[Status]) -> Iterator[Finding]:
    """Where the hands are, against where they were demonstrated."""
    now = seen[-1]
    boxes = now.demonstrated_m
    positions = {
        side: now.hands_m[side] for side in SIDES if side in boxes and now.sources[side].fresh
    }
    outside_m = {side: _outside(position_m, boxes[side]) for side, position_m in positions.items()}
    is_elsewhere = any(distance_m > OUTSIDE_M for distance_m in outside_m.values())
    if is_elsewhere and _is_y_up(seen):
        yield _axes_exchanged()

    is_exchanged = _are_exchanged(positions, boxes)
    advice = what_to_do(Condition.HANDS_EXCHANGED if is_exchanged else Condition.HAND_ELSEWHERE)
    for side, position_m in positions.items():
        yield judged(
            outside_m[side] <= OUTSIDE_M,
            f"{SOURCE_NAMES[side]}'s place",
            f"at {_point(position_m)} m, {outside_m[side]:.2f} m from where the skill knows it",
            " to ".join(map(_point, boxes[side])) + " m",
            _unit_advice(now.sources[side]) or advice,
        )


def _are_exchanged(
    positions: Mapping[str, Vector3], boxes: Mapping[str, tuple[Vector3, Vector3]]
) -> bool:
    """True if each hand is near the demonstrated box of the other one, and outside its own."""
    if len(positions) < len(SIDES):
        return False
    left, right = SIDES
    crossed_m = (_outside(positions[left], boxes[right]), _outside(positions[right], boxes[left]))
    direct_m = (_outside(positions[left], boxes[left]), _outside(positions[right], boxes[right]))
    return max(crossed_m) < OUTSIDE_M < min(direct_m)


def _axes_exchanged() -> Finding:
    """The finding on a tracker whose y points up."""
    pose = ", ".join(f"{number:g}" for number in Y_UP)
    return wrong(
        "tracker's axes",
        "z of the hands is constant while y changes like a height",
        "z up, as in frame base",
        f"{what_to_do(Condition.Y_UP)}: write base_from_tracker = [{pose}], with the position "
        "of the tracker's origin in base [m] as its first three numbers",
    )


def _deviation(now: Status) -> Iterator[Finding]:
    """Deviation of the hands from what the skill knows, if it is known."""
    if now.deviation_m is not None:
        yield judged(
            now.deviation_m <= now.threshold_m,
            "skill",
            f"hands deviate by {100 * now.deviation_m:.1f} cm from what it knows",
            f"up to {100 * now.threshold_m:.1f} cm",
            what_to_do("far_from_demonstrations"),
        )


def _is_y_up(seen: Sequence[Status]) -> bool:
    """True if y seems to be the hands' height: it changes while z does not."""
    positions_m = [
        status.hands_m for status in seen if all(side in status.hands_m for side in SIDES)
    ]
    heights = [[hands[side][1] for hands in positions_m] for side in SIDES]
    levels = [[hands[side][2] for hands in positions_m] for side in SIDES]
    return (
        bool(positions_m)
        and all(max(level) - min(level) < LEVEL_M for level in levels)
        and any(max(height) - min(height) > RAISED_M for height in heights)
        and abs(heights[0][0] - heights[1][0]) < 3 * RAISED_M
    )


def _machine(before: Status, now: Status) -> Iterator[Finding]:
    missed = now.missed - before.missed
    ticks = max(now.tick - before.tick, 1)
    late_us = now.lateness_us.p99
    if now.busy:
        expected = "a machine that keeps time; on any other, arm, network and clocks seem to fail"
        yield Finding(
            "note", MACHINE, f"too busy: {now.busy}", expected, what_to_do(Condition.MACHINE_BUSY)
        )
    actual = (
        f"{now.rate_hz:.1f} Hz, {missed} of {ticks} deadlines missed, late by {late_us:.0f} µs "
        "(p99)"
    )
    most_us = max(LATE_US, 0.5e6 / max(now.rate_hz, 1.0))  # half of a period
    expected = f"less than {MAX_MISSED_SHARE:.0%} missed, and {most_us:.0f} µs"
    is_fine = missed <= MAX_MISSED_SHARE * ticks and late_us <= most_us
    yield judged(is_fine, "loop", actual, expected, what_to_do(Condition.MACHINE_BUSY))


def _privileges_and_recording(now: Status) -> Iterator[Finding]:
    actual = ("" if now.realtime else "not ") + "granted"
    expected = "SCHED_FIFO for the daemon's user"
    yield judged(now.realtime, "real time", actual, expected, what_to_do(Condition.NO_REAL_TIME))
    actual = ("" if now.memory_locked else "not ") + "locked"
    expected = "memory that is not paged out"
    yield judged(now.memory_locked, "memory", actual, expected, what_to_do(Condition.NOT_LOCKED))
    scribe = now.scribe
    state = scribe.get("state", "off")
    lost = scribe.get("lost", 0)
    if state == "off":
        yield Finding("note", "recording", "off", "", what_to_do(Condition.NOT_RECORDED))
        return
    actual = "; ".join([f"{state}, {lost} ticks lost", *(scribe.get("errors") or ())])
    is_fine = state != "interrupted" and not lost
    yield judged(
        is_fine, "recording", actual, "recording, none lost", what_to_do(Condition.TICKS_LOST)
    )
    if scribe.get("free_mb") is not None:
        yield _disk(scribe)


def _disk(scribe: Mapping[str, Any]) -> Finding:
    """Free space for recordings, and the time until it is full."""
    free_mb = scribe["free_mb"]
    full_h = hours_until_full(scribe)
    expected = f"more than {FREE_MB / 1000:g} GB, and {DISK_LASTS_H:g} h"
    is_fine = free_mb > FREE_MB and (full_h is None or full_h > DISK_LASTS_H)
    return judged(is_fine, "disk", disk(scribe), expected, what_to_do(Condition.DISK_SHORT))


def _outside(at: Vector3, box: tuple[Vector3, Vector3]) -> float:
    """Distance of a point from a box [m]; 0 inside."""
    gaps = (max(low - v, 0.0, v - high) for v, low, high in zip(at, *box, strict=True))
    return float(sum(gap * gap for gap in gaps) ** 0.5)


def _point(values: Vector3) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*values)
