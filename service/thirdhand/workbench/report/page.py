"""A report as one page with plots; it fetches nothing, so it can be stored and sent."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thirdhand.contract.printable import printable
from thirdhand.contract.records import SIDES, Mode
from thirdhand.core.frame import Vector
from thirdhand.settings import palette
from thirdhand.workbench.report.report import Report
from thirdhand.workbench.report.tables import Table, comparison, names_of, summary, tables

LEFT_PEN, RIGHT_PEN, TOOL_PEN, TARGET_PEN = map(
    palette.written, (palette.LEFT, palette.RIGHT, palette.TOOL, palette.TARGET)
)
NEAREST_PEN, OFF_PEN, VIA_POINT_PEN = map(
    palette.written, (palette.NEAREST, palette.OFF, palette.VIA_POINT)
)
LATENCY_PEN, WORK_PEN, LATENESS_PEN = map(
    palette.written, (palette.LATENCY, palette.WORK, palette.LATENESS)
)
MODE_COLOURS = {mode: palette.written(colour) for mode, colour in palette.BY_MODE.items()}
LETTER_SHARE = 0.011  # width of a letter / width of a plot
POINTS = 1500  # most points of a curve
# smaller values are not shown
LEAST_US = 10.0
LEAST_MM = 0.1
SHOWN_PERCENT = 99.5  # an axis shows this share of the values; a note names the others
TINT = 0.08  # opacity of the background where the arm does not follow; gives palette.PAPER
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; background: #fff; max-width: 62rem;
       margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.2rem; margin-top: 2.5rem; border-top: 1px solid #ccc;
     padding-top: 1rem; overflow-wrap: anywhere } h3 { font-size: 1rem; margin: 1.6rem 0 .4rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { text-align: left; padding: .15rem 1.1rem .15rem 0; border-bottom: 1px solid #e5e5e5;
         vertical-align: top; white-space: pre-line; overflow-wrap: anywhere }
td:first-child { overflow-wrap: break-word }
th { font-weight: 600; color: #555 } .number { text-align: right; white-space: nowrap }
svg { max-width: 100%; height: auto } p { margin: .3rem 0 }
"""


@mpl.rc_context({"text.parse_math": False})  # names with dollar signs are not formulas
def page(reports: Sequence[Report], *, progress: Callable[[int], None] = lambda count: None) -> str:
    """The page as HTML."""
    names = names_of([report.path for report in reports])
    title = f"Report: {', '.join(names)}"
    parts = [f"<h1>{escape(title)}</h1>"]
    if len(reports) > 1:
        parts += [_table(table) for table in comparison(reports)]
    for i, (name, report) in enumerate(zip(names, reports, strict=True)):
        parts.append(f"<h2>{escape(name)}</h2>")
        verdict, *lines = summary(report)
        parts.append(f"<p><strong>{escape(verdict)}</strong></p>")
        parts += [f"<p>{escape(line)}</p>" for line in (printable(str(report.path)), *lines)]
        if len(report.columns.frames):
            parts += [
                _svg(_over_time(report), f"{name}-time-"),
                _svg(_from_above(report), f"{name}-above-"),
            ]
        parts += [_table(table) for table in tables(report)]
        progress(i + 1)
    return _document(title, parts)


def page_of_many(shown: Sequence[Table]) -> str:
    """The page on many recordings, as HTML, with the tables of their overviews."""
    title = f"Report on {len(shown[0].rows)} recordings"
    return _document(title, [f"<h1>{title}</h1>", *map(_table, shown)])


def _document(title: str, parts: Sequence[str]) -> str:
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta '
        f'charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{STYLE}</style>\n</head>\n'
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _table(table: Table) -> str:
    classes = [' class="number"' if table.is_number(i) else "" for i in range(len(table.heads))]
    heads = "".join(
        f"<th{c}>{escape(head)}</th>" for c, head in zip(classes, table.heads, strict=True)
    )
    rows = (
        "<tr>"
        + "".join(f"<td{c}>{escape(cell)}</td>" for c, cell in zip(classes, row, strict=True))
        + "</tr>"
        for row in table.rows
    )
    return (
        f"<h3>{escape(table.title)}</h3>\n<table>\n<tr>{heads}</tr>\n"
        + "\n".join(rows)
        + "\n</table>"
    )


