"""The publishers of one stream: a hand that two trackers publish is followed by the samples of one.

Each message of this library's trackers names its publisher, and so does each of a ROS 2 node behind
rmw_zenoh. All messages without a name count as one publisher's.
"""

from __future__ import annotations

import zenoh

from thirdhand.contract import ros2

TAKEOVER_S = 0.5  # another publisher is heard after a silence of this time


def identity(sample: zenoh.Sample) -> str:
    """The name of a message's publisher on the network; empty if the message has none."""
    if (source := sample.source_info) is not None:
        return str(source.source_id)
    if sample.attachment is not None:
        return ros2.publisher_of(sample.attachment.to_bytes())
    return ""


class SolePublisher:
    """The one publisher of a stream that is heard: the first one, until it is silent."""

    def __init__(self) -> None:
        self._name: str | None = None
        self._heard_s = 0.0

    def is_other(self, name: str, now_s: float) -> bool:
        """True if a message that came at `now_s` [s] is of another publisher than the one heard."""
        if self._name is not None and name != self._name and now_s - self._heard_s < TAKEOVER_S:
            return True
        self._name = name
        self._heard_s = now_s
        return False
