"""A cell as a ROS 2 node of rmw_zenoh: its outputs are published on a thread beside the loop.

Its inputs come in by CellStreams, like those of other clients.
"""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Callable, Sequence

import zenoh

from service.client import ENCODINGS
from service.contract import cdr, channels, ros2
from service.daemon import supervised_thread
from service.daemon.clock import run_beside_real_time

MOST_WAITING = 256  # messages: half a second of commands
CLOSED_WITHIN_S = 2.0


class Ros2Domain:
    """The topics of a cell in a ROS 2 domain, with the liveliness tokens by which tools list them.

    `publish` is for the loop and never waits: beyond MOST_WAITING messages are dropped. `failed` is
    called with what ends the thread's work.
    """

    def __init__(
        self,
        session: zenoh.Session,
        cell: str,
        domain: int,
        *,
        heard: Sequence[channels.Channel],
        failed: Callable[[str], None],
    ) -> None:
        tokens = ros2.tokens(domain, cell, str(session.zid()), heard)
        self._publishers = {
            channel.key: session.declare_publisher(
                ros2.key(domain, cell, channel),
                encoding=ENCODINGS["cdr"],
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
            for channel in ros2.SAID
        }
        self._gids = {channel.key: ros2.gid(tokens[channel.key]) for channel in ros2.SAID}
        self._sent: Counter[str] = Counter()
        self._tokens = [session.liveliness().declare_token(token) for token in tokens.values()]
        self._waiting: queue.SimpleQueue[tuple[str, bytes] | None] = queue.SimpleQueue()
        self._thread = supervised_thread.start("ROS 2 thread", self._serve, failed)

    def publish(self, suffix: str, payload: bytes) -> None:
        """Publishes an output of a channel on its ROS 2 topic."""
        if self._waiting.qsize() < MOST_WAITING:
            self._waiting.put((suffix, payload))

    def close(self) -> None:
        """Ends the thread, and undeclares the tokens."""
        self._waiting.put(None)
        self._thread.join(CLOSED_WITHIN_S)
        for token in self._tokens:
            token.undeclare()  # type: ignore[no-untyped-call]

    def _serve(self) -> None:
        run_beside_real_time()
        while (item := self._waiting.get()) is not None:
            suffix, payload = item
            self._sent[suffix] += 1
            if channels.BY_KEY[suffix].codec.encoding == "json":
                payload = cdr.encode_string(payload.decode())
            attachment = ros2.encode_attachment(self._sent[suffix], time.time_ns(), self._gids[suffix])
            self._publishers[suffix].put(payload, attachment=attachment)
