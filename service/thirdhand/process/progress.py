"""Progress of a command on standard error, if it takes longer than two seconds: a bar or a spinner
on a terminal, else a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator

from thirdhand.contract.printable import CLEAR, printable_lines
from thirdhand.contract.requests import STARTING

SHOWN_AFTER_S = 2.0  # shorter steps show no progress
LINE_EVERY_S = 10.0  # interval of lines without a terminal


def say(line: str) -> None:
    """Print a message on standard error at once, with control characters made printable.

    On a terminal, each report of a daemon's start overwrites the one before.
    """
    terminal = sys.stderr.isatty()
    in_place = terminal and line.lstrip().startswith(STARTING)
    text = line[: shutil.get_terminal_size().columns - 1] if in_place else line
    print(
        f"{CLEAR * terminal}{printable_lines(text)}",
        end="" if in_place else "\n",
        file=sys.stderr,
        flush=True,
    )


@contextlib.contextmanager
def progress(
    what: str,
    *,
    total: int | None = None,
    unit: str = "ticks",
    after_s: float = SHOWN_AFTER_S,
    every_s: float = LINE_EVERY_S,
) -> Iterator[Callable[[int], None]]:
    """A context with a function to call with the number of units done, out of `total` if known."""
    with contextlib.closing(_Shown(what, total, unit, after_s, every_s)) as display:
        yield display.done


@contextlib.contextmanager
def steps(
    what: str, *, after_s: float = SHOWN_AFTER_S, every_s: float = LINE_EVERY_S
) -> Iterator[Callable[[str], None]]:
    """A context with a function to call with the name of each step as it begins."""
    with contextlib.closing(_Shown(what, None, "", after_s, every_s)) as display:
        yield display.doing


class _Shown:
    """Show the progress from a thread of its own, also while the command computes."""

    def __init__(
        self, what: str, total: int | None, unit: str, after_s: float, every_s: float
    ) -> None:
        self._what = what
        self._total = total
        self._unit = unit
        self._after_s = after_s
        self._every_s = every_s
        self._count = 0
        self._begun = time.monotonic()
        self._ended = threading.Event()
        show = self._draw if sys.stderr.isatty() else self._print
        self._thread = threading.Thread(target=show, name="progress", daemon=True)
        self._thread.start()

    def done(self, count: int) -> None:
        self._count = count

    def doing(self, what: str) -> None:
        self._what = what
        self._begun = time.monotonic()
        if not sys.stderr.isatty():
            say(what)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _draw(self) -> None:
        if self._ended.wait(self._after_s):
            return
        from rich.console import Console  # its import is slow, and most commands end before
        from rich.progress import (
            BarColumn,
            Progress,
            SpinnerColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        class Cursor(Console):
            """A console that never hides the cursor, which would remain hidden after Ctrl-C."""

            def show_cursor(self, show: bool = True) -> bool:
                return False

        has_total = self._total is not None
        columns = (
            [BarColumn(), TextColumn("{task.percentage:.0f} %"), TimeRemainingColumn()]
            if has_total
            else []
        )
        text = TextColumn("{task.description}", markup=False)
        with Progress(
            SpinnerColumn(),
            text,
            *columns,
            TimeElapsedColumn(),
            console=Cursor(stderr=True),
            transient=True,
        ) as bar:
            task = bar.add_task(self._what, total=self._total)
            bar.update(task, completed=self._count)
            while not self._ended.wait(0.2):
                bar.update(task, description=self._what, completed=self._count)

    def _print(self) -> None:
        wait_s = self._after_s
        while not self._ended.wait(wait_s):
            wait_s = self._every_s
            passed_s = time.monotonic() - self._begun
            if passed_s < self._after_s:  # a new step: its name was printed as it began
                continue
            passed = f"{passed_s:.0f} s"
            if self._total:
                passed = (
                    f"{100 * self._count / self._total:.0f} % of {self._total} {self._unit}, "
                    f"{passed}"
                )
            elif self._count:
                passed = f"{self._count} {self._unit}, {passed}"
            say(f"{self._what}: {passed}")
