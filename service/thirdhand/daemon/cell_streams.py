"""The daemon's subscribers and publishers of its cell's streams.

If two publishers report one hand, only the samples of one are used. Each message of this library's
trackers names its publisher, and so does each of a ROS 2 node behind rmw_zenoh. All messages
without a name are taken as those of one publisher.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from statistics import median
from typing import Any, TypeAlias

import numpy as np
import zenoh
from zenoh.handlers import RingChannel

from thirdhand.client import Publisher
from thirdhand.contract import cdr, channels, ros2
from thirdhand.contract.joint_states import JointStates
from thirdhand.contract.messages import JointState, PoseStamped, WireError
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.records import FARTHEST_WISH_S, SIDES
from thirdhand.core.frame import Event, Frame, Record
from thirdhand.daemon.ros2_domain import Ros2Domain
from thirdhand.settings.config import Settings

KEPT_DELAYS = 256  # the delays of this many messages are stored
CLOCK_STEP_NS = 100_000_000  # a delay this far below the minimum shows a clock that was set
HELD_UP_NS = 50_000_000  # a message was held up if its delay exceeds that of the next by this
TAKEOVER_S = 0.5  # another publisher of a hand is heard after a silence of this time
# a tracker measures no pose twice, bit for bit; over this time it is not the tracker's rate
FROZEN_S = 0.5
# a hand whose samples all differ for so long is measured; a program's hand rests exactly
TRACKED_S = 2.0
EXACT_REST_S = 0.1  # a pose that is repeated for so long is a rest
# a hand that was lost appears this many steps away; one that rested goes on from where it was
LEAP_STEPS = 5.0
SMOOTH_SHARE = 0.05  # a smooth step / the median step: noise makes one in 10 000 as small
# a last step / the distance from the origin below this is no measurement: a millionth of a metre
# for a hand one metre away
UNMEASURED_SHARE = 1e-6
LEAST_BATCHES = 3  # with fewer pauses than this, a hand was out of sight
ARM_STATE = "joints/state"
TOOL_WISH = "tool/wish"
# After a hold-up a network delivers many messages at once. `receive`, which a tick calls once or
# twice, reads at most the newest of them.
MAX_ARRIVALS = 4  # messages of a hand
MAX_WISHES = 128  # that wait; a chunk is long, and read over several ticks
MAX_WISHES_READ = 16  # at once
# messages of the arm's topic, on which grippers and other parts may publish too
MAX_JOINT_STATES = 16
# messages of a topic of transforms, on which all nodes publish: 64 ms at 1 kHz
MAX_TRANSFORM_MESSAGES = 64


class Arrivals:
    """Statistics of the messages received on one channel. The loop writes, other threads read."""

    __slots__ = ("_delays", "at_ns", "count", "frozen", "malformed", "newest", "others", "refusal")

    def __init__(self) -> None:
        # stamp, arrival - stamp [ns]
        self._delays: deque[tuple[int, int]] = deque(maxlen=KEPT_DELAYS)
        # messages: all; not decoded; of a lost hand; of another publisher. Arrival of `newest` [ns]
        self.count = self.malformed = self.frozen = self.others = self.at_ns = 0
        self.newest: PoseStamped | JointState | None = None
        self.refusal = Refusal("", "")  # the newest malformed message

    def take(self, message: PoseStamped | JointState | bool | float, at_ns: int) -> None:
        """Note a message and its arrival by the system clock [ns]. Messages of a clutch, a wish or
        guiding have no stamp, and are only counted.
        """
        if isinstance(message, PoseStamped | JointState):
            self.newest = message
            self.at_ns = at_ns
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

    def batches_ms(self, accepted_ms: float) -> float:
        """Interval [ms] of the batches in which messages arrive: the median of the pauses between
        arrivals that are longer than accepted; 0 with fewer than three of them.
        """
        arrivals_ms = (
            np.array([stamp_ns + delay_ns for stamp_ns, delay_ns in tuple(self._delays)]) / 1e6
        )
        pauses_ms = np.diff(arrivals_ms)
        long_ms = pauses_ms[pauses_ms > accepted_ms]
        return float(np.median(long_ms)) if len(long_ms) >= LEAST_BATCHES else 0.0

    def is_set_back(self, accepted_ns: int) -> bool:
        """True if all messages after the one stamped `accepted_ns` are stamped before it, and there
        are several: the source's clock was set back. A second source would take turns with it.
        """
        stamps = [stamp for stamp, _ in tuple(self._delays)]
        later = stamps[stamps.index(accepted_ns) + 1 :] if accepted_ns in stamps else []
        return len(later) > 1 and max(later) < accepted_ns

    def refuse(self, refusal: Refusal) -> None:
        """Note a message that cannot be decoded."""
        self.refusal = refusal
        self.count += 1
        self.malformed += 1


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

    def is_other(self, name: str, now_s: float, ahead_s: float = 0.0) -> bool:
        """True if a message that came at `now_s` [s] is of another publisher than the one heard.

        A wish that is due in `ahead_s` [s] leads until then. One that is too far ahead or late will
        be rejected, and keeps nobody out.
        """
        if self._name is not None and name != self._name and now_s - self._heard_s < TAKEOVER_S:
            return True
        if abs(ahead_s) <= FARTHEST_WISH_S:
            self._name = name
            self._heard_s = max(now_s + ahead_s, now_s, self._heard_s)
        return False


class FrozenHand:
    """Detection of a tracker that has lost a hand and repeats its last pose, or a pose of its own.

    A program's hands rest exactly: repeated poses are accepted if the hand came to rest smoothly,
    if its stream began with a rest, or if most rests so far ended without a leap. `learn` applies
    the same rule to takes.
    """

    def __init__(self, publisher: str = "") -> None:
        self.publisher = publisher
        self._pose: PoseStamped | None = None  # the newest pose that differs from the one before
        # distances between poses that differ, in the tracker's unit
        self._steps: deque[float] = deque(maxlen=50)
        self._repeated_ns = 0  # stamp of the newest repetition of that pose
        self._varies_since_ns = 0  # stamp since which each sample differs from the one before
        self._is_tracked = False
        self._begins_exactly = False  # the stream began with a rest, as that of a page does
        self._rests = self._leaps = 0

    def is_frozen(self, pose: PoseStamped) -> bool:
        """True if a sample repeats the pose of a lost hand."""
        before = self._pose
        if before is None:
            self._varies_since_ns = pose.stamp_ns
        elif (pose.position, pose.orientation) == (before.position, before.orientation):
            self._repeated_ns = self._varies_since_ns = pose.stamp_ns
            lasts_s = (pose.stamp_ns - before.stamp_ns) / 1e9
            is_exact = self._begins_exactly or 2 * self._leaps < self._rests
            if not self._is_tracked or lasts_s < FROZEN_S or is_exact:
                return False
            smooth = max(
                SMOOTH_SHARE * median(self._steps),
                UNMEASURED_SHARE * math.hypot(*pose.position),
            )
            return self._steps[-1] > smooth
        else:
            step = math.dist(pose.position, before.position)
            if self._repeated_ns - before.stamp_ns >= 1e9 * EXACT_REST_S:
                self._begins_exactly |= not self._steps
                self._rests += 1
                self._leaps += bool(self._steps) and step > LEAP_STEPS * median(self._steps)
            self._steps.append(step)
            # the tracker's clock may be set back
            self._varies_since_ns = min(self._varies_since_ns, pose.stamp_ns)
            self._is_tracked |= pose.stamp_ns - self._varies_since_ns >= 1e9 * TRACKED_S
        self._pose = pose
        self._repeated_ns = pose.stamp_ns
        return False


Transforms: TypeAlias = tuple[dict[str, str], Any]  # channels by frame, and the subscriber


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
        cell = settings.cell
        domain = settings.network.ros2_domain
        self._arrivals = arrivals
        self._frozen = {f"hands/{side}": FrozenHand() for side in SIDES}
        self._sole = {key: SolePublisher() for key in (*self._frozen, TOOL_WISH)}
        self._joints = JointStates(settings.joints.names, settings.arm.silent_ms / 1000)

        inputs = [channel.key for channel in heard(settings)]
        keys = [(suffix, channels.key(cell, suffix)) for suffix in inputs]
        topics: list[ros2.Topic] = []
        self._transforms: list[Transforms] = []
        if domain is not None:
            topics = ros2.heard(cell, settings.ros2, inputs)
            keys += [
                (topic.channel, ros2.key(domain, topic)) for topic in topics if not topic.frame
            ]
            self._transforms = _transforms(session, domain, topics)
        self._subscribers = [
            (
                suffix,
                session.declare_subscriber(
                    key, RingChannel(MAX_WISHES if suffix == TOOL_WISH else _most(suffix))
                ),
            )
            for suffix, key in keys
        ]
        self._publishers = _publishers(session, cell)
        self._ids = {key: publisher.id for key, publisher in self._publishers.items()}
        self._sent = Counter[str]()  # messages by channel
        topics += _published_topics(settings)
        self._ros2 = (
            None if domain is None else Ros2Domain(session, settings, topics, failed=failed)
        )

    def receive(self, earlier: Sequence[Event] = ()) -> list[Event]:
        """The `earlier` messages and those since the last call; of the arm's states only the
        newest. Messages that cannot be decoded are counted.
        """
        events = list(earlier)
        for suffix, source in self._subscribers:
            arrived: list[Event] = []
            for sample in _waiting(source, _most(suffix)):
                publisher = identity(sample) if suffix in self._sole else ""
                if (event := self._decoded(suffix, sample.payload, publisher, sample)) is not None:
                    arrived.append(event)
            if arrived and suffix == ARM_STATE:
                arrived = arrived[-1:]
                events = [event for event in events if event.kind != ARM_STATE]
            events += arrived
        for by_frame, source in self._transforms:
            for suffix, payload, publisher in self._poses(by_frame, source):
                if (event := self._decoded(suffix, payload, publisher)) is not None:
                    events.append(event)
        return events

    def _poses(self, by_frame: Mapping[str, str], source: Any) -> list[tuple[str, bytes, str]]:
        """The poses in the messages of a topic of transforms: channel, message and publisher. Only
        the newest messages with a frame of `by_frame` are decoded: most are of other nodes.
        """
        named: list[tuple[bytes, list[str], str]] = []
        for sample in _waiting(source, MAX_TRANSFORM_MESSAGES):
            payload = sample.payload.to_bytes()
            if frames := [frame for frame in by_frame if cdr.bytes_of_frame(frame) in payload]:
                named.append((payload, frames, identity(sample)))

        poses: dict[str, deque[tuple[str, bytes, str]]] = {}
        for payload, frames, publisher in named[-MAX_ARRIVALS:]:
            try:
                for frame, pose in cdr.decode_transforms(payload, tuple(frames)):
                    newest = poses.setdefault(frame, deque(maxlen=MAX_ARRIVALS))
                    newest.append((by_frame[frame], cdr.encode_pose(pose), publisher))
            except WireError as error:
                for frame in frames:
                    refusal = Refusal(str(error), channels.TRANSFORMS.type, payload)
                    self._arrivals[by_frame[frame]].refuse(refusal)
        return [pose for newest in poses.values() for pose in newest]

    def _decoded(
        self, suffix: str, raw: Any, publisher: str, sample: zenoh.Sample | None = None
    ) -> Event | None:
        """The event of a message; None if it is refused, or completes no state of the arm. `sample`
        has the name of its encoding, for a refusal.
        """
        channel = channels.BY_KEY[suffix]
        arrivals = self._arrivals[suffix]
        payload = b""
        try:
            if len(raw) > cdr.MAX_BYTES:
                raise WireError(f"{len(raw)} bytes, at most {cdr.MAX_BYTES} accepted")
            payload = bytes(raw)
            message = channel.codec.decode(payload)
            now_s = time.monotonic()
            if suffix == ARM_STATE:
                state = self._joints.take(message, now_s) or self._joints.incomplete(message, now_s)
                if state is None:
                    return None
                if state is not message:
                    message = state
                    payload = cdr.encode_joints(state)
        except WireError as error:
            encoding = "" if sample is None else str(sample.encoding)
            arrivals.refuse(Refusal(str(error), channel.codec.type, payload, encoding))
            return None

        # Of two publishers of a hand, only one is heard; the pose of a lost hand is not used.
        at_ns = time.time_ns()
        sole = self._sole.get(suffix)
        ahead_s = 0.0
        if suffix == TOOL_WISH and message.stamp_ns:
            ahead_s = (message.stamp_ns - at_ns) / 1e9
        if sole is not None and sole.is_other(publisher, now_s, ahead_s):
            arrivals.others += 1
            arrivals.count += 1
            return None
        arrivals.take(message, at_ns)
        hand = self._frozen.get(suffix)
        if hand is not None and hand.publisher != publisher:
            hand = self._frozen[suffix] = FrozenHand(publisher)
        if hand is not None and hand.is_frozen(message):
            arrivals.frozen += 1
            return None
        return Event(suffix, payload, message)

    def publish(self, suffix: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish on a channel; a message that cannot be sent at once is dropped."""
        number = self._sent[suffix] % channels.MESSAGE_NUMBERS
        self._sent[suffix] += 1
        source = zenoh.SourceInfo(self._ids[suffix], number)
        self._publishers[suffix].put(payload, attachment=attachment, source_info=source)
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


