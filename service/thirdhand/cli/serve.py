"""`thirdhand serve`: the daemon; options of the command line override the configuration."""

from __future__ import annotations

import argparse
import functools
import gc
import logging
import os
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from thirdhand.cli.usage import UsageError, end_with
from thirdhand.contract.explain import ExplainedError, exit_code_of, in_file, in_words
from thirdhand.contract.printable import CLEAR, printable_lines
from thirdhand.daemon.start import starting
from thirdhand.process import child, foreign_modules
from thirdhand.process.priority import ahead_of_others
from thirdhand.recordings.shipped import cell_of, skill_file
from thirdhand.settings.config import Settings, converted
from thirdhand.settings.file_content import SettingsError

log = logging.getLogger("thirdhand")


def serve(args: argparse.Namespace) -> int:
    """Run the daemon until it is stopped; exit code 0, or 1 if recordings lack ticks."""
    os.umask(0o077)  # files are private to the user
    _open_standard_streams()
    if args.end_with is not None:
        end_with(args.end_with)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter() if args.log == "json" else PrintableFormatter("%(asctime)s %(message)s")
    )
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    try:
        with foreign_modules.named():
            return _run(args)
    except Exception as error:
        if args.log != "json":
            raise
        log.error(
            in_file(in_words(error)),
            exc_info=not isinstance(error, OSError | ValueError | ExplainedError),
        )
        return exit_code_of(error)


def _run(args: argparse.Namespace) -> int:
    """Run the daemon until it is stopped, and end the process."""
    settings = settings_of(args)
    folder = Path(settings.files.record).expanduser() if settings.files.record else None
    if folder is not None:
        _check_writable(folder)
    if args.live is not None:
        foreign_modules.require("rerun")
    if folder is not None or args.live is not None:
        child.preload("thirdhand.scribe.process")  # in parallel to the imports of this process
    with starting(settings) as start:
        gc.disable()  # a start leaves no garbage, and collections would take a tenth of its time
        with ahead_of_others():
            # a slow import, during which `start` answers requests
            from thirdhand.daemon import daemon
            from thirdhand.scribe.scribe import Scribe

        gc.freeze()  # no later collection visits what was imported
        skill = skill_path(settings, args)
        scribe = Scribe(settings, folder=folder, live_port=args.live)
        missing = daemon.serve(
            settings,
            skill,
            skills=skill_file(settings).parent,
            scribe=scribe,
            start=start,
            announce=functools.partial(_announce, settings),
            hold=args.hold or settings.arm.start == "held",
        )
    logging.shutdown()
    # everything is closed; this does not wait for threads of libraries
    os._exit(1 if missing else 0)


def _check_writable(folder: Path) -> None:
    """Make the folder of the recordings. Raises OSError if no file can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror if folder.is_dir() or not folder.exists() else "it is not a folder"
        raise OSError(f"cannot record in {folder}: {reason}") from None


def _announce(settings: Settings, endpoints: Sequence[str]) -> None:
    """Print where a daemon listens; it runs on without a reader of its output."""
    where = ", ".join(endpoints) or f"nothing, connected to {', '.join(settings.network.connect)}"
    line = f"listening on {where} as cell {settings.cell}"
    try:
        print(line, flush=True)
    except OSError as error:
        log.warning("%s (standard output: %s)", line, in_words(error))


def settings_of(args: argparse.Namespace) -> Settings:
    """The settings of the cell, overridden by the options of the command line."""
    return _overridden(cell_of(str(args.config)) if args.config else Settings(), args)


def skill_path(settings: Settings, args: argparse.Namespace) -> Path:
    """The file of the skill to run."""
    return Path(args.skill or skill_file(settings))


def _open_standard_streams() -> None:
    """Open the null device for each closed one of standard input, output and error. Otherwise a
    socket gets its number and receives the output of libraries.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


class JsonFormatter(logging.Formatter):
    """A formatter that writes each record as one JSON object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line: time (UTC), level, logger, message and, if any, exception."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line = {
            "time": time,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {"exception": self.formatException(record.exc_info)} if record.exc_info else {}
        return msgspec.json.encode(line).decode()


class PrintableFormatter(logging.Formatter):
    """A formatter that makes control characters in log records printable."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one or more lines."""
        return CLEAR * sys.stderr.isatty() + printable_lines(super().format(record))


def _overridden(settings: Settings, args: argparse.Namespace) -> Settings:
    """The settings, overridden by the options of the command line."""
    values: dict[str, Any] = msgspec.to_builtins(settings)
    for section, field, value in (
        (values, "cell", args.cell),
        (values, "rate_hz", args.rate),
        (
            values["network"],
            "listen",
            args.listen or ([] if args.connect and not args.config else None),
        ),
        (values["network"], "connect", args.connect),
        (values["arm"], "source", args.joints),
        (values["files"], "record", str(args.record) if args.record else None),
    ):
        if value is not None:
            section[field] = value
    try:
        return converted(values, origin="command line")
    except SettingsError as error:
        raise UsageError(str(error)) from None
