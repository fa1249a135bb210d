"""A cell as a ROS 2 node of rmw_zenoh, whose outputs are published on a thread beside the loop.

CellStreams receives its inputs, like those of other clients.
"""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Callable, Sequence

import msgspec
import zenoh
from zenoh import ext

from thirdhand.client import ENCODINGS
from thirdhand.contract import cdr, ros2
from thirdhand.contract.incidents import in_brief, in_full
from thirdhand.contract.messages import in_order
from thirdhand.core.frame import Frame, Record
from thirdhand.daemon import supervised_thread
from thirdhand.daemon.clock import run_beside_real_time
from thirdhand.recordings.transforms import Frames
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import Settings, urdf_path

MAX_WAITING_MESSAGES = 256  # half a second of commands
CLOSED_WITHIN_S = 2.0
# as in rmw_zenoh: after this time a subscriber notices that it missed a latched message
HEARTBEAT_S = 0.5
DIAGNOSTIC_LEVELS = {"follow": 0, "hold": 1, "fault": 2}  # OK, WARN and ERROR of diagnostic_msgs
DIAGNOSED = (
    "mode",
    "reason",
    "flags",
    "tick",
    "rate_hz",
    "missed",
    "realtime",
    "lateness_us",
    "work_us",
    "latency_ms",
    "hand_age_ms",
    "hand_distance_m",
    "rejected",
    "received",
    "skill",
    "segment",
    "version",
)


def _diagnostics(payload: bytes) -> bytes:
    status = msgspec.json.decode(payload)
    values = {}
    for name in DIAGNOSED:
        inner = status[name] if isinstance(status[name], dict) else {"": status[name]}
        for part, value in inner.items():
            text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
            values[f"{name}.{part}".rstrip(".")] = text
    summary = in_brief(status["mode"], status["reason"]) + in_full(
        status["because"], status["remedy"]
    )
    name = f"{status['cell']}: {ros2.NODE}"
    return cdr.encode_diagnostics(
        status["time_ns"], DIAGNOSTIC_LEVELS[status["mode"]], name, summary, values
    )


def _converted(payload: bytes, topic: ros2.Topic, names: tuple[str, ...], period_ns: int) -> bytes:
    """A channel's message as that of a topic, which for most of them is the same."""
    match topic.channel, topic.type:
        case "joints/command", "std_msgs/msg/Float64MultiArray":
            return cdr.encode_numbers(in_order(cdr.decode_joints(payload), names)[0])
        case "joints/command", "trajectory_msgs/msg/JointTrajectory":
            return cdr.encode_trajectory(
                names, *in_order(cdr.decode_joints(payload), names), within_ns=period_ns
            )
        case "status", "std_msgs/msg/String":
            return cdr.encode_string(payload.decode())
        case "status", "diagnostic_msgs/msg/DiagnosticArray":
            return _diagnostics(payload)
    return payload


class Ros2Domain:
    """The topics of a cell in a ROS 2 domain, its own and those of the arm's controllers, with the
    liveliness tokens by which tools list them.

    `publish` is for the loop and never waits: beyond MAX_WAITING_MESSAGES it drops messages.
    `failed` is called with the message of an error on the thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        settings: Settings,
        topics: Sequence[ros2.Topic],
        *,
        failed: Callable[[str], None],
    ) -> None:
        domain = settings.network.ros2_domain
        assert domain is not None
        tokens = ros2.tokens(domain, settings.cell, str(session.zid()), topics)
        self._names = settings.ros2.joints or settings.joints.names
        self._period_ns = round(1e9 * settings.period_s)
        self._topics = [topic for topic in topics if not topic.heard]
        self._publishers = {
            topic.name: _publisher(session, ros2.key(domain, topic), topic)
            for topic in self._topics
        }
        self._gids = {topic.name: ros2.gid(tokens[topic.name, False]) for topic in self._topics}
        self._sent = Counter[str]()
        self._received = Counter[str]()
        self._tokens = [session.liveliness().declare_token(token) for token in tokens.values()]
        self._waiting: queue.SimpleQueue[tuple[str, bytes] | None] = queue.SimpleQueue()
        self._thread = supervised_thread.start("ROS 2 thread", self._serve, failed)
        urdf = description(urdf_path(settings), cover=False)
        links = bool(settings.ros2.robot_description)
        self._frames = Frames(settings, urdf, links=links) if settings.ros2.tf else None
        self.publish("/robot_description", cdr.encode_string(urdf))
        if self._frames is not None:
            self.publish("/tf_static", cdr.encode_transforms(time.time_ns(), self._frames.fixed))

    def show(self, frame: Frame, state: Record) -> None:
        """Publish all frames, for the measured joints or, without an arm, the commanded ones."""
        if self._frames is not None:
            joints = state["measured"] if state["arm_tick"] >= 0 else frame["joints"]
            frames = self._frames.moving(frame, joints.tolist())
            self.publish("/tf", cdr.encode_transforms(time.time_ns(), frames))

    def publish(self, suffix: str, payload: bytes) -> None:
        """Publish a message of a channel on its ROS 2 topics."""
        if self._waiting.qsize() < MAX_WAITING_MESSAGES:
            self._waiting.put((suffix, payload))

    def close(self) -> None:
        """Publish the waiting messages, end the thread, and undeclare the tokens."""
        self._waiting.put(None)
        self._thread.join(CLOSED_WITHIN_S)
        for token in self._tokens:
            token.undeclare()  # type: ignore[no-untyped-call]

    def _serve(self) -> None:
        run_beside_real_time()
        while (item := self._waiting.get()) is not None:
            suffix, payload = item
            for topic in (candidate for candidate in self._topics if candidate.channel == suffix):
                self._received[topic.name] += 1
                if self._received[topic.name] % topic.every:
                    continue
                self._sent[topic.name] += 1
                attachment = ros2.encode_attachment(
                    self._sent[topic.name], time.time_ns(), self._gids[topic.name]
                )
                message = _converted(payload, topic, self._names, self._period_ns)
                self._publishers[topic.name].put(message, attachment=attachment)


def _publisher(
    session: zenoh.Session, key: str, topic: ros2.Topic
) -> zenoh.Publisher | ext.AdvancedPublisher:
    """A publisher on a topic; for a latched topic it stores the last message for later
    subscribers.
    """
    drop = zenoh.CongestionControl.DROP
    if not topic.latched:
        return session.declare_publisher(
            key, encoding=ENCODINGS["cdr"], congestion_control=drop, express=True
        )
    return ext.declare_advanced_publisher(
        session,
        key,
        encoding=ENCODINGS["cdr"],
        cache=ext.CacheConfig(1),
        sample_miss_detection=ext.MissDetectionConfig(
            heartbeat=None, sporadic_heartbeat=HEARTBEAT_S
        ),
        publisher_detection=True,
    )
