"""Threads of the service that are restarted, and the failure reported, after an exception."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger("thirdhand")
PAUSE_S = 0.1


def supervised(name: str, work: Callable[[], None], failed: Callable[[str], None], *, pause_s: float = PAUSE_S) -> None:
    """Runs `work` to its end.

    Where an exception ends it, that is logged, `failed` is called with it, and after `pause_s` [s]
    it starts again. An exception that `failed` raises ends it for good.
    """
    while True:
        try:
            return work()
        except Exception as error:
            log.exception("the %s failed", name)
            failed(f"the {name} failed: {error!r}")
        time.sleep(pause_s)


def start(name: str, work: Callable[[], None], failed: Callable[[str], None]) -> threading.Thread:
    """A started thread of `supervised` work."""
    thread = threading.Thread(target=supervised, args=(name, work, failed), name=name, daemon=True)
    thread.start()
    return thread
