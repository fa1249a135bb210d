"""The status of a cell, made by one thread, and newer than any request for it."""

from __future__ import annotations

import threading

# after this time without a new status, a request is answered with the last one
STATUS_TIMEOUT_S = 2.0
MIN_STATUS_INTERVAL_S = 0.02  # a flood of requests must not take the interpreter from the loop


class NewestStatus:
    """The status in bytes. One thread makes it: `wait`, `begin`, make it, publish it, `end`.

    Other threads get a status that was begun after their request.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._begun = self._made = 0
        self._is_wanted = self._is_published = self._is_over = False
        self._payload = b""

    def requested(self, *, published: bool = False) -> bytes:
        """A status that was begun after this call; if `published`, subscribers get it too."""
        with self._changed:
            number = self._begun + 1
            self._is_wanted = True
            self._is_published = self._is_published or published
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._made >= number or self._is_over, STATUS_TIMEOUT_S)
            return self._payload

    def wait(self, timeout_s: float) -> None:
        """Return once a status is requested, or after `timeout_s` [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_wanted or self._is_over, max(0.0, timeout_s))

    def begin(self) -> bool:
        """Begin a status; True if a request needs it to be published."""
        with self._changed:
            self._begun += 1
            is_published = self._is_published
            self._is_wanted = False
            self._is_published = False
            return is_published

    def end(self, payload: bytes) -> None:
        """End the status that was begun, with its bytes."""
        with self._changed:
            self._payload = payload
            self._made = self._begun
            self._changed.notify_all()

    def close(self) -> None:
        """End the making of statuses; requests are answered with the last one."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
