"""The daemon's subscribers and publishers of its cell's streams."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from zenoh.handlers import RingChannel

from service.client import publisher
from service.contract import channels, ros2
from service.contract.cdr import encode_joints
from service.contract.joint_states import JointStates
from service.contract.messages import JointState, PoseStamped, WireError
from service.core.frame import Event, Frame, Record
from service.daemon.ros2_domain import Ros2Domain
from service.settings.config import Settings

KEPT_DELAYS = 256  # the delays of this many messages are stored
CLOCK_STEP_NS = 100_000_000  # a delay this far below the minimum shows a clock that was set
HELD_UP_NS = 50_000_000  # a message was held up if its delay exceeds that of the next by this
MAX_SAMPLE_BYTES = 4096  # limit of a message of a hand or of joints
ARM_STATE = "joints/state"
CONFIGURED: Mapping[str, Callable[[Settings], bool]] = {  # channels that are heard with some settings only
    ARM_STATE: lambda settings: settings.arm.source == "state",
    "joints/guided": lambda settings: settings.arm.source == "state",
    "clutch": lambda settings: settings.hands.clutch == "key",
    "gripper/wish": lambda settings: settings.hands.gripper == "key",
}
# After a hold-up a network delivers many messages at once. A tick reads at most the newest of them.
MAX_ARRIVALS = 4  # messages of a hand
MAX_JOINT_STATES = 16  # messages of the arm's topic, on which grippers and other parts may publish too


class Arrivals:
    """Statistics of the messages received on one channel. The loop writes, other threads read."""

    __slots__ = ("_delays", "at_ns", "count", "malformed", "newest", "why")

    def __init__(self) -> None:
        self._delays: deque[tuple[int, int]] = deque(maxlen=KEPT_DELAYS)  # stamp, arrival - stamp [ns]
        self.count = self.malformed = self.at_ns = 0
        self.newest: PoseStamped | JointState | None = None
        self.why = ""

    def take(self, message: PoseStamped | JointState | bool | float, at_ns: int) -> None:
        """Note a message and its arrival by the system clock [ns]; of a clutch, a wish or a
        report of guiding, which have no stamp, only that it arrived.
        """
        if isinstance(message, PoseStamped | JointState):
            self.newest, self.at_ns = message, at_ns
            self._delays.append((message.stamp_ns, at_ns - message.stamp_ns))
        self.count += 1

    def held_up_s(self, accepted_ns: int, stamp_ns: int) -> float | None:
        """Extra delay [s] of the message stamped `accepted_ns`, compared with the later message
        stamped `stamp_ns`; None if a clock was set between them.

        No delay is shorter than the minimum: a message with a shorter delay has a stamp from a
        clock that was set. Before the first messages, the minimum delay is assumed to be 0.
        """
        delays = tuple(self._delays)
        stamps = [stamp for stamp, _ in delays]
        if accepted_ns not in stamps or stamp_ns not in stamps:
            return None
        accepted = stamps.index(accepted_ns)
        min_delay_ns = min((delay for _, delay in delays[:accepted]), default=0)
        delay_ns = delays[stamps.index(stamp_ns)][1]
        held_up_ns = delays[accepted][1] - delay_ns
        is_delay = held_up_ns > HELD_UP_NS and delay_ns > min_delay_ns - CLOCK_STEP_NS
        return held_up_ns / 1e9 if is_delay else None

    def refuse(self, why: str) -> None:
        """Note bytes that cannot be decoded, and the reason."""
        self.why = why
        self.count += 1
        self.malformed += 1


class CellStreams:
    """A cell's subscribers and publishers, also in the ROS 2 domain if its settings name one.

    `receive` and `publish` are for the loop. Each message is counted in `arrivals`, by channel;
    `failed` is called with the message of an error on another thread.
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
        self._joints = JointStates(settings.joints.names, settings.arm.silent_ms / 1000)
        inputs = heard(settings)
        keys = [(channel, channels.key(cell, channel.key)) for channel in inputs]
        if domain is not None:
            topics = [ros2.of_channel(cell, channel) for channel in (*inputs, *ros2.SAID)]
            topics += [
                one for one in ros2.of_settings(settings.ros2) if not one.heard or settings.arm.source == "state"
            ]
            keys += [(channels.BY_KEY[one.channel], ros2.key(domain, one)) for one in topics if one.heard]
        self._subscribers = [
            (channel, session.declare_subscriber(key, RingChannel(_most(channel)))) for channel, key in keys
        ]
        self._publishers = {
            channel.key: publisher(session, cell, channel.key, priority=zenoh.Priority.REAL_TIME, express=True)
            for channel in channels.CHANNELS
            if channel.direction == "out"
        }
        self._ros2 = None if domain is None else Ros2Domain(session, settings, topics, failed=failed)

    def receive(self) -> list[Event]:
        """The hands' messages since the last call, and the newest state of the arm. Messages that
        cannot be decoded are counted.
        """
        events: list[Event] = []
        for channel, source in self._subscribers:
            arrived: list[Event] = []
            for _ in range(_most(channel)):
                if (sample := source.try_recv()) is None:
                    break
                if event := self._decoded(channel, sample):
                    arrived.append(event)
            events += arrived[-1:] if channel.key == ARM_STATE else arrived
        return events

    def _decoded(self, channel: channels.Channel, sample: Any) -> Event | None:
        arrivals = self._arrivals[channel.key]
        try:
            if len(sample.payload) > MAX_SAMPLE_BYTES:
                raise WireError(f"{len(sample.payload)} bytes, at most {MAX_SAMPLE_BYTES} accepted")
            payload, at_ns = sample.payload.to_bytes(), time.time_ns()
            message = channel.codec.decode(payload)
            if channel.key == ARM_STATE:
                state = self._joints.take(message, at_ns / 1e9) or self._joints.incomplete(message, at_ns / 1e9)
                if state is None:
                    return None
                if state is not message:
                    message, payload = state, encode_joints(state)
            event = self.newest[channel.key] = Event(channel.key, payload, message)
            arrivals.take(message, at_ns)
            return event
        except WireError as error:
            arrivals.refuse(str(error))
            return None

    def publish(self, suffix: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish on a channel; a message that cannot be sent at once is dropped."""
        self._publishers[suffix].put(payload, attachment=attachment)
        if self._ros2 is not None:
            self._ros2.publish(suffix, payload)

    def show(self, frame: Frame, state: Record) -> None:
        """Publish the frames of arm, hands and target for RViz and similar tools. Not for the
        loop.
        """
        if self._ros2 is not None:
            self._ros2.show(frame, state)

    @property
    def is_followed(self) -> bool:
        """True if the commands have a subscriber."""
        return bool(self._publishers["joints/command"].matching_status.matching)  # type: ignore[attr-defined]

    def close(self) -> None:
        """End the threads beside the loop."""
        if self._ros2 is not None:
            self._ros2.close()


def heard(settings: Settings) -> list[channels.Channel]:
    """The input channels of the loop that a cell with these settings subscribes to."""
    return [c for c in ros2.HEARD if c.key not in CONFIGURED or CONFIGURED[c.key](settings)]


def _most(channel: channels.Channel) -> int:
    """Largest number of messages of a channel that are read in one tick."""
    return MAX_JOINT_STATES if channel.key == ARM_STATE else MAX_ARRIVALS
