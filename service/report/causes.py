"""What led to a hold or a fault, in words, from what was recorded before it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from service.contract.records import SIDES, Cause, Flag, Mode, Reason
from service.core.arm.arm import Arm
from service.core.frame import Vector
from service.report.columns import Columns, Measured

BEFORE_S = 1.0  # that is looked at
NOTICED_RAD = 0.02  # a joint farther than this from its command has begun to leave it
LATE_US = 1000.0  # a tick that began later is told of


def why_held(columns: Columns, begin: int, end: int) -> str:
    """What is to be said of a hold over frames [begin, end), besides its reason; may be empty."""
    frames = columns.frames[begin:end]
    reason = Reason(int(frames["reason"][0]))
    if reason in (Reason.NO_HANDS, Reason.STALE_HAND):
        return _unseen(columns, begin, end)
    if reason is Reason.FAR_FROM_DEMONSTRATIONS:
        return _far(columns, begin, 1000 * float(frames["deviation"].max()))
    if reason is Reason.TWO_SOURCES:
        return _rejected(columns, max(0, begin - _ticks(columns)), end)
    if reason is Reason.OPERATOR:
        return _asked(columns, begin, ("hold",))
    return _untold(columns, int(frames["tick"][0])) if reason is Reason.ARM_NOT_READY else ""


def what_led(columns: Columns, begin: int) -> list[str]:
    """Sentences on what was before the fault that begins at frame `begin`, the cause first."""
    if begin == 0:
        return ["it was at fault already when the recording began"]
    frame = columns.frames[begin]
    reason, tick = Reason(int(frame["reason"])), int(frame["tick"])
    before = max(0, begin - _ticks(columns))
    lines = list(_cause(columns, begin, reason, columns.measured.get(tick, [])))
    lines.append(_was_doing(columns, begin))
    lines += filter(None, (_rejected(columns, before, begin + 1), _unseen(columns, before, begin + 1, only_stale=True)))
    lines += filter(None, (_late(columns, int(columns.frames["tick"][before]), tick),))
    asked = _asked(columns, begin, ("hold", "resume", "reset"))
    return [*lines, *([asked] if asked else [])]


def _cause(columns: Columns, begin: int, reason: Reason, measured: list[Measured]) -> Iterator[str]:
    settings, frame = columns.recording.settings, columns.frames[begin]
    tick = int(frame["tick"])
    if reason is Reason.ARM_SILENT:
        silent = f"{(tick - measured[-1].tick) * 1000 * columns.period_s:.0f} ms" if measured else "more than 1 s"
        yield f"the arm's last joint state came {silent} before; {settings.arm.silent_ms:g} ms are allowed"
    if reason is Reason.ARM_ERROR and measured:
        yield _left_its_command(columns, begin, measured)
    if reason is Reason.TOOL_SPEED:
        max_speed = _measured_speed(columns, begin, measured)
        if max_speed > settings.tool.fault_speed:
            yield f"the tool was measured at {max_speed:.2f} m/s; {settings.tool.fault_speed:g} m/s are allowed"
        else:
            commanded = float(np.linalg.norm(np.diff(columns.frames["tool"][max(0, begin - 2) : begin + 1], axis=0)))
            yield f"the tool was commanded to move at {commanded / columns.period_s:.2f} m/s, more than allowed"
    if reason is Reason.SETPOINT:
        speed = np.linalg.norm(frame["setpoint_velocity"])
        yield f"the setpoint passed a bound of its own, at {speed:.2f} m/s"
    if reason is Reason.SERVICE:
        said = [order.text for order in columns.orders if order.kind == "fault" and order.tick <= tick]
        yield f"the service failed: {said[-1] if said else 'nothing was recorded of why'}"


def _left_its_command(columns: Columns, begin: int, measured: list[Measured]) -> str:
    names, settings = columns.recording.settings.joints.names, columns.recording.settings
    ticks = columns.frames["tick"][: begin + 1]
    rows = np.searchsorted(ticks, [one.tick for one in measured]).clip(max=begin)
    errors = np.array([one.positions for one in measured]) - columns.frames["joints"][rows]
    joint = int(np.abs(errors[-1]).argmax())
    off = np.abs(errors[:, joint]) > NOTICED_RAD
    first = len(off) - int(np.argmin(off[::-1])) if not off.all() else 0
    since_ms = (int(ticks[begin]) - measured[min(first, len(measured) - 1)].tick) * 1000 * columns.period_s
    return (
        f"{names[joint]} was measured {abs(errors[-1, joint]):.3f} rad from its command; "
        f"{settings.arm.fault_error_rad:g} rad are allowed. It left it by {NOTICED_RAD:g} rad {since_ms:.0f} ms before"
    )


def _measured_speed(columns: Columns, begin: int, measured: list[Measured]) -> float:
    """The tool's greatest speed as the arm told it before a fault [m/s]."""
    arm = Arm(columns.recording.settings, columns.recording.urdf)
    here = arm.at(columns.frames["joints"][begin]).jacobian[:3]
    return max((float(np.linalg.norm(here @ one.velocities)) for one in measured), default=0.0)


