"""`thirdhand record`: capture, show, trim and delete demonstrations of a running cell."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thirdhand.cli.usage import (
    CONNECT_TIMEOUT_S,
    UsageError,
    check_writable,
    inputs_session,
    via_points_in,
)
from thirdhand.contract.printable import printable, printable_lines
from thirdhand.process.progress import say
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings
from thirdhand.workbench.cli.keys import EnterPressed
from thirdhand.workbench.takes.demonstration_files import (
    DemonstrationNameError,
    demonstration_paths,
    draw,
    existing_path,
    path_of,
    summary,
    table,
    trim,
    uncut,
)
from thirdhand.workbench.trackers.capture import Capture, capture

LONGEST_PERSON = 64  # [characters]


def record(args: argparse.Namespace) -> int:
    """Capture, show, trim, list or delete takes. Exit code 0; 1 if --list finds an unusable
    take.
    """
    _check_usage(args)
    settings = cell_of(str(args.config)) if args.config else None
    if args.plot is not None:
        check_writable(args.plot, ".png")
    if args.list:
        return _list(args.folder, settings)
    if args.delete:
        return _delete(existing_path(args.folder, args.name))
    if args.trim is not None:
        start_s, end_s = args.trim
        if not 0 <= start_s < end_s:
            raise UsageError(
                f"--trim {start_s:g} {end_s:g}: two times [s] from the start needed, the first "
                "below the second"
            )
        print(trim(existing_path(args.folder, args.name), start_s, end_s), file=sys.stderr)
    elif not args.show:
        _capture(args, settings or Settings())
    take_summary = summary(existing_path(args.folder, args.name), settings=settings)
    print(printable_lines(table(take_summary)))
    if args.plot is not None:
        draw(take_summary, args.plot)
        print(f"{args.plot} drawn", file=sys.stderr)
    return 0


def _check_usage(args: argparse.Namespace) -> None:
    """Raise UsageError unless either a valid name of a take or --list is given."""
    if args.list == (args.name is not None):
        raise UsageError("either the name of a take or --list needed")
    if args.name is not None:
        try:
            path_of(args.folder, args.name)
        except DemonstrationNameError as error:
            raise UsageError(str(error)) from None


def _delete(path: Path) -> int:
    """Delete a take and its original; the exit code."""
    deleted = [path, *([uncut(path)] if uncut(path).exists() else [])]
    for file in deleted:
        file.unlink()
    print(f"deleted: {', '.join(map(str, deleted))}")
    return 0


def _list(folder: Path, settings: Settings | None) -> int:
    """List the takes; exit code 1 if one of them is not usable for learning."""
    if not folder.is_dir():
        raise DemonstrationNameError(
            f"{folder} {'is no folder' if folder.exists() else 'does not exist'}: a folder of "
            "takes needed (--folder)"
        )
    paths = demonstration_paths(folder)
    unusable = 0
    for path in paths:
        try:
            take_summary = summary(path, settings=settings)
        except RecordingError as error:
            unusable += 1
            print(printable(f"{path.stem:<20} {error}"))
            continue
        rates = ", ".join(
            f"{stream.name} {stream.rate_hz:.0f} Hz" for stream in take_summary.streams
        )
        gap = f"longest gap {1e3 * max(stream.gap_s for stream in take_summary.streams):.0f} ms"
        print(
            printable(
                f"{path.stem:<20} {take_summary.lasts_s:6.1f} s   "
                f"{'; '.join((rates, gap, *take_summary.remarks))}"
            )
        )
    print(f"{len(paths)} take{'' if len(paths) == 1 else 's'} in {folder}", file=sys.stderr)
    return 1 if unusable else 0


def _capture(args: argparse.Namespace, settings: Settings) -> None:
    if len(args.person or "") > LONGEST_PERSON:
        raise UsageError(
            f"--person of {len(args.person)} characters: up to {LONGEST_PERSON} accepted"
        )
    path = path_of(args.folder, args.name)
    if path.exists():
        raise DemonstrationNameError(
            f"{path} exists already: give another name, or --delete it first"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path)
    via_points = via_points_in(args.via_points) if args.via_points else ()
    cell = args.cell or settings.cell
    ended = EnterPressed()
    if args.begin and not ended.listens:
        raise UsageError("--begin: a terminal needed, as Enter begins the take")
    with inputs_session(args, CONNECT_TIMEOUT_S, settings) as session:
        if args.until == "key" and not args.begin:
            say("Enter or Ctrl-C ends it")
        captured = capture(
            session,
            cell,
            settings,
            until=args.until,
            rest_s=args.rest,
            conducts=args.hands,
            person=args.person or "",
            is_ended=ended,
            is_begun=ended if args.begin else None,
            wait_s=args.wait,
            longest_s=args.seconds,
            progress=_progress if sys.stderr.isatty() else lambda line: None,
            say=_say_over_progress,
        )
    if sys.stderr.isatty():
        print(file=sys.stderr)
    captured.write(path, via_points)
    _report_omitted(captured)


def _report_omitted(captured: Capture) -> None:
    """Print the numbers of messages that a take does not hold."""
    for remark in captured.unreadable:
        print(f"{remark}. They are left out", file=sys.stderr)
    for key, count in captured.of_others.items():
        print(
            f"{count} messages on {key} are left out: a second tracker publishes this hand; stop "
            "one",
            file=sys.stderr,
        )


def _say_over_progress(line: str) -> None:
    print("\r", end="", file=sys.stderr)
    say(line)


def _progress(line: str) -> None:
    print(f"\r{line}", end="", file=sys.stderr, flush=True)
