"""A cell as ROS 2 sees it through rmw_zenoh: names of its topics on Zenoh, what rides with each
message, and the liveliness tokens by which tools list them. For Iron and later.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Sequence

from service.contract import channels

LAST_DOMAIN = 232
NODE = "thirdhand"
TYPE_HASHES = {  # of the definitions, as REP 2011 has them; Humble has none
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
HEARD = tuple(channel for channel in channels.CHANNELS if channel.direction == "in" and channel.event)
SAID = tuple(channel for channel in channels.CHANNELS if channel.direction == "out")
_DEPTH = 10
_RELIABLE, _BEST_EFFORT = f"::,{_DEPTH}:,:,:,,", f"2::,{_DEPTH}:,:,:,,"  # the rest as ROS 2 has it by default
_ATTACHMENT = struct.Struct("<qqB16s")
_PART = "[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*"


def is_name(cell: str) -> bool:
    """Whether a cell's name may stand before the names of ROS 2 topics."""
    return re.fullmatch(f"{_PART}(?:/{_PART})*", cell) is not None


def type_of(channel: channels.Channel) -> str:
    """The message type of a channel's topic: the channel's own, JSON within a String."""
    return channels.STRING.type if channel.codec.encoding == "json" else channel.codec.type


def key(domain: int, cell: str, channel: channels.Channel) -> str:
    """The Zenoh key of a channel's topic in a domain."""
    return f"{domain}/{channels.key(cell, channel.key)}/{_typed(channel)}"


def all_tokens(domain: int) -> str:
    """The key expression of all liveliness tokens in a domain."""
    return f"@ros2_lv/{domain}/**"


def tokens(domain: int, cell: str, session: str, heard: Sequence[channels.Channel]) -> dict[str, str]:
    """The liveliness tokens of the daemon of a Zenoh session, by channel: of those in `heard` it is
    a subscriber, of all that go out a publisher. The node's own is under "".
    """
    node = f"%/{_mangled(f'/{cell}')}/{NODE}"
    found = {"": f"@ros2_lv/{domain}/{session}/0/0/NN/{node}"}
    for number, channel in enumerate((*heard, *SAID), start=1):
        kind, quality = ("MS", _BEST_EFFORT) if channel in heard else ("MP", _RELIABLE)
        topic = _mangled(f"/{channels.key(cell, channel.key)}")
        found[channel.key] = f"@ros2_lv/{domain}/{session}/0/{number}/{kind}/{node}/{topic}/{_typed(channel)}/{quality}"
    return found


def gid(token: str) -> bytes:
    """The 16 bytes by which the publisher of a token is known."""
    return hashlib.blake2b(token.encode(), digest_size=16).digest()


def encode_attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """33 bytes, little endian, without which rmw_zenoh takes in no message: its number, when it was
    published [ns], its publisher.
    """
    return _ATTACHMENT.pack(sequence, time_ns, len(gid), gid)


def _typed(channel: channels.Channel) -> str:
    kind = type_of(channel)
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_/RIHS01_{TYPE_HASHES[kind]}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