def _was_doing(columns: Columns, begin: int) -> str:
    frames = columns.frames
    before = frames[begin - 1]
    mode, reason = Mode(int(before["mode"])), Reason(int(before["reason"]))
    same = (frames["mode"][:begin] != mode) | (frames["reason"][:begin] != reason)
    since = begin - 1 - int(np.argmax(same[::-1])) if same.any() else 0
    lasts_s = (int(frames["tick"][begin]) - int(frames["tick"][since])) * columns.period_s
    doing = "it followed" if mode is Mode.FOLLOW else f"it held ({str(reason.name).lower()})"
    flags = ", ".join(str(flag.name).lower() for flag in Flag if int(before["flags"]) & flag)
    near = float(before["hand_distance"])
    distance = f", the nearest hand {100 * near:.0f} cm from the arm" if (before["hand_ages"] >= 0).any() else ""
    return f"before it: {doing} for {lasts_s:.2f} s{f' with {flags}' if flags else ''}{distance}"


def _unseen(columns: Columns, begin: int, end: int, *, only_stale: bool = False) -> str:
    """Which hands were not seen, and for how long."""
    ages, stale = columns.frames["hand_ages"][begin:end], columns.recording.settings.hands.stale_ms
    said = []
    for side, name in enumerate(SIDES):
        longest_ms = 1000 * columns.period_s * int(ages[:, side].max(initial=-1))
        if (ages[:, side] < 0).any() and not only_stale:
            said.append(f"the {name} hand had not been seen at all")
        elif longest_ms > stale:
            said.append(f"the {name} hand was not seen for {longest_ms / 1000:.2f} s")
    return "; ".join(said)


def _untold(columns: Columns, tick: int) -> str:
    """Of an arm not ready from a tick on: since when it had told nothing, if that is why."""
    if not columns.samples["joints/state"]:
        return "no joint state came at all"
    heard = columns.silent_since.get(tick)
    if heard is None:
        return ""
    if 1000 * (tick - heard + 1) * columns.period_s > columns.recording.settings.arm.silent_ms:
        return f"the arm fell silent: no joint states from {columns.seconds(heard):.1f} s on"
    return "joint states came, but not yet of an arm that rests within its limits"


def _rejected(columns: Columns, begin: int, end: int) -> str:
    """What was rejected over frames [begin, end)."""
    counts = columns.frames["rejected"]
    since = counts[begin] if begin else np.zeros_like(counts[0])
    more = (counts[end - 1].astype(np.int64) - since).tolist()
    said = ", ".join(f"{n} {str(cause.name).lower()}" for cause, n in zip(Cause, more, strict=False) if n > 0)
    return f"rejected in the second before: {said}" if said else ""


def _late(columns: Columns, first: int, last: int) -> str:
    timing = columns.timing
    within = timing[(timing["tick"] >= first) & (timing["tick"] <= last)]
    if not len(within):
        return ""
    missed, late = int(within["missed"][-1] - within["missed"][0]), float(within["lateness_us"].max())
    if not missed and late < LATE_US:
        return ""
    return f"in the second before {missed} deadlines were missed, and a tick was {late / 1000:.1f} ms late"


def _asked(columns: Columns, begin: int, kinds: tuple[str, ...]) -> str:
    """What was asked for at frame `begin` or within the second before."""
    last, said = int(columns.frames["tick"][begin]), []
    for one in columns.orders:
        ago_s = (last - one.tick) * columns.period_s
        if one.kind in kinds and 0.0 <= ago_s <= BEFORE_S:
            said.append(f"`{one.kind}` was asked for{f' {ago_s:.2f} s before' if ago_s > 0.005 else ''}")
    return ", ".join(said)


def _far(columns: Columns, begin: int, worst_mm: float) -> str:
    """How far off what is known it was, and what the skill in force at frame `begin` allows."""
    tick = int(columns.frames["tick"][begin])
    at = [skill for since, skill in columns.skills if since <= tick]
    if not at:
        return f"{worst_mm:.0f} mm off what is known"
    return f"{at[-1].model.measure} came to {worst_mm:.0f} mm; {1000 * at[-1].threshold:.0f} mm are allowed"


def _ticks(columns: Columns) -> int:
    return round(BEFORE_S / columns.period_s)


def speeds(positions: Vector, ticks: Vector, period_s: float) -> Vector:
    """Speed (T,) [m/s] of what is at positions (T, 3) [m] at ticks (T,)."""
    if len(positions) < 2:
        return np.zeros(len(positions))
    passed = np.maximum(np.diff(ticks), 1) * period_s
    found: Vector = np.linalg.norm(np.diff(positions, axis=0), axis=1) / passed
    return np.concatenate([found[:1], found])
