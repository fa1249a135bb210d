"""A report as tables, for the terminal, the page and CSV files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from thirdhand.contract.incidents import what_happened, what_to_do, word
from thirdhand.contract.printable import printable
from thirdhand.contract.records import Mode
from thirdhand.workbench.report.report import (
    Figure,
    Joint,
    Overview,
    Percentiles,
    Report,
    Span,
    differing_settings,
)

NONE = "-"
IN_A_ROW = {  # figures of a recording among many, with the heads of their columns
    "faults": "faults",
    "missing or damaged": "missing",
    "latency, median": "latency [ms]",
    "tool to target, median": "off [mm]",
    "closest approach": "near [mm]",
}
NOTHING_MISSING = "Nothing is missing in it."


class Table(NamedTuple):
    """A table: its name in files, its title, the heads of its columns with units in brackets, and
    rows of texts. Columns from `numbers` on hold numbers; with 0, those with a unit do.
    """

    name: str
    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: int = 1

    def is_number(self, column: int) -> bool:
        """True if a column holds numbers."""
        return column >= self.numbers if self.numbers else self.heads[column].endswith("]")


def tables(report: Report) -> Iterator[Table]:
    """The tables of one report; empty ones are left out."""
    return (table for table in (make(report) for make in TABLES) if table.rows)


def _missing(report: Report) -> Table:
    rows = tuple((line,) for line in report.lacks)
    return Table("missing", "Missing in the recording", ("what",), rows)


def _modes(report: Report) -> Table:
    return Table(
        "modes",
        "Modes of the arm",
        ("from [s]", "for [s]", "mode", "why"),
        tuple((_s(span.start_s), _s(span.lasts_s), span.doing, span.why) for span in report.spans),
        numbers=0,
    )


def _faults(report: Report) -> Table:
    return Table(
        "faults",
        "Faults",
        ("at [s]", "reason", "what happened, what preceded it, and what to do"),
        tuple(_fault(fault) for fault in report.faults),
        numbers=0,
    )


def _segments(report: Report) -> Table:
    return Table(
        "segments",
        "Segments of the task",
        ("from [s]", "for [s]", "segment", "probability [%]"),
        tuple(
            (
                _s(segment.start_s),
                _s(segment.lasts_s),
                segment.name,
                f"{100 * segment.probable:.0f}",
            )
            for segment in report.segments
        ),
        numbers=0,
    )


def _via_points(report: Report) -> Table:
    return Table(
        "via_points",
        "Via-points",
        (
            "via-point",
            "taught at [s]",
            "hands, nearest [cm]",
            "visits",
            "tool, nearest [mm]",
            "at the end of each visit [mm]",
        ),
        tuple(
            (
                point.name,
                _s(point.start_s),
                NONE if math.isinf(point.hands_m) else f"{100 * point.hands_m:.1f}",
                str(len(point.visits)),
                _mm(point.best_m),
                ", ".join(_mm(visit.settled_m) for visit in point.visits) or NONE,
            )
            for point in report.via_points
        ),
    )


def _timing(report: Report) -> Table:
    return Table(
        "times",
        "Timing and accuracy",
        ("what", "median", "99 %", "largest", "unit", "values"),
        tuple(
            (
                name,
                *(f"{value:.{digits}f}" for value in percentiles[:3]),
                unit,
                str(percentiles.samples),
            )
            for name, percentiles, unit, digits in _times(report)
            if percentiles is not None
        ),
    )


def _approach(report: Report) -> Table:
    rows: tuple[tuple[str, ...], ...] = ()
    if (near := report.approach) is not None:
        distance = f"{100 * near.distance_m:.1f}"
        rows = ((distance, _s(near.at_s), near.doing, f"{near.allowed_m_s:.2f}"),)
    return Table(
        "approach",
        "Closest approach of the arm to a hand",
        ("distance [cm]", "at [s]", "mode then", "allowed speed toward it [m/s]"),
        rows,
        numbers=0,
    )


def _limits(report: Report) -> Table:
    return Table(
        "limits",
        "Active limits",
        ("limit", "for [s]", "times [1]", "first at [s]", "what happened"),
        tuple(
            (
                limit.name,
                _s(limit.lasts_s),
                str(limit.times),
                _s(limit.first_s),
                what_happened(limit.name),
            )
            for limit in report.limits
        ),
        numbers=0,
    )


def _binding(report: Report) -> Table:
    followed_s = max(report.seconds(Mode.FOLLOW), report.columns.period_s)
    return Table(
        "binding",
        "What limited the tool while it followed",
        ("limit", "for [s]", "share [%]", "times", "first at [s]"),
        tuple(
            (
                limit.name,
                _s(limit.lasts_s),
                f"{100 * limit.lasts_s / followed_s:.1f}",
                str(limit.times),
                _s(limit.first_s),
            )
            for limit in report.binding
        ),
    )


def _tool_limits(report: Report) -> Table:
    return Table(
        "tool_limits",
        "What the arm can do where the tool was",
        ("direction", "speed [m/s]", "limited by", "acceleration [m/s²]", "limited by"),
        tuple(
            (
                where,
                f"{limit.speed:.2f}",
                limit.speed_joint or "[tool] max_speed",
                f"{limit.acceleration:.1f}",
                limit.acceleration_joint or "[tool] max_acceleration",
            )
            for where, limit in report.tool_limits.items()
        ),
        numbers=0,
    )


def _joints(report: Report) -> Table:
    return Table(
        "joints",
        "Use of the joints' limits",
        ("joint", "from a limit [rad]", "speed [% of limit]", "acceleration [% of limit]"),
        tuple(
            (
                joint.name,
                _margin(joint),
                f"{100 * joint.speed:.0f}",
                f"{100 * joint.acceleration:.0f}",
            )
            for joint in report.joints
        ),
    )


def _rejections(report: Report) -> Table:
    return Table(
        "rejections",
        "Rejected samples",
        ("cause", "count [samples]", "first at [s]", "what to do"),
        tuple(
            (
                rejection.cause,
                str(rejection.samples),
                _s(rejection.first_s),
                what_to_do(rejection.cause),
            )
            for rejection in report.rejections
        ),
        numbers=0,
    )


# the order of the tables in a report
TABLES = (
    _missing,
    _modes,
    _faults,
    _segments,
    _via_points,
    _timing,
    _approach,
    _limits,
    _binding,
    _tool_limits,
    _joints,
    _rejections,
)
NO_LIMIT_RAD = 1000.0  # limits of a continuous joint that are farther away do not matter


def _margin(joint: Joint) -> str:
    """Least distance of a joint from its limits, in rad, or in m if it is prismatic."""
    if joint.kind == "continuous" and joint.margin_rad > NO_LIMIT_RAD:
        return "no limit"
    return f"{joint.margin_rad:.2f}" + (" m" if joint.kind == "prismatic" else "")


def _fault(fault: Span) -> tuple[str, str, str]:
    sentences = (fault.why, *fault.before, fault.ended, f"what to do: {fault.remedy}")
    return _s(fault.start_s), word(fault.reason), "\n".join(sentences)


def _times(report: Report) -> Iterator[tuple[str, Percentiles | None, str, int]]:
    yield "hand stamped to command published", report.latency_ms, "ms", 2
    yield "tick later than its deadline", report.lateness_us, "µs", 0
    yield "work of a tick", report.work_us, "µs", 0
    yield "tool from its target, initial approach", report.initial_mm, "mm", 1
    yield "tool from its target, following", report.lag_mm, "mm", 1
    yield "distance of a stop", report.stop_mm, "mm", 1
    yield "distance of a stop beyond [people]", report.stop_excess_mm, "mm", 1


def verdict(report: Report) -> str:
    """The report in one sentence: share of following, number of stops, and the worst."""
    if not report.spans:
        return "There is nothing to report: the recording holds no tick."
    session = _Session.of(report)
    faults = len(report.faults)
    holds = _times_of(len(session.stops) - faults, "hold")
    worst = _worst_stop(session.stops) if session.stops else _worst_distance(report)
    lasts_s = session.end_s - max(session.begin_s, 0.0) if session.ended else report.lasts_s
    since = f", from {session.begin_s:.1f} s on" if session.waited else ""
    end = ""
    if session.ended:
        since = f", from {max(session.begin_s, 0.0):.1f} to {session.end_s:.1f} s"
        end = (
            f" It ended with {session.ended[0].doing}, "
            f"{report.lasts_s - session.ended[0].start_s:.1f} s before the end."
        )
    followed = 100 * report.seconds(Mode.FOLLOW) / lasts_s
    return (
        f"It followed {followed:.0f} % of {lasts_s:.1f} s{since}, with {holds} and "
        f"{_times_of(faults, 'fault')}; the worst was {worst}.{end}"
    )


class _Session(NamedTuple):
    """The part of a recording from the first to the last time that the arm followed: its begin and
    end [s], and the spans of holds before, stops within, and holds after it.
    """

    begin_s: float
    end_s: float
    waited: list[Span]
    stops: list[Span]
    ended: list[Span]

    @classmethod
    def of(cls, report: Report) -> Self:
        """The session in a report. Where the arm never followed, all spans are stops."""
        following = [span for span in report.spans if span.mode is Mode.FOLLOW]
        begin_s = following[0].start_s if following else -1.0
        end_s = following[-1].end_s if following else report.lasts_s
        waited = [
            span for span in report.spans if span.mode is Mode.HOLD and span.start_s < begin_s
        ]
        ended = [span for span in report.spans if span.mode is Mode.HOLD and span.start_s >= end_s]
        if report.spans[-1].mode is Mode.FAULT:
            ended = []  # a fault does not end a session
        stops = [
            span
            for span in report.spans
            if span.mode is not Mode.FOLLOW and span not in (*waited, *ended)
        ]
        return cls(begin_s, end_s, waited, stops, ended)


def _worst_stop(stops: Sequence[Span]) -> str:
    """The longest fault, or else the longest hold."""
    worst = max(stops, key=lambda span: (span.mode is Mode.FAULT, span.lasts_s))
    return f"{worst.doing}, for {worst.lasts_s:.1f} s from {worst.start_s:.1f} s on"


def _worst_distance(report: Report) -> str:
    """The largest distance [mm] of the tool from its target, and the initial approach."""
    largest = f"{report.lag_mm.largest:.0f} mm from the tool to its target" if report.lag_mm else ""
    if not report.initial_mm:
        return largest or NONE
    approach = (
        f"an initial approach of {report.initial_mm.largest:.0f} mm, which took "
        f"{report.initial_s:.1f} s"
    )
    return f"{largest}, after {approach}" if largest else f"{approach} and did not reach the target"


def _times_of(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'s' * (count != 1)}"


def summary(report: Report) -> list[str]:
    """The first lines of a report, beginning with the verdict."""
    lacks = len(report.lacks)
    hands = ", ".join(f"{side} {rate:.0f} a second" for side, rate in report.hands_hz.items())
    return [
        verdict(report),
        f"{report.begins}, {report.lasts_s:.1f} s, skill {report.skill}",
        f"Something is missing in it, {'once' if lacks == 1 else f'{lacks} times'}."
        if lacks
        else NOTHING_MISSING,
        f"Loop {report.rate_hz:.2f} Hz, {report.missed} deadlines missed. Hands: {hands}.",
        *([report.stop_setting] if report.stop_setting else []),
        *([f"{report.offer[0].upper()}{report.offer[1:]}."] if report.offer else []),
    ]


def comparison(reports: Sequence[Report]) -> Iterator[Table]:
    """Figures of two reports side by side, and settings that differ; for more reports, a row for
    each.
    """
    if len(reports) != 2:
        yield from overviews([report.overview() for report in reports])
        return
    first, other = reports
    names = names_of([first.path, other.path])
    yield side_by_side(names, first.overview().figures, other.overview().figures)
    settings = tuple(
        (name, _short(a), _short(b)) for name, a, b in differing_settings(first, other)
    )
    if settings:
        yield Table(
            "settings",
            "Settings, versions and machine that differ",
            ("what", *names),
            settings,
            numbers=9,
        )


def side_by_side(
    names: Sequence[str], one: Mapping[str, Figure], other: Mapping[str, Figure]
) -> Table:
    """Figures of two recordings and their differences, without those that are 0 in both."""
    rows = []
    for name, figure in {**other, **one}.items():
        values = [figures[name].value if name in figures else None for figures in (one, other)]
        if any(values):
            row = (_with_unit(figure), *(_value(figure, value) for value in values))
            rows.append((*row, _difference(figure, *values)))
    return Table("comparison", "Side by side", ("figure", *names, "difference"), tuple(rows))


def overviews(recordings: Sequence[Overview]) -> Iterator[Table]:
    """A row for each of many recordings, and totals by cell and week."""
    rows = []
    names = names_of([recording.path for recording in recordings])
    for name, recording in zip(names, recordings, strict=True):
        lasts_s = recording.value("duration")
        followed = _share(recording.value("follow"), lasts_s)
        held = f"{sum(recording.holds_s.values()):.1f}"
        figures = [recording.figures[key] for key in IN_A_ROW]
        others = [_value(figure, figure.value) for figure in figures]
        rows.append((name, f"{lasts_s:.1f}", followed, held, *others))
    heads = ("recording", "for [s]", "follow [%]", "hold [s]", *IN_A_ROW.values())
    yield Table("recordings", "Recordings", heads, tuple(rows))
    yield _totals(recordings)


def _totals(recordings: Sequence[Overview]) -> Table:
    """Time recorded and followed, faults, and holds by reason, for each cell and week."""
    groups: dict[tuple[str, str], list[Overview]] = {}
    for recording in recordings:
        groups.setdefault((recording.cell, recording.week), []).append(recording)
    rows = []
    for (cell, week), group in sorted(groups.items()):
        lasts_s = sum(recording.value("duration") for recording in group)
        followed_s = sum(recording.value("follow") for recording in group)
        faults = sum(recording.value("faults") for recording in group)
        held_s: Counter[str] = Counter()
        for recording in group:
            held_s.update(recording.holds_s)
        holds = ", ".join(f"{reason} {seconds:.1f} s" for reason, seconds in held_s.most_common())
        share = _share(followed_s, lasts_s)
        rows.append(
            (
                cell,
                week,
                str(len(group)),
                f"{lasts_s / 3600:.2f}",
                share,
                f"{faults:.0f}",
                holds or NONE,
            )
        )
    heads = (
        "cell",
        "week",
        "recordings [1]",
        "recorded [h]",
        "followed [%]",
        "faults [1]",
        "holds",
    )
    return Table("totals", "Totals by cell and week", heads, tuple(rows), numbers=0)


def every_figure(recordings: Sequence[Overview]) -> Table:
    """A row for each recording with all its figures."""
    figures = {
        name: figure for recording in recordings for name, figure in recording.figures.items()
    }
    rows = []
    for recording in recordings:
        values = (
            _value(
                figures[name], recording.figures[name].value if name in recording.figures else None
            )
            for name in figures
        )
        rows.append(
            (str(recording.path), recording.cell, recording.week, recording.begins, *values)
        )
    heads = ("recording", "cell", "week", "begins", *map(_with_unit, figures.values()))
    return Table("figures", "All figures", heads, tuple(rows), numbers=4)


def names_of(paths: Sequence[Path]) -> list[str]:
    """A unique name for each recording: that of its file, with a number if it is not the first."""
    counts: dict[str, int] = {}
    names = []
    for path in paths:
        stem = printable(path.stem)
        counts[stem] = counts.get(stem, 0) + 1
        names.append(stem if counts[stem] == 1 else f"{stem}-{counts[stem]}")
    return names


def _difference(figure: Figure, one: float | None, other: float | None) -> str:
    if one is None or other is None:
        return NONE
    text = f"{other - one:+.{figure.digits}f}"
    return "same" if float(text) == 0.0 else text


def _with_unit(figure: Figure) -> str:
    return f"{figure.name} [{figure.unit}]" if figure.unit else figure.name


def _value(figure: Figure, value: float | None) -> str:
    return NONE if value is None else f"{value:.{figure.digits}f}"


def _share(part_s: float, whole_s: float) -> str:
    return f"{100 * part_s / whole_s:.1f}" if whole_s else NONE


def _short(value: object) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _s(seconds: float) -> str:
    return f"{seconds:.2f}"


def _mm(metres: float | None) -> str:
    return NONE if metres is None else f"{1000 * metres:.1f}"
