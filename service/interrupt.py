"""Ctrl-C at any moment: one line and exit 130, never a traceback.

A command that has nothing to put away ends at once, also while it imports or waits in a library
that keeps Python's own handler from running. One that started processes puts them away first; a
second Ctrl-C does not wait for that.
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
_PUTS_AWAY, _RAISED = threading.Event(), threading.Event()


def end_at_once() -> NoReturn:
    """Ends this process with one line, without regard to what it does."""
    with contextlib.suppress(OSError):
        os.write(2, b"\nthirdhand: interrupted\n" if os.isatty(2) else b"thirdhand: interrupted\n")
    os._exit(EXIT_CODE)


def watch() -> None:
    """From here on SIGINT ends this process so; until some other handler takes its place.

    For the main thread, before all that takes time.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as in the background of a shell, or another's
    told, tell = os.pipe()
    os.set_blocking(tell, False)
    signal.signal(signal.SIGINT, _raise_to_put_away)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    threading.Thread(target=_serve, args=(told,), name="interrupts", daemon=True).start()


@contextlib.contextmanager
def put_away_first() -> Iterator[None]:
    """Within it the first SIGINT raises KeyboardInterrupt, so that what is open is closed."""
    _PUTS_AWAY.set()
    try:
        yield
    finally:
        _PUTS_AWAY.clear()


def too_late() -> None:
    """From here on SIGINT changes nothing: the command is done, and its exit code decided."""
    if signal.getsignal(signal.SIGINT) is _raise_to_put_away:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _raise_to_put_away(number: int, frame: FrameType | None) -> None:
    """Python's handler; that of all other cases is `_serve`, which waits for no bytecode."""
    if _PUTS_AWAY.is_set() and not _RAISED.is_set():
        _RAISED.set()
        raise KeyboardInterrupt


def _serve(told: int) -> None:
    count = 0
    while received := os.read(told, 64):
        if signal.getsignal(signal.SIGINT) is not _raise_to_put_away:
            continue
        count += received.count(signal.SIGINT)
        if count > 1 or (count and not _PUTS_AWAY.is_set()):
            end_at_once()
