"""Messages that the loop does not need, passed on to recording and viewers beside it: objects on
the bench, and images of other programs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import zenoh
from zenoh.handlers import RingChannel

from thirdhand.contract import channels
from thirdhand.contract.images import COMPRESSED_IMAGE, image_in
from thirdhand.contract.messages import WireError
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.requests import encode_json
from thirdhand.daemon.cell_streams import Arrivals
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import Settings

OBJECTS_KEY = "objects"
IMAGE_TYPES = f"JPEG, PNG or {COMPRESSED_IMAGE}"
WAITING_IMAGES = 32  # images of a key between two polls; beyond it, the oldest are left out


class SideStream:
    """A subscriber that passes the newest messages on one key, and their times [ns], to `take`, and
    counts them in `arrivals`; those for which `take` raises WireError, because they are not of the
    type `needed`, count as malformed. Between two polls, `waiting` messages are kept.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        take: Callable[[bytes, int], object],
        arrivals: Arrivals,
        *,
        needed: str,
        waiting: int = 1,
    ) -> None:
        self._subscriber = session.declare_subscriber(key, RingChannel(waiting))
        self._take = take
        self._arrivals = arrivals
        self._needed = needed
        self._waiting = waiting

    def poll(self, now_ns: int) -> None:
        """Pass on the messages that arrived since the last call, with the time now [ns]."""
        for _ in range(self._waiting):
            if (sample := self._subscriber.try_recv()) is None:
                return
            payload = sample.payload.to_bytes()
            try:
                self._take(payload, now_ns)
                self._arrivals.count += 1
            except WireError as error:
                refusal = Refusal(str(error), self._needed, payload, str(sample.encoding))
                self._arrivals.refuse(refusal)


def side_keys(settings: Settings) -> list[str]:
    """The channel of a cell's objects, and the keys of images in `[recording] also`."""
    return [OBJECTS_KEY, *settings.recording.also]


def side_streams(
    session: zenoh.Session, settings: Settings, scribe: Scribe, arrivals: Mapping[str, Arrivals]
) -> list[SideStream]:
    """The streams on `side_keys`, counted in `arrivals`."""

    def note_objects(payload: bytes, now_ns: int) -> None:
        scene = channels.BY_KEY[OBJECTS_KEY].codec.decode(payload)
        scribe.note(OBJECTS_KEY, encode_json(scene).decode(), now_ns)

    def record_image(key: str, payload: bytes, now_ns: int) -> None:
        scribe.image(key, image_in(payload, now_ns), now_ns)

    objects = SideStream(
        session,
        channels.key(settings.cell, OBJECTS_KEY),
        note_objects,
        arrivals[OBJECTS_KEY],
        needed=channels.OBJECTS.type,
    )
    return [
        objects,
        *(
            SideStream(
                session,
                key,
                functools.partial(record_image, key),
                arrivals[key],
                needed=IMAGE_TYPES,
                waiting=WAITING_IMAGES,
            )
            for key in settings.recording.also
        ),
    ]
