"""The command line: all commands with their options, and the call of the one that is given.

Errors go to standard error. Exit code 1 is a failure, 2 bad usage. A command's module is imported
only when that command runs, because imports are slow.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os

from thirdhand.cli.options import RUN_TIME
from thirdhand.cli.usage import AddCommand, Parser, reaching
from thirdhand.contract.explain import ExplainedError, exit_code_of, in_file, in_words
from thirdhand.process import foreign_modules, interrupt
from thirdhand.process.progress import say
from thirdhand.workbench.cli.options import WORKBENCH

GROUPS = {
    "run": ("demo", "serve", "follow", "sim", "hands", "play"),
    "stop and continue": ("hold", "resume", "reset"),
    "teach": ("record", "learn", "via-points", "begin", "segment", "correct"),
    "look": ("status", "view", "report"),
    "check": ("doctor", "metrics", "bundle", "replay", "bench"),
    "set up": ("arm", "calibrate"),
}
# on Ctrl-C these first end their processes
CLEAN_UP_FIRST = ("demo", "bench", "view", "record", "hands", "calibrate")


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    top = Parser(
        prog="thirdhand",
        description="A robot arm as a third hand at the soldering bench.",
        epilog=(
            "thirdhand COMMAND --help explains a command, with an example. Begin with: thirdhand "
            "demo"
        ),
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    subparsers = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    abouts: dict[str, str] = {}
    for home, commands in (("thirdhand.cli", RUN_TIME), ("thirdhand.workbench.cli", WORKBENCH)):
        add = AddCommand(subparsers, home, abouts)
        for add_options in commands:
            add_options(add)
    top.groups = {
        title: {name: abouts[name].split(". ")[0].rstrip(".") for name in names}
        for title, names in GROUPS.items()
    }
    return top


class _Version(argparse.Action):
    """Print the version of the installed distribution."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib import metadata  # slow to import

        print(f"thirdhand {metadata.version('thirdhand')}")
        parser.exit()


def main(arguments: list[str] | None = None) -> int:
    """Run a command line and return its exit code."""
    args = parser().parse_args(arguments)
    module, function = args.run.rsplit(".", 1)
    try:
        if "reaches" in args and not vars(args).get("config"):
            args.cell = reaching(args).cell
        with foreign_modules.named():
            run = getattr(importlib.import_module(module), function)
            with (
                interrupt.clean_up_first()
                if args.command in CLEAN_UP_FIRST
                else contextlib.nullcontext()
            ):
                return int(run(args))
    except BrokenPipeError:  # the reader of standard output, a pager for instance, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    except (ExplainedError, OSError) as error:
        say(f"thirdhand {args.command}: {in_file(in_words(error))}")
        return exit_code_of(error)
    except KeyboardInterrupt:
        interrupt.end_at_once()
