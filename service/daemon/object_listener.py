"""What lies on the bench, as somebody tells it: handed to the recording and its viewers, beside the
loop, which it never enters.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh
from zenoh.handlers import RingChannel

from service.contract import channels
from service.contract.markers import LARGEST
from service.contract.messages import WireError
from service.contract.requests import encode_json

KEY = "objects"


class ObjectListener:
    """The newest that was told, noted; what is not understood is said, once until that changes."""

    def __init__(
        self,
        session: zenoh.Session,
        cell: str,
        *,
        note: Callable[[str, str, int], None],
        say: Callable[[str], None],
    ) -> None:
        self._key, self._said = channels.key(cell, KEY), ""
        self._told = session.declare_subscriber(self._key, RingChannel(1))
        self._note, self._say = note, say

    def look(self) -> None:
        """Notes what came since the last look, if anything did."""
        sample = self._told.try_recv()
        if sample is None:
            return
        try:
            if len(sample.payload) > LARGEST:
                raise WireError(f"{len(sample.payload)} bytes")
            found = channels.BY_KEY[KEY].codec.decode(sample.payload.to_bytes())
        except WireError as error:
            if str(error) != self._said:
                self._said = str(error)
                self._say(f"what came on {self._key} is not understood: {error}")
            return
        self._said = ""
        self._note(KEY, encode_json(found).decode(), time.time_ns())
