"""Options and checks of arguments that several commands use, and usage errors."""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import zenoh

from thirdhand.client import (
    CLIENT_FILE,
    ClientSettings,
    UnreachableError,
    client_settings,
    open_session,
)
from thirdhand.contract.channels import ENDPOINT, LARGEST_REQUEST, lacking
from thirdhand.contract.explain import NotAcceptedError, did_you_mean, in_file, in_words
from thirdhand.contract.requests import Add, RequestError, ViaPoint, decode_request
from thirdhand.settings.config import RATES_HZ, Settings
from thirdhand.settings.file_content import UnusableError, content

CONNECT_TIMEOUT_S = 3.0


class UsageError(NotAcceptedError):
    """The command line is not valid."""


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest choice for an unknown one. `groups` has the commands and
    their descriptions by title, for the help.
    """

    groups: Mapping[str, Mapping[str, str]] = {}

    def format_help(self) -> str:
        """The help text: usage, and the commands in their groups."""
        if not self.groups:
            return super().format_help()
        formatter = argparse.HelpFormatter(self.prog, max_help_position=15)
        formatter.add_text(self.description)
        for title, commands in self.groups.items():
            formatter.start_section(title)
            formatter.add_arguments(
                argparse.Action([], name, help=about) for name, about in commands.items()
            )
            formatter.end_section()
        formatter.add_text(self.epilog)
        return f"{self.format_usage()}\n{formatter.format_help()}"

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and exit with code 2."""
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        words = re.findall(r"[\w-]+", choice[2]) if choice else []
        super().error(message + (did_you_mean(choice[1], words, cutoff=0.5) if choice else ""))


class AddCommand:
    """Adds commands of one house, whose modules are in the package `home`, to the command line.
    `abouts` receives what each is for.
    """

    def __init__(self, subparsers: Any, home: str, abouts: dict[str, str]) -> None:
        self._subparsers = subparsers
        self._home = home
        self._abouts = abouts

    def __call__(
        self, name: str, about: str, example: str, run: str = ""
    ) -> argparse.ArgumentParser:
        """The parser of a command, which the function `run` runs: `module.function` in the home, or
        a full name; by default it and its module are named as the command.
        """
        self._abouts[name] = about
        command = described(self._subparsers, name, about, example)
        run = run or f"{name}.{name}"
        command.set_defaults(run=run if run.count(".") > 1 else f"{self._home}.{run}")
        return command

    def bare(self, name: str, about: str) -> argparse.ArgumentParser:
        """The parser of a command that reads all its options itself, also --help."""
        self._abouts[name] = about
        command: argparse.ArgumentParser = self._subparsers.add_parser(
            name, help=about, prefix_chars="\0", add_help=False
        )
        command.set_defaults(run=f"{self._home}.{name}.{name}")
        return command


def described(subparsers: Any, name: str, about: str, example: str) -> argparse.ArgumentParser:
    """The parser of a command or of an action of one."""
    added: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=about,
        description=about,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return added


def reach(sub: argparse.ArgumentParser, *, one: bool = True) -> argparse.ArgumentParser:
    """The same parser with the options by which a daemon is reached, and if `one`, its cell."""
    group = sub.add_argument_group(
        "how the daemon is reached",
        "An option that is not given is taken from the variable in its help, else from the file\n"
        f"{CLIENT_FILE}.\nThe certificate and Zenoh's own settings are taken from "
        "$THIRDHAND_CERTIFICATE and\n"
        "$THIRDHAND_ZENOH_CONFIG, else from the same file.",
    )
    endpoint = "Zenoh endpoint of the daemon or of a router; if repeated, the first that answers"
    option(
        group,
        "--connect",
        "EP",
        f"{endpoint} ($THIRDHAND_CONNECT, else {ENDPOINT})",
        action="append",
    )
    if one:
        option(group, "--cell", "NAME", "prefix of all keys ($THIRDHAND_CELL, else thirdhand)")
    sub.set_defaults(reaches=True)
    return sub


