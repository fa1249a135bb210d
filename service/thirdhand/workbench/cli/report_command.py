"""`thirdhand report`: a report on recordings, on the terminal, as a page or as tables in files."""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

from thirdhand.cli.usage import UsageError, check_writable
from thirdhand.contract.printable import printable
from thirdhand.contract.records import Mode
from thirdhand.process.progress import progress
from thirdhand.recordings.recording import Recording
from thirdhand.settings.whole_file import whole
from thirdhand.workbench.cli.many_files import of_each
from thirdhand.workbench.report.columns import KEPT, Columns
from thirdhand.workbench.report.report import Report, overview, reported
from thirdhand.workbench.report.tables import (
    Table,
    comparison,
    every_figure,
    names_of,
    overviews,
    summary,
    tables,
)

BAR = 72  # [characters] length of the line that shows the modes over time
MARKS = {Mode.HOLD: ("▒", "yellow"), Mode.FOLLOW: ("█", "green"), Mode.FAULT: ("X", "red")}
MANY = 10  # of more recordings, each has a row in a table and no report of its own
MOST_ROWS = 40  # a table on a terminal has at most this many rows
PLAIN_WIDTH = 120  # [characters] width of tables that are not printed on a terminal


def report(args: argparse.Namespace) -> int:
    """Report on recordings; exit code 0 for any content, 1 if a file cannot be read."""
    _check_outputs(args)
    if len(args.files) > MANY and not args.lerobot:
        return _report_many(args)
    reports = [report for _, report in of_each(args, "reading", reported, alone=_reported)]
    if reports:
        _report_each(args, reports)
    return 0 if len(reports) == len(args.files) else 1


def _check_outputs(args: argparse.Namespace) -> None:
    """Raise UsageError for an output that cannot be written, before anything is read."""
    if args.html:
        check_writable(args.html)
    if args.csv and args.csv.exists() and not args.csv.is_dir():
        raise UsageError(f"--csv {args.csv} is a file; a folder needed")
    if args.lerobot and args.lerobot.exists():
        raise UsageError(f"--lerobot {args.lerobot} exists already; a new folder needed")


def _report_each(args: argparse.Namespace, reports: Sequence[Report]) -> None:
    """Print the reports and their comparison, and write the outputs."""
    console = plain_console()
    for report in reports:
        _print(console, report)
    if len(reports) > 1:
        for table in comparison(reports):
            print_table(console, table)
    if args.csv:
        write_csv(reports, args.csv)
        _print_line(console, f"tables in {args.csv}")
    if args.lerobot:
        _print_line(console, _write_lerobot(args, [report.columns for report in reports]))
    if args.html:
        _write_page(args.html, reports)
        _print_line(console, f"page {args.html}")


def _write_lerobot(args: argparse.Namespace, recordings: Sequence[Columns]) -> str:
    """Write the data set; return a line with its size. Its task is named after the skills, unless
    the arguments name it.
    """
    from thirdhand.workbench.report import lerobot

    skills = dict.fromkeys(
        change.skill.name for recording in recordings for change in recording.skills
    )
    with whole(args.lerobot) as part:
        written = lerobot.write(recordings, part, fps=args.fps, task=args.task or ", ".join(skills))
    line = f"data set {args.lerobot}: {written.episodes} episodes, {written.rows} rows"
    if written.constant_closure is None:
        return line
    return f"{line}, without action.gripper, which is always {written.constant_closure:g}"


def _write_page(path: Path, reports: Sequence[Report]) -> None:
    from thirdhand.workbench.report.page import page  # its import is slow

    with (
        progress("drawing", unit="recordings", total=len(reports)) as done,
        whole(path) as part,
    ):
        part.write_text(page(reports, progress=done), encoding="utf-8")