def _svg(figure: Figure, salt: str) -> str:
    """The figure as an element of the page; `salt` makes its identifiers unique."""
    text = io.StringIO()
    with mpl.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": salt, "font.family": "sans-serif"}
    ):
        figure.savefig(text, format="svg", metadata={"Date": None})
    drawn = text.getvalue()
    return drawn[drawn.index("<svg") :]


def _draw_modes(report: Report, modes: Axes, others: Sequence[Axes]) -> None:
    """Draw the modes as bands, named where there is room; all but following shade other axes."""
    for span in report.spans:
        colour = MODE_COLOURS[span.mode]
        end_s = span.start_s + span.lasts_s
        modes.axvspan(span.start_s, end_s, color=colour, lw=0)
        for axes in others if span.mode is not Mode.FOLLOW else ():
            axes.axvspan(span.start_s, end_s, color=colour, alpha=TINT, lw=0)
        if span.lasts_s > LETTER_SHARE * max(map(len, span.doing.split(": "))) * report.lasts_s:
            modes.text(
                span.start_s + span.lasts_s / 2,
                0.5,
                span.doing.replace(": ", "\n"),
                ha="center",
                va="center",
                color="white",
                fontsize=8,
            )
    modes.set(yticks=[], ylim=(0, 1), xlim=(0, max(report.lasts_s, 1e-3)))
    for mode, colour in MODE_COLOURS.items():
        modes.plot([], [], color=colour, lw=6, label=str(mode.name).lower())


def _draw_errors(report: Report, errors: Axes, doubt: Axes) -> None:
    """Draw the tool's distance from its target and the gate's measure over time; and the
    probability of a target that is off.
    """
    frames = report.columns.frames
    times = report.columns.times
    following = frames["mode"] == Mode.FOLLOW
    lag = 1000 * np.linalg.norm(frames["tool"] - frames["target"], axis=1)
    _curve(errors, times, np.where(following, lag, np.nan), TOOL_PEN, "tool from its target")
    measures = dict.fromkeys(skill.model.measure for _, skill in report.columns.skills)
    gate_m = np.where(frames["gate_m"] > 0, 1000 * frames["gate_m"], np.nan)
    _curve(errors, times, gate_m, OFF_PEN, " / ".join(measures))
    errors.set(
        ylabel="error, deviation [mm]",
        yscale="log",
        ylim=(LEAST_MM, max(errors.get_ylim()[1], 10 * LEAST_MM)),
    )
    errors.yaxis.set_major_formatter("{x:g}")

    predicted = following | (frames["error_probability"] > 0)
    probability = np.where(predicted, 100 * frames["error_probability"], np.nan)
    _curve(doubt, times, probability, TARGET_PEN, "target off by more than 10 cm")
    doubt.set(ylabel="probability [%]", ylim=(0, 100))


def _draw_speeds(report: Report, axes: Axes) -> None:
    """Draw the speeds of the hands and of the tool's setpoint over time."""
    frames = report.columns.frames
    times = report.columns.times
    speeds = np.linalg.norm(frames["hand_velocities"], axis=2)
    for side, colour, speed in zip(SIDES, (LEFT_PEN, RIGHT_PEN), speeds.T, strict=True):
        _curve(axes, times, speed, colour, f"{side} hand")
    setpoint_speed = np.linalg.norm(frames["setpoint_velocity"], axis=1)
    _curve(axes, times, setpoint_speed, TOOL_PEN, "tool's setpoint")
    axes.set(ylabel="speed [m/s]", ylim=(0, None))
    _bounded(axes, speeds)


def _draw_timing(report: Report, axes: Axes) -> None:
    """Draw the latency, the work and the lateness of ticks over time."""
    timing = report.columns.timing
    tick_s = (timing["tick"] - report.columns.frames["tick"][0]) * report.columns.period_s
    for name, colour, label in (
        ("latency_us", LATENCY_PEN, "hand stamped to command published"),
        ("work_us", WORK_PEN, "work of a tick"),
        ("lateness_us", LATENESS_PEN, "later than its deadline"),
    ):
        durations_us = np.where(timing[name] >= LEAST_US, timing[name], np.nan)
        axes.plot(*thinned(tick_s, durations_us), ".", color=colour, ms=2, label=label)
    axes.set(yscale="log", ylabel="time [µs]")
    axes.yaxis.set_major_formatter("{x:g}")