def within(kind: type[float], low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """A function that reads a number (int or float) from `low` to `high` from the command line."""

    def read(given: str) -> float:
        with contextlib.suppress(ValueError):
            if low <= kind(given) <= high:
                return kind(given)
        raise argparse.ArgumentTypeError(f"{given} given, {low:g} to {high:g}{unit} needed")

    return read


def endpoint(given: str) -> str:
    """Read a Zenoh endpoint from the command line."""
    if lacks := lacking(given):
        raise argparse.ArgumentTypeError(lacks)
    return given


def workers(given: str) -> str:
    """Read workers from the command line, as `spread` takes them."""
    if re.fullmatch(r"[1-9]\d{0,3}|dask:\S+", given):
        return given
    raise argparse.ArgumentTypeError(
        f"{given} given; a number of processes, or dask:tcp://HOST:8786 needed"
    )


# the functions that read an option's value
TYPE_OF_METAVAR: dict[str | None, Callable[[str], Any]] = {
    **dict.fromkeys(("DIR", "FILE", "PNG"), Path),
    "S": float,
    "M": within(float, 0, 10, " m"),
    "HZ": within(int, *RATES_HZ, " Hz"),
    "EP": endpoint,
    "WORKERS": workers,
}

WORKERS_HELP = (
    "share the work out to this number of processes, or to the cluster at dask:ADDRESS (of "
    "the scheduler); the output is the same (default: one after the other)"
)
RATE_HELP = "the rate of the control loop (default: the rate in the cell's settings)"
ARM_HELP = (
    "wam, franka or ur5, or a cell's settings (FILE.toml, or FILE.toml:NAME of several cells)"
)


def option(
    c: argparse._ActionsContainer,
    name: str,
    metavar: str | None,
    about: str,
    default: Any = None,
    **more: Any,
) -> None:
    """Add an option or argument with a value; its default is appended to its help."""
    if default is not None:
        about += (
            f" (default: {default:g})" if isinstance(default, float) else f" (default: {default})"
        )
    more = {"type": TYPE_OF_METAVAR.get(metavar, str), **more}
    c.add_argument(name, metavar=metavar, help=about, default=default, **more)


def flag(c: argparse._ActionsContainer, name: str, about: str) -> None:
    """Add an option without a value, which is False unless given."""
    c.add_argument(name, action="store_true", help=about)


def check_writable(path: Path, suffix: str = "") -> None:
    """Raise UsageError if no file of this suffix can be written at a path; for a check before long
    work.
    """
    folder = Path(os.path.realpath(path) if path.is_symlink() else path).parent
    if path.is_dir():
        raise UsageError(f"{path} is a folder; the name of a file needed")
    if suffix and path.suffix.lower() != suffix:
        raise UsageError(
            f"{path}: a name that ends in {suffix} needed, like {path.with_suffix(suffix).name}"
        )
    if not folder.is_dir():
        raise UsageError(f"{path}: there is no folder {folder}")
    try:
        if path.is_file() or not path.exists():  # else it is a device or a pipe
            tempfile.TemporaryFile(dir=folder).close()
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {in_words(error, named=False)}") from None


def reaching(args: argparse.Namespace, settings: Settings | None = None) -> ClientSettings:
    """The client settings in a command line; if they name no endpoint, those at which the daemon of
    a cell's `settings` is reached. Raises SettingsError.
    """
    reach = client_settings(connect=args.connect, cell=vars(args).get("cell"))
    if settings is None or reach.connect or reach.zenoh_config:
        return reach
    return msgspec.structs.replace(reach, connect=settings.network.reached_at)


def reached(args: argparse.Namespace, timeout_s: float | None = CONNECT_TIMEOUT_S) -> zenoh.Session:
    """A session to the daemon or router; with a timeout of None it waits until Ctrl-C. Raises
    UnreachableError, immediately if the system reports that nothing listens.
    """
    return reaching(args).session(timeout_s=timeout_s, at_once=timeout_s is not None)


def inputs_session(args: argparse.Namespace, timeout_s: float, settings: Settings) -> zenoh.Session:
    """A session that receives what trackers and arm publish: a client of the cell's daemon or of a
    router, or with --listen one to which they connect. Raises UnreachableError.
    """
    listen = [args.listen] if args.listen else []
    reach = reaching(args, settings)
    try:
        return open_session(
            connect=args.connect or () if listen else reach.connect,
            otherwise=[ENDPOINT],
            listen=listen,
            timeout_s=timeout_s,
            certificate=reach.certificate,
            zenoh_config=reach.zenoh_config,
            # a daemon forwards others' messages only to clients
            more={} if listen else {"mode": "client"},
        )
    except UnreachableError as error:
        hint = "" if listen else f" Without a daemon, use --listen {ENDPOINT}"
        raise UnreachableError(f"{error}{hint}") from None


def added_in(path: Path) -> Add:
    """The request to add via-points in a file (`-`: standard input). Raises RequestError with the
    name of the file.
    """
    try:
        request: Add = decode_request(
            sys.stdin.buffer.read()
            if str(path) == "-"
            else content(path, LARGEST_REQUEST, accepts_pipes=True),
            Add,
        )
    except (OSError, UnusableError) as error:
        raise RequestError(f"{path} cannot be read: {in_words(error, named=False)}") from None
    except RequestError as error:
        raise RequestError(f"{path}: {in_file(str(error))}") from None
    return request


def via_points_in(path: Path) -> tuple[ViaPoint, ...]:
    """The via-points in a file, see `added_in`. Raises RequestError with the name of the file."""
    return added_in(path).points


def add_end_with(parser: argparse.ArgumentParser) -> None:
    """Add the option of commands that another process runs."""
    about = "stop when this process ends, as after SIGTERM"
    option(parser, "--end-with", "PID", about, type=within(int, 1, 2**31 - 1))


def end_with(pid: int) -> None:
    """Send this process SIGTERM when another one ends. Raises UsageError if there is none."""
    from thirdhand.process.child import when_ended

    try:
        when_ended(pid, lambda: os.kill(os.getpid(), signal.SIGTERM))
    except ProcessLookupError:
        raise UsageError(
            f"--end-with {pid}: no such process; the number of a running one accepted"
        ) from None