def _report_many(args: argparse.Namespace) -> int:
    """Report on many recordings: a row for each, and totals."""
    recordings = [recording for _, recording in of_each(args, "reading", overview)]
    if not recordings:
        return 1
    console = plain_console()
    overview_tables = [*overviews(recordings)]
    for table in overview_tables:
        print_table(console, table)
    if args.csv:
        args.csv.mkdir(parents=True, exist_ok=True)
        for table in (*overview_tables, every_figure(recordings)):
            _write(args.csv / f"{table.name}.csv", table)
        _print_line(console, f"tables in {args.csv}")
    if args.html:
        from thirdhand.workbench.report.page import page_of_many  # its import is slow

        with whole(args.html) as part:
            part.write_text(page_of_many(overview_tables), encoding="utf-8")
        _print_line(console, f"page {args.html}")
    return 0 if len(recordings) == len(args.files) else 1


def _print_line(console: Console, text: str) -> None:
    console.print(Text(printable(text)))


def _reported(path: Path) -> Report:
    with progress(f"reading {path.name}", total=Recording.open(path).ticks()) as done:
        return reported(path, progress=done)


def plain_console() -> Console:
    """The console for tables, with a fixed width if it is not a terminal."""
    console = Console(highlight=False, soft_wrap=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def _print(console: Console, one: Report) -> None:
    verdict, *lines = summary(one)
    console.print(Text(verdict, style="bold"), soft_wrap=True)
    for line in (printable(str(one.path)), *lines):
        console.print(Text(line))
    console.print(_bar(one))
    for table in tables(one):
        print_table(console, table)


def _bar(one: Report) -> Text:
    """A line that shows the modes over time, and its legend."""
    bar = Text()
    cells = [one.lasts_s * (i + 0.5) / BAR for i in range(BAR)]
    for at_s in cells if one.lasts_s else ():
        modes = [
            span.mode for span in one.spans if span.start_s <= at_s < span.start_s + span.lasts_s
        ]
        mark, style = MARKS[modes[0]] if modes else (" ", "")
        bar.append(mark, style)
    legend_modes = {span.mode for span in one.spans}
    for mode, (mark, style) in MARKS.items():
        if mode in legend_modes:
            bar.append("  ").append(mark, style).append(
                f" {str(mode.name).lower()} {one.seconds(mode):.1f} s"
            )
    return bar


def print_table(console: Console, table: Table) -> None:
    """Print a table with its title after an empty line."""
    drawn = RichTable(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for i, head in enumerate(table.heads):
        drawn.add_column(
            escape(head), justify="right" if table.is_number(i) else "left", overflow="fold"
        )
    for row in table.rows[:MOST_ROWS]:
        drawn.add_row(*map(escape, row))
    console.print()
    console.print(Text(table.title, style="bold"))
    console.print(drawn)
    if len(table.rows) > MOST_ROWS:
        console.print(
            f"... and {len(table.rows) - MOST_ROWS} more rows; --csv and --html write all"
        )


def write_csv(reports: Sequence[Report], folder: Path) -> None:
    """Write each table of a report, and every tick in `ticks.csv`, to a folder with the report's
    name, and for several reports a comparison beside these folders.
    """
    for name, report in zip(names_of([report.path for report in reports]), reports, strict=True):
        inside = folder / name
        inside.mkdir(parents=True, exist_ok=True)
        for table in tables(report):
            _write(inside / f"{table.name}.csv", table)
        _write_ticks(inside / "ticks.csv", report)
    if len(reports) > 1:
        for table in comparison(reports):
            _write(folder / f"{table.name}.csv", table)


def _write(path: Path, table: Table) -> None:
    with whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.heads)
        writer.writerows(table.rows)


def _write_ticks(path: Path, one: Report) -> None:
    """Write every field of the report's frames in SI units, with a row for each tick."""
    frames = one.columns.frames
    heads = ["time_s"]
    formats = ["%.4f"]
    columns = [one.columns.times[:, None]]
    for name in KEPT:
        count = math.prod(frames.dtype[name].shape)
        column = frames[name].reshape(len(frames), count)
        is_whole = np.issubdtype(column.dtype, np.integer)
        heads += [name] if count == 1 else [f"{name}[{i}]" for i in range(count)]
        formats += ["%d" if is_whole else "%.7g"] * count
        columns.append(column.astype(np.float64))
    with whole(path) as part:
        np.savetxt(
            part,
            np.hstack(columns),
            fmt=formats,
            delimiter=",",
            header=",".join(heads),
            comments="",
        )
