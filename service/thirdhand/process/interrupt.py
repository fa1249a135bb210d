"""Ctrl-C at any moment: one line and exit 130, never a traceback.

A command without anything to clean up ends at once, also while it imports modules or waits in a
library that blocks Python's own handler. A command that started processes ends them first; a second
Ctrl-C ends the command at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

EXIT_CODE = 128 + signal.SIGINT
_CLEANS_UP = threading.Event()
_RAISED = threading.Event()
_ENDING = threading.RLock()


def end_at_once() -> NoReturn:
    """End this process at once, with one line, whichever threads ask for it."""
    # never released: the process ends; a second signal may come here in the same thread
    _ENDING.acquire()
    with contextlib.suppress(OSError):
        os.write(2, b"\nthirdhand: interrupted\n" if os.isatty(2) else b"thirdhand: interrupted\n")
    os._exit(EXIT_CODE)


def watch() -> None:
    """Install the handler of SIGINT. Call it in the main thread, before slow imports."""
    if signal.getsignal(signal.SIGINT) not in (signal.default_int_handler, signal.SIG_DFL):
        return  # a shell ignores it for background jobs, or another handler is installed
    signals, wakeup = os.pipe()
    os.set_blocking(wakeup, False)
    signal.signal(signal.SIGINT, _raise_to_clean_up)
    signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
    threading.Thread(target=_serve, args=(signals,), name="interrupts", daemon=True).start()


@contextlib.contextmanager
def clean_up_first() -> Iterator[None]:
    """A context in which the first SIGINT raises KeyboardInterrupt, for a command to clean up."""
    _CLEANS_UP.set()
    try:
        yield
    finally:
        _CLEANS_UP.clear()


def too_late() -> None:
    """Ignore SIGINT from now on: the command is done, and its exit code is decided."""
    if signal.getsignal(signal.SIGINT) is _raise_to_clean_up:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise_to_clean_up(number: int, frame: FrameType | None) -> None:
    """Handle SIGINT in Python. `_serve` handles it too, without waiting for bytecode."""
    if not _CLEANS_UP.is_set() or _RAISED.is_set():
        end_at_once()  # `_serve` does nothing if clean_up_first() begins before its turn
    _RAISED.set()
    raise KeyboardInterrupt


def _serve(signals: int) -> None:
    count = 0
    while received := os.read(signals, 64):
        if signal.getsignal(signal.SIGINT) is not _raise_to_clean_up:
            continue
        count += received.count(signal.SIGINT)
        if count > 1 or (count and not _CLEANS_UP.is_set()):
            end_at_once()
