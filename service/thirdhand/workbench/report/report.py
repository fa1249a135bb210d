"""The report on a recording: gaps, modes with their reasons, timing, distance from people, accuracy
at via-points, and limits that were active.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.incidents import word
from thirdhand.contract.records import SIDES, Cause, Flag, Mode, Reason
from thirdhand.contract.requests import ALONG_TASK, ANY_DIRECTION, ToolLimits
from thirdhand.core.frame import Records, Vector
from thirdhand.recordings.recording import Recording
from thirdhand.skills.corrections import offer_of
from thirdhand.workbench.report.causes import before, why
from thirdhand.workbench.report.columns import Columns, read, runs
from thirdhand.workbench.report.segments import segments
from thirdhand.workbench.report.stops import excess_m, measured_setting, measured_stops
from thirdhand.workbench.report.visits import via_point_visits

SHARES = (50, 99, 100)
JUDGED_POSTURES = 200  # limits of the tool are computed at this many postures, at most
DIRECTED_MPS = 0.02  # the direction of a slower tool is not judged
REACHED_MM = 20.0  # a tool this near has reached its first target


class Span(NamedTuple):
    """A time in one mode, since the first tick [s]. For a hold or a fault: why, and what to do; for
    a fault also what preceded it, and how it ended.
    """

    start_s: float
    lasts_s: float
    mode: Mode
    reason: Reason
    why: str = ""
    remedy: str = ""
    before: tuple[str, ...] = ()
    ended: str = ""

    @property
    def end_s(self) -> float:
        """End of the span [s]."""
        return self.start_s + self.lasts_s

    @property
    def doing(self) -> str:
        """Mode and reason as one term."""
        return ": ".join(filter(None, (word(self.mode), word(self.reason))))


class Percentiles(NamedTuple):
    """Median, 99th percentile, largest and number of some values."""

    p50: float
    p99: float
    largest: float
    samples: int

    @classmethod
    def of(cls, values: Vector) -> Percentiles | None:
        """The percentiles of values; None without any."""
        if not len(values):
            return None
        p50, p99, largest = np.percentile(values, SHARES).tolist()
        return cls(p50, p99, largest, len(values))


class Approach(NamedTuple):
    """The least distance between the arm and a hand [m], its time [s], mode and reason then, and
    the allowed speed toward the hand [m/s].
    """

    distance_m: float
    at_s: float
    doing: str
    allowed_m_s: float


class Limit(NamedTuple):
    """A limit that was active, or that bound the motion: its duration, number of times, and first
    time [s].
    """

    name: str
    lasts_s: float
    times: int
    first_s: float


class Joint(NamedTuple):
    """Margin of a joint to its limits: position [rad, m], and shares of speed and
    acceleration.
    """

    name: str
    margin_rad: float
    speed: float
    acceleration: float
    kind: str = "revolute"


class Rejection(NamedTuple):
    """Number of samples rejected for one cause, and the first time [s]."""

    cause: str
    samples: int
    first_s: float


class Figure(NamedTuple):
    """A number of a report, for comparison with another report."""

    name: str
    value: float | None
    unit: str
    digits: int


class Overview(NamedTuple):
    """One recording among many: its figures by their names, without its ticks."""

    path: Path
    cell: str
    week: str  # of its begin, by ISO 8601: 2026-W48
    begins: str
    figures: Mapping[str, Figure]

    def value(self, name: str) -> float:
        """A figure's value; 0 if it is not known."""
        return self.figures[name].value or 0.0

    @property
    def holds_s(self) -> dict[str, float]:
        """Time in holds [s] by reason, without those that did not occur."""
        start = f"{word(Mode.HOLD)}: "
        return {
            name.removeprefix(start): figure.value
            for name, figure in self.figures.items()
            if name.startswith(start) and figure.value
        }


