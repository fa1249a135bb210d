"""The weight of this process against others."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

AHEAD_NICE = -15  # 28 times the weight of an ordinary thread


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
