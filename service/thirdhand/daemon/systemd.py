"""Notifications of systemd by its protocol sd_notify: datagrams to the socket $NOTIFY_SOCKET."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping


class Systemd:
    """The service manager, if it started this process with `Type=notify`; else nothing is sent."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        watchdog_us = environment.get("WATCHDOG_USEC", "")
        is_for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.ping_every_s = int(watchdog_us) / 2e6 if is_for_us and watchdog_us.isdecimal() else 0.0
        self._pinged_tick = -1
        self._ping_s = 0.0

    def notify(self, *assignments: str) -> None:
        """Send assignments like READY=1. Never waits; without a listener nothing happens."""
        if self._address:
            with (
                contextlib.suppress(OSError),
                socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender,
            ):
                sender.setblocking(False)
                sender.sendto("\n".join(assignments).encode(), self._address)

    def progressed(self, tick: int) -> None:
        """Ping twice in the watchdog's time, if the loop has taken another tick since the last
        ping: so a loop that stands still is noticed. Call it more often than that.
        """
        now_s = time.monotonic()
        if (
            self.ping_every_s
            and tick > self._pinged_tick
            and now_s >= self._ping_s + self.ping_every_s
        ):
            self._pinged_tick = tick
            self._ping_s = now_s
            self.notify("WATCHDOG=1")
