"""The table of channels: everything that is exchanged with other programs, enters the loop, or is
recorded.

Subscribers, publishers, queryables, kinds of events, topics of recordings and of ROS 2, staleness
and the table in docs/wire.md are derived from it. A new channel is one more line here. If it enters
the loop, it needs a case in `core.controller`; if the loop publishes on it, a function of
`outgoing`; if its message is new, a codec in `cdr`, a definition in `ros2msg` and, unless it is
only recorded, a hash in `ros2`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from thirdhand.contract import cdr, markers, requests

ENDPOINT = "tcp/127.0.0.1:7447"  # default endpoint of daemons and their clients
# the streams of a take
TAKE_KEYS = {
    "left": "hands/left",
    "right": "hands/right",
    "tool": "tool/pose",
}
LARGEST_REQUEST = 256 * 1024  # bytes
_LETTER = r"[^/*$?#\s\x00-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2066-\u2069\ufeff]"
CellName = Annotated[
    str,
    msgspec.Meta(
        pattern=rf"\A{_LETTER}+(/{_LETTER}+)*\Z",
        extra={
            "accepted": "words joined by single slashes, without spaces, control characters and * "
            "$ ? #,"
        },
    ),
]
_ENDPOINT = re.compile(r"(?s)^(?:([a-z0-9_-]+)(/|://))?(.*)$")
_ON_IP = ("tcp", "udp", "tls", "quic", "ws")  # protocols whose addresses end in a port
# key above the liveliness tokens of daemons, which are named by their Zenoh sessions
PRESENCE = "daemon"
PRESENCE_OF_ALL = f"**/{PRESENCE}/*"


class Codec(NamedTuple):
    """A message type with its encoder and decoder."""

    type: str  # of ROS 2, or JSON
    encoding: Literal["cdr", "json"]
    encode: Callable[..., bytes]
    decode: Callable[..., Any]


def _request(kind: Any) -> Codec:
    return Codec("JSON", "json", requests.encode_json, partial(requests.decode_request, kind=kind))


POSE = Codec("geometry_msgs/msg/PoseStamped", "cdr", cdr.encode_pose, cdr.decode_pose)
POSE_WITH_COVARIANCE = Codec(
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "cdr",
    cdr.encode_pose_with_covariance,
    cdr.decode_pose_with_covariance,
)
WISHED_POSE = POSE_WITH_COVARIANCE._replace(decode=cdr.decode_wish)
JOINTS = Codec("sensor_msgs/msg/JointState", "cdr", cdr.encode_joints, cdr.decode_joints)
CLOSURE = Codec(JOINTS.type, "cdr", cdr.encode_joints, cdr.decode_closure)
BOOL = Codec("std_msgs/msg/Bool", "cdr", cdr.encode_bool, cdr.decode_bool)
STRING = Codec("std_msgs/msg/String", "cdr", cdr.encode_string, cdr.decode_string)
TRANSFORMS = Codec("tf2_msgs/msg/TFMessage", "cdr", cdr.encode_transforms, cdr.decode_transforms)
OBJECTS = Codec(
    "visualization_msgs/msg/MarkerArray", "cdr", markers.encode_objects, markers.decode_objects
)
TICK = Codec("thirdhand/msg/Tick", "cdr", cdr.encode_tick, cdr.decode_tick)
# `tick` in recordings that leave out frames
CHECKED_TICK = TICK._replace(type="thirdhand/msg/CheckedTick")
SKILL = Codec("thirdhand/msg/Skill", "cdr", cdr.encode_skill, cdr.decode_skill)
FRAME, TIMING, STATE = (
    Codec(f"thirdhand/msg/{name}", "cdr", cdr.encode_record, cdr.decode_record)
    for name in ("Frame", "Timing", "State")
)


class EventKind(NamedTuple):
    """A kind of event that enters the loop: its permanent number in recordings, and its codec
    there.
    """

    number: int
    codec: Codec


class Channel(NamedTuple):
    """A row of the table."""

    # below the cell, or a topic of recordings if it begins with a slash; also the kind of event
    key: str
    codec: Codec
    direction: Literal["in", "out", "request", "recording"]
    about: str
    rate: str = "on demand"  # in words
    every: int = 0  # ticks between messages; 0: not published by the loop
    event: EventKind | None = None  # None: nothing enters the loop here
    # setting (section, name) with the time after which the source is silent
    stale_after: tuple[str, str] | None = None
    # setting (section, name) and the value with which the channel is heard; None: with any
    heard_with: tuple[str, str, str] | None = None
    queryable: bool = False
    recorded: bool = True

    @property
    def condition(self) -> str:
        """The setting with which the channel is heard, as it is written; empty if with any."""
        if self.heard_with is None:
            return ""
        section, name, value = self.heard_with
        return f'`[{section}] {name} = "{value}"`'

    @property
    def kept_as(self) -> Codec:
        """The codec of this channel in recordings."""
        return self.event.codec if self.event else self.codec


_HAND: Any = {"rate": "30 - 500 Hz", "stale_after": ("hands", "stale_ms")}

CHANNELS = (
    Channel(
        "hands/left",
        POSE,
        "in",
        "the user's left hand in the tracker's frame (`base` unless configured)",
        event=EventKind(0, POSE),
        **_HAND,
    ),
    Channel("hands/right", POSE, "in", "the user's right hand", event=EventKind(1, POSE), **_HAND),
    Channel(
        "joints/state",
        JOINTS,
        "in",
        "the arm's joints as measured",
        rate="100 - 1000 Hz",
        event=EventKind(2, JOINTS),
        stale_after=("arm", "silent_ms"),
        heard_with=("arm", "source", "state"),
    ),
    Channel(
        "joints/guided",
        BOOL,
        "in",
        "true while the arm is led by hand",
        rate="with joints/state",
        event=EventKind(12, BOOL),
        stale_after=("arm", "silent_ms"),
        heard_with=("arm", "source", "state"),
    ),
    Channel(
        "clutch",
        BOOL,
        "in",
        "true while the clutch is pressed",
        rate="10 - 100 Hz",
        event=EventKind(10, BOOL),
        stale_after=("hands", "clutch_stale_ms"),
        heard_with=("hands", "clutch", "key"),
    ),
    Channel(
        "joints/command",
        JOINTS,
        "out",
        "position [rad] and velocity [rad/s]; silent until the arm is ready",
        rate="every tick",
        every=1,
    ),
    Channel(
        "tool/target",
        POSE_WITH_COVARIANCE,
        "out",
        "what the skill predicts from both hands, and how sure it is",
        rate="every 5th tick",
        every=5,
    ),
    Channel(
        "tool/setpoint", POSE, "out", "the target after smoothing", rate="every 5th tick", every=5
    ),
    Channel(
        "gripper/command",
        JOINTS,
        "out",
        "its joint `gripper`: 0 is open, 1 closed; silent where neither the skill nor a wish "
        "decides it",
        rate="every 5th tick",
        every=5,
    ),
    Channel(
        "gripper/wish",
        CLOSURE,
        "in",
        "its joint `gripper`: how far to close where the skill does not decide it, 0 to 1",
        rate="1 - 100 Hz",
        event=EventKind(11, CLOSURE),
        heard_with=("hands", "gripper", "key"),
    ),
    Channel(
        "tool/wish",
        WISHED_POSE,
        "in",
        "where a policy wants the tool at the time of the stamp, up to 1 s ahead; also PoseStamped",
        rate="10 - 1000 Hz, or in chunks",
        event=EventKind(14, WISHED_POSE),
        stale_after=("skill", "silent_ms"),
        heard_with=("skill", "source", "tool/wish"),
    ),
    Channel(
        "gripper/state",
        JOINTS,
        "in",
        "how far the gripper is closed, 0 to 1, in demonstrations",
        rate="teaching",
        recorded=False,
    ),
    Channel(
        "tool/pose",
        POSE,
        "in",
        "the tool as measured, in demonstrations",
        rate="teaching",
        recorded=False,
    ),
    Channel(
        "objects",
        OBJECTS,
        "in",
        "objects on the bench, for viewers: boxes, ellipsoids, cylinders",
        rate="1 - 30 Hz",
    ),
    Channel(
        "status",
        _request(requests.Nothing),
        "out",
        "mode, reason, flags, rates, latency percentiles, counters",
        rate="10 Hz, and on request",
        queryable=True,
    ),
    Channel(
        "via_points",
        _request(requests.ViaPointsRequest),
        "request",
        "add, remove, clear and list via-points",
        queryable=True,
        recorded=False,
    ),
    Channel(
        "skill",
        _request(requests.SkillRequest),
        "request",
        "load a skill from the skill folder; via-points stay with the skill they were taught to",
        event=EventKind(3, SKILL),
        queryable=True,
    ),
    Channel(
        "hold",
        _request(requests.HoldRequest),
        "request",
        "stop and stay",
        event=EventKind(4, STRING),
        queryable=True,
    ),
    Channel(
        "resume",
        _request(requests.HoldRequest),
        "request",
        "end an operator's hold",
        event=EventKind(5, STRING),
        queryable=True,
    ),
    Channel(
        "reset",
        _request(requests.Nothing),
        "request",
        "end a fault; confirm that the arm is to leave what it stands in",
        event=EventKind(6, STRING),
        queryable=True,
    ),
    Channel(
        "begin",
        _request(requests.Nothing),
        "request",
        "the task begins now",
        event=EventKind(13, STRING),
        queryable=True,
    ),
    Channel(
        "segment",
        _request(requests.SegmentRequest),
        "request",
        "the task has come to a via-point, whatever it seems",
        event=EventKind(9, STRING),
        queryable=True,
    ),
    Channel(
        "correct",
        _request(requests.CorrectRequest),
        "request",
        "in a hold: the tool belongs where it was led, or dragged, to; undo the last correction",
        queryable=True,
        recorded=False,
    ),
    Channel(
        "fault",
        STRING,
        "recording",
        "what of the service itself failed",
        event=EventKind(7, STRING),
    ),
    Channel(
        "way",
        STRING,
        "recording",
        "postures out of a place where it was stuck",
        event=EventKind(8, STRING),
    ),
    Channel(
        "tick",
        TICK,
        "recording",
        "index, event kinds, and the checksum of the frame",
        rate="every tick",
        every=1,
    ),
    Channel(
        "frame", FRAME, "recording", "all that the tick decided", rate="25 Hz, and each decision"
    ),
    Channel(
        "timing",
        TIMING,
        "recording",
        "how late it was and how long it took",
        rate="with frames, and late ticks",
    ),
    Channel("state", STATE, "recording", "all that the next frame depends on", rate="every 10 s"),
    Channel(
        "skill_in_force",
        SKILL,
        "recording",
        "the skill, where it may have changed",
        rate="after a gap",
    ),
    Channel("requests", STRING, "recording", "each request and how it was answered"),
    Channel("log", STRING, "recording", "what went wrong with the recording"),
    Channel(
        "/tf",
        TRANSFORMS,
        "recording",
        "the arm's links, tool, setpoint, target and hands, for viewers",
        rate="10 Hz",
        every=5,
    ),
    Channel("/robot_description", STRING, "recording", "the arm's URDF", rate="once"),
)
BY_KEY = {channel.key: channel for channel in CHANNELS}
EVENT_NUMBERS = {
    channel.key: channel.event.number for channel in CHANNELS if channel.event is not None
}
EVENT_KINDS = {number: key for key, number in EVENT_NUMBERS.items()}


# a daemon numbers a channel's messages by Zenoh's source information, modulo this
MESSAGE_NUMBERS = 2**32
LAST_PORT = 65535  # of IP


def lacking(endpoint: str) -> str:
    """The problem with a Zenoh endpoint, in words; empty if it is valid."""
    protocol, slashes, address = _ENDPOINT.findall(endpoint)[0]
    host, _, port = re.sub("[?#].*", "", address).rpartition(":")
    is_on_ip = protocol in _ON_IP
    if is_on_ip and port.isdecimal() and int(port) > LAST_PORT:
        return f"{endpoint!r} given; a port from 0 to {LAST_PORT} needed"
    if is_on_ip and not is_host(host.strip("[]")):
        return f"{endpoint!r} given; the name of a host or an IP address needed"
    if slashes == "/" and address and (not is_on_ip or re.fullmatch(".+:.+", address)):
        return ""
    proposal = _similar_endpoint(protocol if is_on_ip else "tcp", address)
    return (
        f"{endpoint!r} given; an endpoint of the form <protocol>/<address>:<port> needed: "
        f"{proposal} ?"
    )


def _similar_endpoint(protocol: str, address: str) -> str:
    """A valid endpoint with a host or port from an address that may lack either."""
    host, _, port = address.rpartition(":")
    if not host and not port.isdecimal():
        host = port
        port = "7447"
    return f"{protocol}/{host or '127.0.0.1'}:{port}"


def is_host(name: str) -> bool:
    """True if a host can have this name. For other names, the resolver raises UnicodeError."""
    try:
        name.encode("idna")
    except UnicodeError:
        return False
    return True


def tcp_address(endpoint: str) -> tuple[str, int] | None:
    """Host and port of an endpoint to which a TCP connection leads; None for others."""
    protocol, _, address = re.sub("[?#].*", "", endpoint).partition("/")
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    on_tcp = protocol in ("tcp", "tls", "ws")
    return (host, int(port)) if on_tcp and port.isdecimal() and is_host(host) else None


def key(cell: str, suffix: str) -> str:
    """The key expression of one channel of a cell."""
    return suffix if suffix.startswith("/") else f"{cell}/{suffix}"


def presence(cell: str, session: str = "*") -> str:
    """The key of the liveliness token with which the daemon of a Zenoh session serves a cell."""
    return key(cell, f"{PRESENCE}/{session}")


def topic(cell: str, suffix: str) -> str:
    """The topic of one channel in a recording, with a leading slash as in ROS 2."""
    return f"/{key(cell, suffix)}" if not suffix.startswith("/") else suffix


def keys_by_topic(cell: str, suffixes: Iterable[str]) -> dict[str, str]:
    """The channels' keys by their topics in a recording."""
    return {topic(cell, suffix): suffix for suffix in suffixes}


STREAMS = tuple(channel for channel in CHANNELS if channel.direction == "out" and channel.every)
"""Channels on which the loop publishes, every `every` ticks."""
