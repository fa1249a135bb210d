"""Messages that the loop does not need, passed on to recording and viewers beside it: objects on
the bench, and images of other programs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import zenoh
from zenoh.handlers import RingChannel

from service.contract import channels
from service.contract.images import image_in
from service.contract.messages import WireError
from service.contract.requests import encode_json
from service.scribe.scribe import Scribe
from service.settings.config import Settings

OBJECTS_KEY = "objects"
WAITING_IMAGES = 32  # of each key between two polls; beyond it, the oldest are left out


class SideStream:
    """A subscriber that passes the newest messages on one key, and their times [ns], to `take`, and
    each new WireError of it to `say`. Between two polls, `waiting` messages are kept.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        take: Callable[[bytes, int], object],
        say: Callable[[str], None],
        *,
        waiting: int = 1,
    ) -> None:
        self._subscriber = session.declare_subscriber(key, RingChannel(waiting))
        self._key, self._take, self._say, self._waiting, self._error = key, take, say, waiting, ""

    def poll(self, now_ns: int) -> None:
        """Pass on the messages that arrived since the last call, with the time now [ns]."""
        for _ in range(self._waiting):
            if (sample := self._subscriber.try_recv()) is None:
                return
            before, self._error = self._error, ""
            try:
                self._take(sample.payload.to_bytes(), now_ns)
            except WireError as error:
                self._error = str(error)
                if self._error != before:
                    self._say(f"a message on {self._key} is not recorded: {error}")


def side_streams(
    session: zenoh.Session, settings: Settings, scribe: Scribe, say: Callable[[str], None]
) -> list[SideStream]:
    """The streams of a cell's objects, and of the images on the keys of `[recording] also`."""

    def note_objects(payload: bytes, now_ns: int) -> None:
        found = channels.BY_KEY[OBJECTS_KEY].codec.decode(payload)
        scribe.note(OBJECTS_KEY, encode_json(found).decode(), now_ns)

    def record_image(key: str, payload: bytes, now_ns: int) -> None:
        scribe.image(key, image_in(payload, now_ns), now_ns)

    objects = SideStream(session, channels.key(settings.cell, OBJECTS_KEY), note_objects, say)
    images = {key: functools.partial(record_image, key) for key in settings.recording.also}
    return [objects, *(SideStream(session, key, take, say, waiting=WAITING_IMAGES) for key, take in images.items())]
