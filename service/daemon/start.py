"""The start of a daemon: takes its cell, and says for it what it does and how far it is, before
anything heavy is imported.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import zenoh

from service.client import open_session
from service.contract import channels, ros2
from service.contract.printable import CLEAR
from service.contract.requests import STARTING
from service.contract.roles import access_control
from service.daemon.single_instance import BOUNDS, Lock, allow_descriptors, occupy, state_folder
from service.settings.config import Settings

log = logging.getLogger("thirdhand")
TELL_EVERY_S, LOG_EVERY_S = 1.0, 20.0
NETWORK_NICE = -15  # 28 times the weight of an ordinary thread
LOOPED = ("kmp.", "service.core.")  # modules of what the loop runs


class Start:
    """Until it is `over`, each request to a cell is refused with what is done and how far it is.

    On a terminal one line shows it, written anew in place; elsewhere the log reports the beginning,
    each quarter of the functions, and every LOG_EVERY_S that something changes.
    """

    def __init__(self, lock: Lock, session: zenoh.Session, cell: str) -> None:
        self.lock, self.session = lock, session
        self._compiled: list[str] = []  # what is being compiled, callers first; no names of what libraries have
        self._functions: list[Any] = []  # all that the loop may call, once they are imported
        self._is_over, self._begun_s = threading.Event(), time.monotonic()
        keys = [channels.key(cell, channel.key) for channel in channels.CHANNELS if channel.queryable]
        self._queryables = [session.declare_queryable(key, self._refuse) for key in keys]
        self._teller = threading.Thread(target=self._tell, name="start", daemon=True)
        self._teller.start()

    @property
    def age_s(self) -> float:
        """The time since it began [s]."""
        return time.monotonic() - self._begun_s

    @property
    def told(self) -> str:
        """What is done, and how far it is."""
        if not self._functions:
            return f"{STARTING}importing, {len(sys.modules)} modules so far"
        named = [name for name in self._compiled.copy() if name]
        doing = f"compiling {named[-1]}" if named else "loading what is compiled"
        return f"{STARTING}{doing}, {self._ready} of {len(self._functions)} functions are there"

    @property
    def _ready(self) -> int:
        return sum(bool(function.signatures) for function in self._functions)

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """Within it functions that the loop may call, imported by now, are counted as they come."""
        from numba.core import dispatcher, event  # heavy, which is why this has begun before

        compiled = self._compiled

        class Compiling(event.Listener):  # type: ignore[misc]
            def on_start(self, event: event.Event) -> None:
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

    def over(self) -> None:
        """Ends the refusals, so that others can answer; may be repeated."""
        self._is_over.set()
        self._teller.join()
        while self._queryables:
            self._queryables.pop().undeclare()  # type: ignore[no-untyped-call]

    def _refuse(self, query: zenoh.Query) -> None:
        with query:  # its end tells the client that no more replies come
            query.reply_err(self.told.encode(), encoding=zenoh.Encoding.TEXT_PLAIN)

    def _tell(self) -> None:
        said, said_s, quarter, terminal = "", -math.inf, -1, sys.stderr.isatty()
        while not self._is_over.is_set():
            told, now_s = self.told, time.monotonic()
            now_in = 4 * self._ready // len(self._functions) if self._functions else -1
            if terminal:
                width = shutil.get_terminal_size().columns - 1
                print(f"{CLEAR}{told[:width]}", end="", file=sys.stderr, flush=True)
            elif told != said and (now_in > quarter or now_s - said_s >= LOG_EVERY_S):
                log.info("%s", told)
                said, said_s, quarter = told, now_s, now_in
            self._is_over.wait(TELL_EVERY_S)
        if terminal:
            print(CLEAR, end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def starting(settings: Settings) -> Iterator[Start]:
    """The start of the daemon of a cell, which is taken as long as the context lasts.

    Raises OccupiedError, UnreachableError.
    """
    network = settings.network
    roles = network.revoked, network.ros2_domain, (*ros2.of_settings(settings.ros2),)
    with contextlib.closing(Lock(state_folder(settings), settings.cell)) as lock:
        allow_descriptors()
        with _ahead_of_others():
            session = open_session(
                connect=network.connect,
                listen=network.listen,
                certificate=network.certificate,
                zenoh_config=network.zenoh_config,
                more=BOUNDS | (access_control(settings.cell, *roles) if network.certificate else {}),
            )
        with session:
            token = occupy(session, settings.cell)  # noqa: F841  # the cell is free once it is gone
            start = Start(lock, session, settings.cell)
            try:
                yield start
            finally:
                start.over()


@contextlib.contextmanager
def _ahead_of_others() -> Iterator[None]:
    """Threads started within it run before those of other processes, if that is granted.

    It is for the network's threads, which else wait up to 100 ms on a busy machine. They get no
    real-time scheduling, or a flood of messages could use up the real-time share.
    """
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(before, NETWORK_NICE))
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)
