"""Images of other programs, passed on to recording and viewers beside the loop."""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh
from zenoh.handlers import RingChannel

from service.contract.images import image_in
from service.contract.messages import WireError

WAITING_IMAGES = 32  # of each key between two polls; beyond it, the oldest are left out


class ForeignStreams:
    """Subscribers to the keys of `[recording] also`, whose images are passed to `send`, and each
    new error to `say`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: tuple[str, ...],
        *,
        send: Callable[[str, bytes, int], None],
        say: Callable[[str], None],
    ) -> None:
        self._subscribers = {key: session.declare_subscriber(key, RingChannel(WAITING_IMAGES)) for key in keys}
        self._errors: dict[str, str] = {}
        self._send, self._say = send, say

    def poll(self) -> None:
        """Pass on the images that arrived since the last call."""
        for key, subscriber in self._subscribers.items():
            for _ in range(WAITING_IMAGES):
                if (sample := subscriber.try_recv()) is None:
                    break
                now_ns = time.time_ns()
                try:
                    image = image_in(sample.payload.to_bytes(), now_ns)
                except WireError as error:
                    if self._errors.get(key) != str(error):
                        self._errors[key] = str(error)
                        self._say(f"a message on {key} is not recorded: {error}")
                    continue
                self._errors.pop(key, None)
                self._send(key, image, now_ns)