class Report:
    """The report on one recording, made from its `columns`."""

    def __init__(self, columns: Columns) -> None:
        recording = columns.recording
        frames = columns.frames
        timing = columns.timing
        following = frames[frames["mode"] == Mode.FOLLOW]
        sent = frames[frames["commanded"] > 0]
        lasts_s = columns.seconds(int(frames["tick"][-1]) + 1) if len(frames) else 0.0
        begins = datetime.fromtimestamp(columns.start_ns / 1e9, tz=UTC)  # by the system clock
        self.path = recording.path
        self.columns = columns
        self.begins = (
            begins.strftime("%Y-%m-%d %H:%M:%S UTC") if len(frames) else "never: it holds no tick"
        )
        self.week = begins.strftime("%G-W%V") if len(frames) else "never"
        self.skill = columns.skills[-1].skill.name if columns.skills else "not understood"
        # of its last skill
        self.offer = offer_of(columns.skills[-1].skill) if columns.skills else ""
        self.lasts_s = lasts_s
        self.lacks = (*columns.gaps, *columns.remarks)  # gaps, damage, a cut, unreadable parts
        self.spans = tuple(_spans(columns))
        self.rate_hz = len(frames) / lasts_s if lasts_s else 0.0
        self.missed = int(timing["missed"][-1] - timing["missed"][0]) if len(timing) else 0
        self.lateness_us = Percentiles.of(timing["lateness_us"])
        self.work_us = Percentiles.of(timing["work_us"])
        self.latency_ms = Percentiles.of(timing["latency_us"][timing["latency_us"] > 0] / 1000.0)
        lag_mm = 1000 * np.linalg.norm(following["tool"] - following["target"], axis=1)
        reached = (
            int(np.argmax(lag_mm < REACHED_MM)) if (lag_mm < REACHED_MM).any() else len(lag_mm)
        )
        # tool to target, before it reached the first target
        self.initial_mm = Percentiles.of(lag_mm[:reached])
        self.initial_s = reached * columns.period_s
        engaging = following["flags"][reached:] & int(Flag.ENGAGING) > 0
        # tool to target afterwards, once it has engaged
        self.lag_mm = Percentiles.of(lag_mm[reached:][~engaging])
        self.approach = _approach(columns, self.spans)
        stops = measured_stops(columns)
        self.stop_mm = Percentiles.of(1000 * stops[:, 1])
        self.stop_excess_mm = Percentiles.of(1000 * excess_m(stops, columns.recording.settings))
        self.stop_setting = measured_setting(stops, columns.recording.settings)
        self.via_points = tuple(via_point_visits(columns))
        self.segments = tuple(segments(columns))
        self.limits = tuple(_limits(columns))
        self.binding = tuple(_binding(columns))
        self.tool_limits = _tool_limits(columns, following)
        self.joints = tuple(_joints(columns, sent)) if len(sent) else ()
        self.rejections = tuple(_rejections(columns))
        is_seen = (frames["hand_ages"] >= 0) & (frames["hand_ages"] < columns.stale_ticks)
        # time in which each hand was seen
        seen_s = np.maximum(is_seen.sum(axis=0), 1) * columns.period_s
        self.hands_hz = {
            side: columns.samples[f"hands/{side}"] / seen_s[i] for i, side in enumerate(SIDES)
        }

    @property
    def faults(self) -> tuple[Span, ...]:
        """The spans of mode fault."""
        return tuple(span for span in self.spans if span.mode is Mode.FAULT)

    def seconds(self, mode: Mode, reason: Reason | None = None) -> float:
        """Time in a mode [s], for one reason or for any."""
        return sum(s.lasts_s for s in self.spans if s.mode is mode and reason in (None, s.reason))

    def best_m(self, name: str) -> float | None:
        """The tool's least distance from a via-point of this name [m]; None without a visit."""
        return min(
            (p.best_m for p in self.via_points if p.name == name and p.best_m is not None),
            default=None,
        )

    def overview(self) -> Overview:
        """The figures of this recording, with its cell and week for a comparison of many."""
        cell = self.columns.recording.settings.cell
        return Overview(
            Path(self.path),
            cell,
            self.week,
            self.begins,
            {figure.name: figure for figure in self.figures()},
        )

    def figures(self) -> Iterator[Figure]:
        """The numbers for a comparison of recordings."""
        yield Figure("duration", self.lasts_s, "s", 1)
        yield Figure("missing or damaged", len(self.lacks), "times", 0)
        yield Figure("follow", self.seconds(Mode.FOLLOW), "s", 1)
        for reason, mode in itertools.product(Reason, (Mode.HOLD, Mode.FAULT)):
            yield Figure(f"{word(mode)}: {word(reason)}", self.seconds(mode, reason), "s", 1)
        yield Figure("faults", len(self.faults), "times", 0)
        yield Figure("rate", self.rate_hz, "Hz", 2)
        yield Figure("deadlines missed", self.missed, "", 0)
        yield from self._durations_and_distances()
        yield Figure("closest approach", self.approach and 1000 * self.approach.distance_m, "mm", 0)
        touched = {limit.name: limit.lasts_s for limit in self.limits}
        for flag in Flag:
            yield Figure(word(flag), touched.get(word(flag), 0.0), "s", 1)
        rejected = {rejection.cause: rejection.samples for rejection in self.rejections}
        for cause in Cause:
            yield Figure(f"rejected: {word(cause)}", rejected.get(word(cause), 0), "", 0)
        for name in dict.fromkeys(point.name for point in self.via_points):
            best = self.best_m(name)
            yield Figure(
                f"via-point {name}: nearest", None if best is None else 1000 * best, "mm", 1
            )

    def _durations_and_distances(self) -> Iterator[Figure]:
        """The percentiles of timing and accuracy; None where nothing was measured."""
        for name, percentiles, unit, digits in (
            ("latency", self.latency_ms, "ms", 2),
            ("lateness", self.lateness_us, "µs", 0),
            ("work of a tick", self.work_us, "µs", 0),
            ("tool to target, initial approach", self.initial_mm, "mm", 1),
            ("tool to target", self.lag_mm, "mm", 1),
        ):
            for share, value in zip(
                ("median", "99 %", "largest"), percentiles or (None,) * 3, strict=False
            ):
                yield Figure(f"{name}, {share}", value, unit, digits)