def _publishers(session: zenoh.Session, cell: str) -> dict[str, zenoh.Publisher]:
    """The publishers of a cell's outputs, by channel."""
    outputs = [channel.key for channel in channels.CHANNELS if channel.direction == "out"]
    priority = zenoh.Priority.REAL_TIME
    return {key: Publisher(session, cell, key, priority=priority).zenoh for key in outputs}


def _transforms(
    session: zenoh.Session, domain: int, topics: Iterable[ros2.Topic]
) -> list[Transforms]:
    """The subscribers of topics that carry transforms, each with the channels of its frames."""
    channels_of: dict[str, dict[str, str]] = {}
    for topic in topics:
        if topic.frame:
            channels_of.setdefault(ros2.key(domain, topic), {})[topic.frame] = topic.channel
    remote = zenoh.Locality.REMOTE  # the cell may publish frames of its own on the same topic
    return [
        (
            by_frame,
            session.declare_subscriber(
                key, RingChannel(MAX_TRANSFORM_MESSAGES), allowed_origin=remote
            ),
        )
        for key, by_frame in channels_of.items()
    ]


def _published_topics(settings: Settings) -> list[ros2.Topic]:
    """The topics on which a cell publishes in its ROS 2 domain."""
    own_topics = [ros2.of_channel(settings.cell, channel) for channel in ros2.SAID]
    return own_topics + [topic for topic in ros2.of_settings(settings.ros2) if not topic.heard]


def heard(settings: Settings) -> list[channels.Channel]:
    """The input channels of the loop that a cell with these settings subscribes to."""
    return [channel for channel in ros2.HEARD if _is_heard(channel, settings)]


def _is_heard(channel: channels.Channel, settings: Settings) -> bool:
    """True unless the channel is heard with another setting only."""
    if channel.heard_with is None:
        return True
    section, name, value = channel.heard_with
    return bool(getattr(getattr(settings, section), name) == value)


def _most(suffix: str) -> int:
    """Largest number of messages of a channel that are read at once."""
    most = {ARM_STATE: MAX_JOINT_STATES, TOOL_WISH: MAX_WISHES_READ}
    return most.get(suffix, MAX_ARRIVALS)


def _waiting(source: Any, most: int) -> Iterator[zenoh.Sample]:
    """The samples that wait in a ring, at most this number."""
    for _ in range(most):
        if (sample := source.try_recv()) is None:
            return
        yield sample
