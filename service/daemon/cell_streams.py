"""The daemon's ends of its cell's streams: reads what came, publishes each tick's outputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from zenoh.handlers import RingChannel

from service.client import publisher
from service.config import Settings
from service.contract import channels, ros2
from service.contract.messages import JointState, PoseStamped, WireError
from service.core.frame import Event, Frame, Record
from service.daemon.ros2_domain import Ros2Domain

LARGEST_MESSAGE = 4096  # bytes of a hand or joint message
ARM = "joints/state"
MOST_ARRIVALS = 4  # of a hand in a tick, the newest: what a network held back comes at once; a flood costs no tick


class Arrivals:
    """What came in on one channel. The loop writes, other threads read."""

    __slots__ = ("at_ns", "count", "malformed", "newest", "why")

    def __init__(self) -> None:
        self.count = self.malformed = self.at_ns = 0
        self.newest: PoseStamped | JointState | None = None
        self.why = ""

    def take(self, message: PoseStamped | JointState, at_ns: int) -> None:
        """One message, and when it came by the system clock [ns]."""
        self.newest, self.at_ns = message, at_ns
        self.count += 1

    def refuse(self, why: str) -> None:
        """Bytes that are no message."""
        self.why = why
        self.count += 1
        self.malformed += 1


class CellStreams:
    """A cell's subscribers and publishers, in a ROS 2 domain too where its settings name one.

    `receive` and `publish` are for the loop. Each message is counted in `arrivals`, by channel;
    `failed` is called with what fails on another thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        settings: Settings,
        *,
        arrivals: Mapping[str, Arrivals],
        failed: Callable[[str], None],
    ) -> None:
        cell, domain = settings.cell, settings.network.ros2_domain
        self._arrivals = arrivals
        self.newest: dict[str, Event] = {}
        inputs = [c for c in ros2.HEARD if c.key != ARM or settings.arm.source == "state"]
        keys = [(channel, channels.key(cell, channel.key)) for channel in inputs]
        if domain is not None:
            topics = [ros2.of_channel(cell, channel) for channel in (*inputs, *ros2.SAID)]
            topics += [
                one for one in ros2.of_settings(settings.ros2) if not one.heard or settings.arm.source == "state"
            ]
            keys += [(channels.BY_KEY[one.channel], ros2.key(domain, one)) for one in topics if one.heard]
        self._subscribers = [
            (channel, session.declare_subscriber(key, RingChannel(1 if channel.key == ARM else MOST_ARRIVALS)))
            for channel, key in keys
        ]
        self._publishers = {
            channel.key: publisher(session, cell, channel.key, priority=zenoh.Priority.REAL_TIME, express=True)
            for channel in channels.CHANNELS
            if channel.direction == "out"
        }
        self._ros2 = None if domain is None else Ros2Domain(session, settings, topics, failed=failed)

    def receive(self) -> list[Event]:
        """What came of the hands since the last call, and the arm's newest message; what can be
        decoded.
        """
        events: list[Event] = []
        for channel, source in self._subscribers:
            for _ in range(MOST_ARRIVALS):
                if (sample := source.try_recv()) is None:
                    break
                if event := self._decoded(channel, sample):
                    events.append(event)
        return events

    def _decoded(self, channel: channels.Channel, sample: Any) -> Event | None:
        arrivals = self._arrivals[channel.key]
        try:
            if len(sample.payload) > LARGEST_MESSAGE:
                raise WireError(f"{len(sample.payload)} bytes, at most {LARGEST_MESSAGE} accepted")
            payload = sample.payload.to_bytes()
            event = self.newest[channel.key] = Event(channel.key, payload, channel.codec.decode(payload))
            arrivals.take(event.value, time.time_ns())
            return event
        except WireError as error:
            arrivals.refuse(str(error))
            return None

    def publish(self, suffix: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Publishes on a channel; what cannot be sent at once is dropped."""
        self._publishers[suffix].put(payload, attachment=attachment)
        if self._ros2 is not None:
            self._ros2.publish(suffix, payload)

    def show(self, frame: Frame, state: Record) -> None:
        """Publishes, for RViz and the like, where everything is. Not for the loop."""
        if self._ros2 is not None:
            self._ros2.show(frame, state)

    @property
    def is_followed(self) -> bool:
        """Whether anybody subscribes to the commands."""
        return bool(self._publishers["joints/command"].matching_status.matching)  # type: ignore[attr-defined]

    def close(self) -> None:
        """Ends the threads beside the loop."""
        if self._ros2 is not None:
            self._ros2.close()
