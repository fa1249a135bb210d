"""Threads of the service that report an exception and restart."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger("thirdhand")
RESTART_PAUSE_S = 0.1


def supervised(
    name: str,
    work: Callable[[], None],
    failed: Callable[[str], None],
    *,
    pause_s: float = RESTART_PAUSE_S,
) -> None:
    """Run `work` to its end.

    An exception is logged and passed to `failed`, and after `pause_s` [s] `work` starts again. An
    exception in `failed` is raised.
    """
    while True:
        try:
            return work()
        except Exception as error:
            log.exception("the %s failed", name)
            failed(f"the {name} failed: {error!r}")
        time.sleep(pause_s)


def start(name: str, work: Callable[[], None], failed: Callable[[str], None]) -> threading.Thread:
    """Start a thread that runs `work` supervised."""
    thread = threading.Thread(target=supervised, args=(name, work, failed), name=name, daemon=True)
    thread.start()
    return thread