def overview(path: Path) -> Overview:
    """The overview of the recording in a file. Raises RecordingError."""
    return reported(path).overview()


def reported(path: str | Path, *, progress: Callable[[int], None] = lambda ticks: None) -> Report:
    """The report on the recording in a file. Raises RecordingError."""
    return Report(read(Recording.open(path), progress=progress))


def _spans(columns: Columns) -> Iterator[Span]:
    """The times in one mode and reason, in order."""
    frames = columns.frames
    times = columns.times
    period_s = columns.period_s
    pieces = np.zeros(len(frames), np.int64)
    pieces[columns.breaks] = 1
    for begin, end in runs((np.cumsum(pieces) * 256 + frames["mode"]) * 256 + frames["reason"]):
        mode = Mode(int(frames["mode"][begin]))
        reason = Reason(int(frames["reason"][begin]))
        whole = end == len(frames) or end in columns.breaks
        until = float(times[end - 1]) + period_s if whole else float(times[end])
        span = Span(
            float(times[begin]),
            until - float(times[begin]),
            mode,
            reason,
            *why(columns, begin, end),
        )
        if mode is Mode.FAULT:
            span = span._replace(before=tuple(before(columns, begin)), ended=_ended(columns, span))
        yield span


def _ended(columns: Columns, fault: Span) -> str:
    if fault.end_s > columns.times[-1]:
        return "not ended in this recording"
    resets = [columns.seconds(order.tick) for order in columns.orders if order.kind == "reset"]
    by = (
        "a `reset`"
        if any(abs(reset_s - fault.end_s) < 0.1 for reset_s in resets)
        else "a cause that is not recorded"
    )
    return f"ended by {by} after {fault.lasts_s:.1f} s"


def _approach(columns: Columns, spans: tuple[Span, ...]) -> Approach | None:
    """The closest approach of a hand that was seen; None without any."""
    frames = columns.frames
    ages = frames["hand_ages"]
    seen_rows = np.flatnonzero(((ages >= 0) & (ages < columns.stale_ticks)).any(axis=1))
    if not len(seen_rows):
        return None
    row = int(seen_rows[frames["hand_distance"][seen_rows].argmin()])
    at_s = float(columns.times[row])
    doing = next(span.doing for span in reversed(spans) if span.start_s <= at_s)
    return Approach(
        float(frames["hand_distance"][row]), at_s, doing, float(frames["hand_limit"][row])
    )


def _limits(columns: Columns) -> Iterator[Limit]:
    for flag in Flag:
        raised = (columns.frames["flags"] & int(flag)) > 0
        if raised.any():
            yield _limit(columns, word(flag), raised)


def _limit(columns: Columns, name: str, met: NDArray[np.bool_]) -> Limit:
    """A limit that was met at some frames (T,)."""
    begins = [begin for begin, _ in runs(met) if met[begin]]
    return Limit(
        name, float(met.sum()) * columns.period_s, len(begins), float(columns.times[begins[0]])
    )


def _binding(columns: Columns) -> Iterator[Limit]:
    """The limits that the motion met, the one that bound longest first."""
    # its import is slow, and other parts of this module need none
    from thirdhand.core.tool_limits import binding

    limits = [
        _limit(columns, *entry) for entry in binding(columns.recording.settings, columns.frames)
    ]
    yield from sorted(limits, key=lambda limit: -limit.lasts_s)


