"""A cell as seen from ROS 2 through rmw_zenoh: its topics' keys on Zenoh, the attachment of each
message, and the liveliness tokens from which tools list topics. For Iron and later.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Collection, Iterable, Iterator
from typing import Any, NamedTuple

from thirdhand.contract import channels

LAST_DOMAIN = 232
NODE = "thirdhand"
TYPE_HASHES = {  # hashes of the definitions by REP 2011; Humble has none
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "std_msgs/msg/Bool": "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "trajectory_msgs/msg/JointTrajectory": "179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
# stands for the hash in the keys of Humble, whose subscribers match no hash
NO_TYPE_HASH = "TypeHashNotSupported"
# frames of a cell, beside the arm's links
OWN_FRAMES = ("left_hand", "right_hand", "setpoint", "target", "tool")
# channels whose messages may be frames of TFMessages
FRAMES = ("hands/left", "hands/right", "tool/pose")
HEARD = tuple(
    channel for channel in channels.CHANNELS if channel.direction == "in" and channel.event
)
SAID = tuple(channel for channel in channels.CHANNELS if channel.direction == "out")
_DEPTH = 10
# qualities of service in the tokens of topics; what is left out has the default of ROS 2
_RELIABLE = f"::,{_DEPTH}:,:,:,,"
_BEST_EFFORT = f"2::,{_DEPTH}:,:,:,,"
_LATCHED = ":1:,1:,:,:,,"  # reliable, transient local: later subscribers get the last message
_ATTACHMENT = struct.Struct("<qqB16s")
_PART = "[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*"


class Topic(NamedTuple):
    """A topic: its full name, its message type and the channel of its messages. The cell subscribes
    if `heard`, and publishes otherwise. Later subscribers of a `latched` topic get the last
    message. Of a TFMessage that is heard, the transforms of one `frame` are the channel's messages.
    """

    name: str
    type: str
    channel: str
    heard: bool = False
    latched: bool = False
    every: int = 1  # one of this number of the channel's messages is published
    frame: str = ""


SET = (  # the setting with the beginning of a topic's name, and the topic with its end
    ("position_commands", Topic("", "std_msgs/msg/Float64MultiArray", "joints/command")),
    ("trajectory", Topic("", "trajectory_msgs/msg/JointTrajectory", "joints/command")),
    ("joint_states", Topic("", "sensor_msgs/msg/JointState", "joints/state", heard=True)),
    ("tf", Topic("", channels.TRANSFORMS.type, "/tf")),
    ("tf", Topic("_static", channels.TRANSFORMS.type, "/tf_static", latched=True)),
    ("robot_description", Topic("", "std_msgs/msg/String", "/robot_description", latched=True)),
    ("diagnostics", Topic("", "diagnostic_msgs/msg/DiagnosticArray", "status", every=10)),
)


def of_settings(settings: Any) -> Iterator[Topic]:
    """The topics named in a cell's settings: those of ros2_control, RViz and rqt, and of frames
    that are hands or tool.
    """
    for setting, topic in SET:
        if name := getattr(settings, setting):
            yield topic._replace(name=name + topic.name)
    for channel, source in zip(FRAMES, (*settings.hands, settings.tool), strict=True):
        name, _, frame = source.partition(":")
        if frame:
            yield Topic(name, channels.TRANSFORMS.type, channel, heard=True, frame=frame)


def heard(cell: str, settings: Any, suffixes: Collection[str]) -> list[Topic]:
    """The topics on which a cell with these settings receives messages of some channels."""
    cell_topics = [of_channel(cell, channel) for channel in HEARD if channel.key in suffixes]
    return cell_topics + [
        topic for topic in of_settings(settings) if topic.heard and topic.channel in suffixes
    ]


def of_channel(cell: str, channel: channels.Channel) -> Topic:
    """A channel's own topic."""
    return Topic(
        channels.topic(cell, channel.key), type_of(channel), channel.key, channel.direction == "in"
    )


def is_name(cell: str) -> bool:
    """True if a cell's name is a valid beginning of ROS 2 topics."""
    return re.fullmatch(f"{_PART}(?:/{_PART})*", cell) is not None


def type_of(channel: channels.Channel) -> str:
    """The message type of a channel's topic: the channel's own, JSON within a String."""
    return channels.STRING.type if channel.codec.encoding == "json" else channel.codec.type


def key(domain: int, topic: Topic) -> str:
    """The Zenoh key of a topic in a domain."""
    return f"{domain}{topic.name}/{_typed(topic)}"


def kept(key: str) -> str:
    """The key expression of the latched messages of a publisher of this key."""
    return f"{key}/@adv/**"


def all_tokens(domain: int) -> str:
    """The key expression of all liveliness tokens in a domain."""
    return f"@ros2_lv/{domain}/**"


def tokens(
    domain: int, cell: str, session: str, topics: Iterable[Topic]
) -> dict[tuple[str, bool], str]:
    """The liveliness tokens of the daemon of a Zenoh session, by the topic's name and whether it is
    heard; its node's is under ("", False).
    """
    node = f"%/{_mangled(f'/{cell}')}/{NODE}"
    by_topic = {("", False): f"@ros2_lv/{domain}/{session}/0/0/NN/{node}"}
    for number, topic in enumerate(
        {(candidate.name, candidate.heard): candidate for candidate in topics}.values(), start=1
    ):
        kind, quality = (
            ("MS", _BEST_EFFORT)
            if topic.heard
            else ("MP", _LATCHED if topic.latched else _RELIABLE)
        )
        topic_part = f"{_mangled(topic.name)}/{_typed(topic)}/{quality}"
        by_topic[topic.name, topic.heard] = (
            f"@ros2_lv/{domain}/{session}/0/{number}/{kind}/{node}/{topic_part}"
        )
    return by_topic


def gid(token: str) -> bytes:
    """The 16 bytes that identify the publisher of a token."""
    return hashlib.blake2b(token.encode(), digest_size=16).digest()


def encode_attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """The 33 bytes, little endian, that rmw_zenoh requires with each message: its number, publish
    time [ns] and publisher.
    """
    return _ATTACHMENT.pack(sequence, time_ns, len(gid), gid)


def publisher_of(attachment: bytes) -> str:
    """The publisher that an attachment of rmw_zenoh names, in hexadecimal; empty for others."""
    return attachment[-16:].hex() if len(attachment) == _ATTACHMENT.size else ""


def _typed(topic: Topic) -> str:
    package, _, name = topic.type.split("/")
    return f"{package}::msg::dds_::{name}_/RIHS01_{TYPE_HASHES[topic.type]}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
