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
from service.config import Settings
from service.contract import cdr, channels, ros2
from service.contract.messages import JointState, in_order
from service.daemon import supervised_thread
from service.daemon.clock import run_beside_real_time

MOST_WAITING = 256  # messages: half a second of commands
CLOSED_WITHIN_S = 2.0


def _as_numbers(message: JointState, names: tuple[str, ...], period_ns: int) -> bytes:
    return cdr.encode_numbers(in_order(message, names)[0])


def _as_trajectory(message: JointState, names: tuple[str, ...], period_ns: int) -> bytes:
    return cdr.encode_trajectory(names, *in_order(message, names), within_ns=period_ns)


_CONTROLLERS = {  # how a controller's commands are made of the cell's own, by message type
    "std_msgs/msg/Float64MultiArray": _as_numbers,
    "trajectory_msgs/msg/JointTrajectory": _as_trajectory,
}


class Ros2Domain:
    """The topics of a cell in a ROS 2 domain, its own and those of the arm's controllers, with the
    liveliness tokens by which tools list them.

    `publish` is for the loop and never waits: beyond MOST_WAITING messages are dropped. `failed` is
    called with what ends the thread's work.
    """

    def __init__(
        self, session: zenoh.Session, settings: Settings, topics: Sequence[ros2.Topic], *, failed: Callable[[str], None]
    ) -> None:
        domain = settings.network.ros2_domain
        assert domain is not None
        tokens = ros2.tokens(domain, settings.cell, str(session.zid()), topics)
        self._names = settings.ros2.joints or settings.joints.names
        self._period_ns = round(1e9 * settings.period_s)
        self._topics = [topic for topic in topics if not topic.heard]
        self._publishers = {
            topic.name: session.declare_publisher(
                ros2.key(domain, topic),
                encoding=ENCODINGS["cdr"],
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
            for topic in self._topics
        }
        self._gids = {topic.name: ros2.gid(tokens[topic.name]) for topic in self._topics}
        self._sent: Counter[str] = Counter()
        self._tokens = [session.liveliness().declare_token(token) for token in tokens.values()]
        self._waiting: queue.SimpleQueue[tuple[str, bytes] | None] = queue.SimpleQueue()
        self._thread = supervised_thread.start("ROS 2 thread", self._serve, failed)

    def publish(self, suffix: str, payload: bytes) -> None:
        """Publishes an output of a channel on its ROS 2 topics."""
        if self._waiting.qsize() < MOST_WAITING:
            self._waiting.put((suffix, payload))

    def close(self) -> None:
        """Ends the thread, once all that waits is published, and undeclares the tokens."""
        self._waiting.put(None)
        self._thread.join(CLOSED_WITHIN_S)
        for token in self._tokens:
            token.undeclare()  # type: ignore[no-untyped-call]

    def _serve(self) -> None:
        run_beside_real_time()
        while (item := self._waiting.get()) is not None:
            suffix, payload = item
            for topic in self._topics:
                if topic.channel != suffix:
                    continue
                self._sent[topic.name] += 1
                attachment = ros2.encode_attachment(self._sent[topic.name], time.time_ns(), self._gids[topic.name])
                self._publishers[topic.name].put(self._message(topic, payload), attachment=attachment)

    def _message(self, topic: ros2.Topic, payload: bytes) -> bytes:
        """What a topic carries of a channel's message."""
        if topic.type in _CONTROLLERS:
            return _CONTROLLERS[topic.type](cdr.decode_joints(payload), self._names, self._period_ns)
        if channels.BY_KEY[topic.channel].codec.encoding == "json":
            return cdr.encode_string(payload.decode())
        return payload