def _tool_limits(columns: Columns, following: Records) -> dict[str, ToolLimits]:
    """Limits of the tool at the postures in which the arm followed, and along its motion there."""
    from thirdhand.core.arm.stage import ArmStage
    from thirdhand.core.tool_limits import tool_limits

    speed = np.linalg.norm(following["setpoint_velocity"], axis=1)
    moving = following[speed > DIRECTED_MPS]
    moving = moving[:: -(-len(moving) // JUDGED_POSTURES) or 1]
    if not len(moving) or not columns.recording.urdf:
        return {}
    settings = columns.recording.settings
    velocities = moving["setpoint_velocity"]
    arm = ArmStage(settings, columns.recording.urdf)
    directions = velocities / np.linalg.norm(velocities, axis=1)[:, None]
    return {
        ANY_DIRECTION: tool_limits(arm, settings, moving["joints"]),
        ALONG_TASK: tool_limits(arm, settings, moving["joints"], directions),
    }


def _joints(columns: Columns, sent: Any) -> Iterator[Joint]:
    limits = columns.recording.settings.joints
    low = sent["joints"] - np.array(limits.lower)
    high = np.array(limits.upper) - sent["joints"]
    margin = np.minimum(low, high).min(axis=0)
    speed = np.abs(sent["joint_velocities"]).max(axis=0) / np.array(limits.velocity)
    acceleration = np.abs(sent["joint_accelerations"]).max(axis=0) / np.array(limits.acceleration)
    values = margin.tolist(), speed.tolist(), acceleration.tolist()
    yield from map(Joint, limits.names, *values, limits.every_kind)


def _rejections(columns: Columns) -> Iterator[Rejection]:
    counts = columns.frames["rejected"].astype(np.int64)
    if not len(counts):
        return
    for cause in Cause:
        more = counts[:, cause] - counts[0, cause]
        if more[-1]:
            yield Rejection(
                word(cause), int(more[-1]), float(columns.times[int(np.argmax(more > 0))])
            )


def differing_settings(one: Report, other: Report) -> list[tuple[str, Any, Any]]:
    """Names and values of the settings, versions and machine that differ between two recordings."""
    a, b = (
        flat(msgspec.to_builtins(r.columns.recording.settings))
        | {f"made with {name}": value for name, value in r.columns.recording.metadata.items()}
        | {"skill": r.skill}
        for r in (one, other)
    )
    return differing(a, b)


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Names and both values of differing entries."""
    values = ((name, a.get(name, "unknown"), b.get(name, "unknown")) for name in sorted({*a, *b}))
    return [entry for entry in values if entry[1] != entry[2]]


def flat(value: Any, path: str = "") -> dict[str, Any]:
    """Values in nested tables, by their path with dots."""
    if isinstance(value, dict):
        inner = (flat(inside, f"{path}.{name}" if path else name) for name, inside in value.items())
        return {name: leaf for table in inner for name, leaf in table.items()}
    return {path: value}


def why_missed(found: Report, name: str, *, begun_s: float, start_s: float, end_s: float) -> str:
    """A sentence on the cause that kept the tool from a via-point between two times [s], which
    count from `begun_s` of the recording.
    """
    begin_s = begun_s + start_s
    until_s = begun_s + end_s
    stops = [
        s
        for s in found.spans
        if s.mode is not Mode.FOLLOW and s.start_s < until_s and s.end_s > begin_s
    ]
    if stops:
        worst = max(stops, key=lambda span: (span.mode is Mode.FAULT, span.lasts_s))
        outcome = "was at fault" if worst.mode is Mode.FAULT else "held"
        at_s = worst.start_s - begun_s
        since = f"from {at_s:.1f} s on" if at_s > 0 else "from before the script began"
        return (
            f"the arm {outcome} ({word(worst.reason)}) {since}, for {worst.lasts_s:.1f} s: "
            f"{worst.why}"
        )
    hands_m = [point.hands_m for point in found.via_points if point.name == name]
    if not hands_m:
        return f"no via-point {name!r} was taught"
    if best := found.best_m(name):
        return (
            f"with the hands where {name!r} was taught, the tool came no nearer than "
            f"{1000 * best:.0f} mm"
        )
    return f"the hands came no nearer than {100 * min(hands_m):.0f} cm to where {name!r} was taught"
