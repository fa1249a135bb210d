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

from service.client import open_session
from service.contract import channels, ros2
from service.contract.printable import CLEAR
from service.contract.requests import STARTING
from service.contract.roles import access_control
from service.daemon.single_instance import NETWORK_BOUNDS, Lock, allow_descriptors, occupy, state_folder
from service.daemon.systemd import Systemd
from service.process.progress import say
from service.settings.config import Settings

log = logging.getLogger("thirdhand")
REPORT_EVERY_S = 1.0  # interval of reports on a terminal
LOG_EVERY_S = 20.0  # interval of reports in the log
MAX_PAUSE_US = 60_000_000  # systemd waits this long for a start's next progress
AHEAD_NICE = -15  # 28 times the weight of an ordinary thread
LOOPED = ("kmp.", "service.core.")  # the loop runs functions of these modules
AGAIN = "THIRDHAND_STARTS_AGAIN"  # variable: when the start of a process began again [s, monotonic]


class CompilerInMemoryError(Exception):
    """The start compiled functions, so 600 MB of the compiler remain in the process."""


class Startup:
    """The progress of a start. Until `over`, each request to the cell is refused with the progress.

    On a terminal one line shows it in place. Elsewhere the log reports the begin, each quarter of
    the compiled functions, and changes every LOG_EVERY_S.
    """

    def __init__(self, lock: Lock, session: zenoh.Session, cell: str) -> None:
        self.lock, self.session, self.systemd = lock, session, Systemd()
        self._compiled: list[str] = []  # functions in compilation, callers first; empty for a library's functions
        self._has_compiled, again = False, os.environ.pop(AGAIN, None)
        self._is_again = again is not None
        self._functions: list[Any] = []  # all compiled functions that the loop may call, once they are imported
        self._is_over, self._begun_s = threading.Event(), time.monotonic()
        self._stages = [
            ("network", float(again) if again else time.monotonic() - _process_age_s()),
            ("imports", self._begun_s),
        ]
        keys = [channels.key(cell, channel.key) for channel in channels.CHANNELS if channel.queryable]
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
        parts = ", ".join(f"{name} {end_s - begin_s:.2f} s" for (name, begin_s), (_, end_s) in stages)
        return f"{time.monotonic() - self._stages[0][1]:.2f} s: {parts}"

    @property
    def progress(self) -> str:
        """A message on the present step and its progress."""
        if not self._functions:
            return f"{STARTING}importing, {len(sys.modules)} modules so far"
        named = [name for name in self._compiled.copy() if name]
        doing = f"compiling {named[-1]}" if named else "loading compiled functions"
        return f"{STARTING}{doing}, {self._ready} of {len(self._functions)} functions are ready"

    @property
    def _ready(self) -> int:
        return sum(bool(function.signatures) for function in self._functions)

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """A context that counts compiled functions, of those that the loop may call and that are
        imported by now. Raises CompilerInMemoryError at its end if one was compiled, except in a
        start that began again: if nothing can be cached, each start compiles.
        """
        from numba.core import dispatcher, event  # its import is slow, so the start reports before it

        compiled, startup = self._compiled, self

        class Compiling(event.Listener):  # type: ignore[misc]
            def on_start(self, event: event.Event) -> None:
                startup._has_compiled = True
                gc.enable()  # compilations leave garbage
                function = event.data["dispatcher"].py_func
                name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
                compiled.append(name if f"{function.__module__}.".startswith(LOOPED) else "")

            def on_end(self, event: event.Event) -> None:
                compiled.pop()

        modules = [vars(module) for name, module in sys.modules.copy().items() if name.startswith(LOOPED)]
        found = {id(one): one for names in modules for one in names.values() if isinstance(one, dispatcher.Dispatcher)}
        self._functions = list(found.values())
        with event.install_listener("numba:compile", Compiling()):
            yield
        if self._has_compiled and not self._is_again:
            raise CompilerInMemoryError

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
        logged, logged_s, quarter, terminal, notified = "", -math.inf, -1, sys.stderr.isatty(), ""
        while not self._is_over.is_set():
            progress, now_s = self.progress, time.monotonic()
            if progress != notified:
                notified = progress
                self.systemd.notify(f"STATUS={progress}", f"EXTEND_TIMEOUT_USEC={MAX_PAUSE_US}")
            now_in = 4 * self._ready // len(self._functions) if self._functions else -1
            if terminal:
                say(progress)
            elif progress != logged and (now_in > quarter or now_s - logged_s >= LOG_EVERY_S):
                log.info("%s", progress)
                logged, logged_s, quarter = progress, now_s, now_in
            self._is_over.wait(REPORT_EVERY_S)
        if terminal:
            print(CLEAR, end="", file=sys.stderr, flush=True)


def _process_age_s() -> float:
    """Time since this process was started [s]."""
    begun_ticks = int(Path("/proc/self/stat").read_text(errors="replace").rpartition(")")[2].split()[19])
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
                more=NETWORK_BOUNDS | (access_control(settings.cell, *roles) if network.certificate else {}),
            )
        with session:
            token = occupy(session, settings.cell)  # noqa: F841  # the cell is free when the token is deleted
            start = Startup(lock, session, settings.cell)
            try:
                yield start
            finally:
                start.over()


@contextlib.contextmanager
def ahead_of_others() -> Iterator[None]:
    """A context in which this thread, and threads that it starts, get a higher weight than other
    processes, if granted.

    It is for the start, and for the network's threads, which otherwise wait up to 100 ms on a busy
    machine. They get no real-time scheduling, because a flood of messages could use up the
    real-time share.
    """
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(before, AHEAD_NICE))
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)
