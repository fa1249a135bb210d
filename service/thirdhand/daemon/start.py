"""The start of a daemon: it occupies the cell and reports its progress before slow imports."""

from __future__ import annotations

import contextlib
import gc
import itertools
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

from thirdhand.client import open_session
from thirdhand.contract import channels, ros2
from thirdhand.contract.printable import CLEAR
from thirdhand.contract.requests import STARTING
from thirdhand.contract.roles import access_control
from thirdhand.daemon.single_instance import (
    NETWORK_BOUNDS,
    Lock,
    allow_descriptors,
    occupy,
    state_folder,
)
from thirdhand.daemon.systemd import Systemd
from thirdhand.process.priority import ahead_of_others
from thirdhand.process.progress import say
from thirdhand.settings.config import Settings

log = logging.getLogger("thirdhand")
REPORT_EVERY_S = 1.0  # interval of reports on a terminal
LOG_EVERY_S = 20.0  # interval of reports in the log
MAX_PAUSE_US = 60_000_000  # systemd waits this long for a start's next progress
LOOPED = ("kmp.", "thirdhand.core.")  # the loop runs functions of these modules


class Startup:
    """The progress of a start. Until `over`, each request to the cell is refused with the progress.

    On a terminal one line shows it in place. Elsewhere the log reports the begin, each quarter of
    the compiled functions, and changes every LOG_EVERY_S.
    """

    def __init__(self, lock: Lock, session: zenoh.Session, cell: str) -> None:
        self.lock = lock
        self.session = session
        self.systemd = Systemd()
        self._compiling: list[str] = []  # functions in compilation, callers first
        self._compiled: set[str] = set()  # functions that were compiled, here or by other processes
        self._functions: dict[str, Any] = {}  # all that the loop may call, once they are imported
        self._is_over = threading.Event()
        self._begun_s = time.monotonic()
        self._stages = [
            ("network", time.monotonic() - _process_age_s()),
            ("imports", self._begun_s),
        ]
        keys = [
            channels.key(cell, channel.key) for channel in channels.CHANNELS if channel.queryable
        ]
        self._queryables = [session.declare_queryable(key, self._refuse) for key in keys]
        self._reporter = threading.Thread(target=self._report, name="start", daemon=True)
        self._reporter.start()

    def stage(self, name: str) -> None:
        """Note that the next stage of the start begins."""
        self._stages.append((name, time.monotonic()))

    @property
    def duration(self) -> str:
        """Time since the process began and the time of each stage [s], in words."""
        stages = itertools.pairwise([*self._stages, ("", time.monotonic())])
        parts = ", ".join(
            f"{name} {end_s - begin_s:.2f} s" for (name, begin_s), (_, end_s) in stages
        )
        return f"{time.monotonic() - self._stages[0][1]:.2f} s: {parts}"

    @property
    def progress(self) -> str:
        """A message on the present step and its progress."""
        if not self._functions:
            return f"{STARTING}importing, {len(sys.modules)} modules so far"
        compiling = [name for name in self._compiling.copy() if name in self._functions]
        doing = f"compiling {_short(compiling[-1])}" if compiling else "loading compiled functions"
        return f"{STARTING}{doing}, {self._ready} of {len(self._functions)} functions are ready"

    @property
    def _ready(self) -> int:
        return sum(
            name in self._compiled or bool(function.signatures)
            for name, function in self._functions.items()
        )

    def note(self, function: str, is_ready: bool) -> None:
        """Note that the compilation of a function begins, or that it is ready."""
        if not is_ready:
            self._compiling.append(function)
        elif function in self._compiling:
            self._compiling.remove(function)
            self._compiled.add(function)

    @contextlib.contextmanager
    def counting(self, *, may_compile: bool) -> Iterator[None]:
        """A context that counts the compiled functions that the loop may call and that are imported
        by now. Raises NotCompiledError at the first compilation, unless it `may_compile`.
        """
        # its import is slow, so the start reports before it
        from numba.core import dispatcher, event

        from thirdhand.daemon.compilation import Compilations, NotCompiledError

        def begun(name: str) -> None:
            if not may_compile:
                raise NotCompiledError(name)
            gc.enable()  # compilations leave garbage
            self.note(name, False)

        modules = sys.modules.copy().items()
        looped = [module for module_name, module in modules if module_name.startswith(LOOPED)]
        values = [value for module in looped for value in vars(module).values()]
        self._functions = {
            f"{value.py_func.__module__}.{value.py_func.__name__}": value
            for value in values
            if isinstance(value, dispatcher.Dispatcher)
        }
        with event.install_listener(
            "numba:compile", Compilations(begun, lambda name: self.note(name, True))
        ):
            yield

    def over(self) -> None:
        """End the refusals, so that the daemon can answer; may be repeated."""
        self._is_over.set()
        self._reporter.join()
        while self._queryables:
            self._queryables.pop().undeclare()  # type: ignore[no-untyped-call]

    def _refuse(self, query: zenoh.Query) -> None:
        with query:  # its end shows the client that there are no more replies
            query.reply_err(self.progress.encode(), encoding=zenoh.Encoding.TEXT_PLAIN)

    def _report(self) -> None:
        logged = ""
        logged_s = -math.inf
        quarter = -1
        terminal = sys.stderr.isatty()
        notified = ""
        while not self._is_over.is_set():
            progress = self.progress
            now_s = time.monotonic()
            if progress != notified:
                notified = progress
                self.systemd.notify(f"STATUS={progress}", f"EXTEND_TIMEOUT_USEC={MAX_PAUSE_US}")
            # the quarter that is reached; -1: the functions are not known yet
            now_in = 4 * self._ready // len(self._functions) if self._functions else -1
            if terminal:
                say(progress)
            elif progress != logged and (now_in > quarter or now_s - logged_s >= LOG_EVERY_S):
                log.info("%s", progress)
                logged = progress
                logged_s = now_s
                quarter = now_in
            self._is_over.wait(REPORT_EVERY_S)
        if terminal:
            print(CLEAR, end="", file=sys.stderr, flush=True)


def _short(function: str) -> str:
    """The name of a function with its module, without packages."""
    return ".".join(function.split(".")[-2:])


def _process_age_s() -> float:
    """Time since this process was started [s]."""
    begun_ticks = int(
        Path("/proc/self/stat").read_text(errors="replace").rpartition(")")[2].split()[19]
    )
    return time.clock_gettime(time.CLOCK_BOOTTIME) - begun_ticks / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def starting(settings: Settings) -> Iterator[Startup]:
    """The start of a cell's daemon, which occupies the cell until the context ends.

    Raises OccupiedError, UnreachableError.
    """
    network = settings.network
    roles = network.revoked, network.ros2_domain, (*ros2.of_settings(settings.ros2),)
    with contextlib.closing(Lock(state_folder(settings), settings.cell)) as lock:
        allow_descriptors()
        with ahead_of_others():
            session = open_session(
                connect=network.connect,
                listen=network.listen,
                certificate=network.certificate,
                zenoh_config=network.zenoh_config,
                more=NETWORK_BOUNDS
                | (access_control(settings.cell, *roles) if network.certificate else {}),
            )
        with session:
            token = occupy(session, settings.cell)  # noqa: F841  # the cell is free when the token is deleted
            start = Startup(lock, session, settings.cell)
            try:
                yield start
            finally:
                start.over()
