"""Published objects on the bench, passed on to recording and viewers beside the loop."""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh
from zenoh.handlers import RingChannel

from service.contract import channels
from service.contract.messages import WireError
from service.contract.requests import encode_json

OBJECTS_KEY = "objects"


class ObjectListener:
    """A subscriber that passes the newest objects to `note`, and each new decoding error to
    `say`.
    """

    def __init__(
        self, session: zenoh.Session, cell: str, *, note: Callable[[str, str, int], None], say: Callable[[str], None]
    ) -> None:
        self._key, self._error = channels.key(cell, OBJECTS_KEY), ""
        self._subscriber = session.declare_subscriber(self._key, RingChannel(1))
        self._note, self._say = note, say

    def poll(self) -> None:
        """Pass on the newest message since the last call, if there is one."""
        sample = self._subscriber.try_recv()
        if sample is None:
            return
        try:
            found = channels.BY_KEY[OBJECTS_KEY].codec.decode(sample.payload.to_bytes())
        except WireError as error:
            if str(error) != self._error:
                self._error = str(error)
                self._say(f"a message on {self._key} is not readable: {error}")
            return
        self._error = ""
        self._note(OBJECTS_KEY, encode_json(found).decode(), time.time_ns())
