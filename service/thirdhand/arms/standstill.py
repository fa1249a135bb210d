"""A loop that an arm's method holds up: it is said, and ended where it shall stop."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable

from thirdhand.process.own_class import own_lines

STANDS_S = 2.0  # a loop stands still if no period ends within this time
LOOK_EVERY_S = 0.1


class Standstill:
    """Watches the loop of the calling thread around an arm, until `close`.

    If it stands still, `say` says once which method has not returned; if it shall `stop` then,
    `interrupt` is called, once every STANDS_S.
    """

    def __init__(
        self,
        arm: type,
        *,
        stop: threading.Event,
        say: Callable[[str], None],
        interrupt: Callable[[], None],
    ) -> None:
        self._arm = arm
        self._stop = stop
        self._say = say
        self._interrupt = interrupt
        self._loop = threading.get_ident()
        self._moved_s = time.monotonic()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="standstill", daemon=True)
        self._thread.start()

    def moves(self) -> None:
        """A period has ended."""
        self._moved_s = time.monotonic()

    def close(self) -> None:
        """End watching."""
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        reported_s = interrupted_s = 0.0
        while not self._closed.wait(LOOK_EVERY_S):
            moved_s = self._moved_s
            now_s = time.monotonic()
            if now_s - moved_s < STANDS_S:
                continue
            if reported_s != moved_s and self._report():
                reported_s = moved_s
            if self._stop.is_set() and now_s - interrupted_s > STANDS_S:
                interrupted_s = now_s
                self._interrupt()

    def _report(self) -> bool:
        """Say which method has not returned; False if none of the arm's class runs."""
        stack = sys._current_frames()[self._loop]  # noqa: SLF001 - in Python's documentation
        frames = list(traceback.walk_stack(stack))
        method, line = own_lines(reversed(frames), self._arm)
        if method:
            self._say(f"{method} has not returned for {STANDS_S:g} s, at {line}")
        return bool(method)
