"""Ctrl-C at any moment: one line and exit 130, never a traceback.

A command without anything to clean up ends at once, also while it imports or waits in a library
that keeps Python's own handler from running. One that started processes ends them first; a second
Ctrl-C does not wait for that.
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
_CLEANS_UP, _RAISED = threading.Event(), threading.Event()


def end_at_once() -> NoReturn:
    """Ends this process at once, with one line."""
    with contextlib.suppress(OSError):
        os.write(2, b"\nthirdhand: interrupted\n" if os.isatty(2) else b"thirdhand: interrupted\n")
    os._exit(EXIT_CODE)


def watch() -> None:
    """Installs the handler of SIGINT; for the main thread, before all that takes time."""
    if signal.getsignal(signal.SIGINT) not in (signal.default_int_handler, signal.SIG_DFL):
        return  # ignored, as in the background of a terminal, or handled by another
    signals, wakeup = os.pipe()
    os.set_blocking(wakeup, False)
    signal.signal(signal.SIGINT, _raise_to_clean_up)
    signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
    threading.Thread(target=_serve, args=(signals,), name="interrupts", daemon=True).start()


@contextlib.contextmanager
def clean_up_first() -> Iterator[None]:
    """Within it the first SIGINT raises KeyboardInterrupt, so that the command can clean up."""
    _CLEANS_UP.set()
    try:
        yield
    finally:
        _CLEANS_UP.clear()


def too_late() -> None:
    """Ignores SIGINT from now on: the command is done, and its exit code decided."""
    if signal.getsignal(signal.SIGINT) is _raise_to_clean_up:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise_to_clean_up(number: int, frame: FrameType | None) -> None:
    """Python's handler; that of all other cases is `_serve`, which waits for no bytecode."""
    if _CLEANS_UP.is_set() and not _RAISED.is_set():
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