def _over_time(report: Report) -> Figure:
    """Modes, distances, errors, speeds and timing over time, one above the other."""
    frames = report.columns.frames
    times = report.columns.times
    timing = report.columns.timing
    rows = 6 if len(timing) else 5
    figure = Figure(figsize=(10.5, 2 * rows), layout="constrained")
    modes, *others = figure.subplots(rows, 1, sharex=True, height_ratios=(0.35, *(1,) * (rows - 1)))
    near, errors, doubt, speed = others[:4]
    _draw_modes(report, modes, others)

    is_seen = (frames["hand_ages"] >= 0).any(axis=1)
    _curve(
        near,
        times,
        np.where(is_seen, 100 * frames["hand_distance"], np.nan),
        NEAREST_PEN,
        "nearest hand to the arm",
    )
    near.set(ylabel="distance [cm]", ylim=(0, None))

    _draw_errors(report, errors, doubt)
    _draw_speeds(report, speed)
    if len(timing):
        _draw_timing(report, others[4])
    others[-1].set(xlabel="time since the first tick [s]")
    modes.set_ylabel("mode", rotation=0, ha="right", va="center")
    figure.align_ylabels()
    for axes in (modes, *others):
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _from_above(report: Report) -> Figure:
    """Hands, tool and via-points seen from above, the arm at the left."""
    frames = report.columns.frames
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.subplots()
    for side, colour in zip(SIDES, (LEFT_PEN, RIGHT_PEN), strict=True):
        number = SIDES.index(side)
        path = frames["hands"][frames["hand_ages"][:, number] >= 0, number]
        _path(axes, path, colour, f"{side} hand")
    _path(axes, frames["tool"][frames["commanded"] > 0], TOOL_PEN, "tool")
    points = [point for _, skill in report.columns.skills for point in skill.via_points]
    for point in sorted(dict.fromkeys(points), key=lambda point: point.name):
        x, y, _ = point.tool
        axes.plot(x, y, "D", color=VIA_POINT_PEN, ms=5)
        axes.annotate(point.name, (x, y), xytext=(6, 6), textcoords="offset points", fontsize=8)
    axes.plot(0, 0, "s", color=VIA_POINT_PEN, ms=10)
    axes.annotate(
        "arm", (0, 0), xytext=(9, -4), textcoords="offset points", fontsize=8, color="0.4"
    )
    axes.set(xlabel="x [m]", ylabel="y [m]", title="From above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _curve(axes: Any, x: Vector, y: Vector, colour: str, label: str) -> None:
    axes.plot(*thinned(x, y), color=colour, lw=1, label=label)


def _path(axes: Any, points: Vector, colour: str, label: str) -> None:
    every = max(1, len(points) // POINTS)
    axes.plot(points[::every, 0], points[::every, 1], color=colour, lw=1, label=label)


def _bounded(axes: Any, values: Vector) -> None:
    """Limit the axis, so that a few outliers do not flatten the other values."""
    usual = np.percentile(values, SHOWN_PERCENT)
    largest = values.max(initial=0.0)
    if largest > 2 * usual > 0:
        axes.set_ylim(0, 1.2 * usual)
        axes.set_title(f"up to {largest:.1f}, cut off", fontsize=8, loc="right")


def thinned(x: Vector, y: Vector, *, points: int = POINTS) -> tuple[Vector, Vector]:
    """The curve with at most this number of points: the least and greatest value of each interval,
    in their order. Intervals without values are gaps.
    """
    if len(x) <= points:
        return x, y
    edges = np.linspace(0, len(x), points // 2 + 1).astype(int)
    rows = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        valid = np.flatnonzero(~np.isnan(y[begin:end])) + begin
        rows += (
            sorted((int(valid[y[valid].argmin()]), int(valid[y[valid].argmax()])))
            if len(valid)
            else [begin, begin]
        )
    return x[rows], y[rows]
