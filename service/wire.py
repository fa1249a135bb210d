"""The contract with every client: key expressions, messages and their encoding.

Streams are ROS 2 messages in CDR (little endian), requests and replies JSON. `CHANNELS` is the one table of what exists; keys, rates, recording and
documentation derive from it.
"""

from __future__ import annotations

import struct
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import msgspec

from service.cdr import (
    BASE,
    CDR_HEADER,
    JOINT_NAMES,
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Vector3,
    Vector7,
    WireError,
    decode_joints,
    decode_pose,
    decode_pose_with_covariance,
    decode_string,
    encode_command,
    encode_joints,
    encode_pose,
    encode_pose_with_covariance,
    encode_string,
    finite,
    in_chain_order,
)  # fmt: skip
from service.config import ExplainedError
from service.explain import explained

__all__ = [
    "BASE",
    "CDR_HEADER",
    "CHANNELS", "DECODERS",
    "JOINTS",
    "JOINT_NAMES",
    "JSON",
    "POSE",
    "POSE_COV",
    "Add",
    "Attachment",
    "Channel",
    "Clear",
    "JointState",
    "List",
    "Metre",
    "Name",
    "Nothing",
    "Percentiles",
    "Point",
    "PoseStamped",
    "PoseWithCovarianceStamped",
    "Quaternion",
    "Remove",
    "Reply",
    "RequestError",
    "SkillRequest",
    "Status",
    "TaughtPoint",
    "Vector3",
    "Vector7",
    "ViaPoint",
    "ViaPointsRequest",
    "WireError",
    "decode_attachment",
    "decode_joints",
    "decode_pose",
    "decode_pose_with_covariance",
    "decode_request",
    "decode_string",
    "encode_attachment",
    "encode_command",
    "encode_joints",
    "encode_json",
    "encode_pose",
    "encode_pose_with_covariance",
    "encode_string",
    "finite",
    "in_chain_order",
    "key",
]  # fmt: skip


class Channel(NamedTuple):
    """One line of the wire: key below the cell, message type, who sends it and how often, and whether a recording holds it."""

    key: str
    type: str
    direction: Literal["in", "out", "request"]
    rate: str
    recorded: bool
    about: str


POSE, POSE_COV, JOINTS, JSON = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "sensor_msgs/msg/JointState",
    "JSON",
)
CHANNELS = (
    Channel("hands/left", POSE, "in", "30 - 500 Hz", True, "the user's left hand in the tracker's frame (`base` unless configured)"),
    Channel("hands/right", POSE, "in", "30 - 500 Hz", True, "the user's right hand"),
    Channel("joints/state", JOINTS, "in", "100 - 1000 Hz", True, "the arm's joints as measured"),
    Channel("joints/command", JOINTS, "out", "every tick", True, "position [rad] and velocity [rad/s]; silent until the arm is ready"),
    Channel("tool/target", POSE_COV, "out", "every 5th tick", True, "what the skill predicts from both hands, and how sure it is"),
    Channel("tool/setpoint", POSE, "out", "every 5th tick", True, "the target after smoothing"),
    Channel("tool/pose", POSE, "in", "teaching", False, "the tool as measured, in demonstrations"),
    Channel("status", JSON, "out", "10 Hz, and on request", True, "mode, reason, flags, rates, latency percentiles, counters"),
    Channel("via_points", JSON, "request", "", True, "add, remove, clear and list taught places"),
    Channel("skill", JSON, "request", "", True, "load a skill from the skill folder; places stay with the skill they were taught to"),
    Channel("hold", JSON, "request", "", True, "stop and stay"),
    Channel("resume", JSON, "request", "", True, "end an operator's hold"),
    Channel("reset", JSON, "request", "", True, "end a fault"),
)

DECODERS = {"hands/left": decode_pose, "hands/right": decode_pose, "joints/state": decode_joints}  # of what enters the loop


def key(cell: str, suffix: str) -> str:
    """The key expression of one channel of a cell."""
    return f"{cell}/{suffix}"


# --- attachments of outputs ------------------------------------------------------------------------------------------------

_ATTACHMENT = struct.Struct("<Qqq")


class Attachment(NamedTuple):
    """What rides with every output: tick index, publish time [ns], stamp of the newest hand sample it answers [ns] (0: none)."""

    tick: int
    published_ns: int
    hand_stamp_ns: int


def encode_attachment(value: Attachment) -> bytes:
    """24 bytes, little endian."""
    return _ATTACHMENT.pack(*value)


def decode_attachment(data: bytes) -> Attachment:
    """The attachment in 24 bytes. Raises WireError."""
    if len(data) != _ATTACHMENT.size:
        raise WireError(f"an attachment of {len(data)} bytes, {_ATTACHMENT.size} needed")
    return Attachment(*_ATTACHMENT.unpack(data))


# --- requests and replies --------------------------------------------------------------------------------------------------

_NAMES = {"accepted": "1 to 64 letters, digits, spaces and . _ -"}
Metre = Annotated[float, msgspec.Meta(ge=-10, le=10, extra={"accepted": "-10 to 10 m"})]
Point = tuple[Metre, Metre, Metre]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[\w .-]+\Z", extra=_NAMES)]


class ViaPoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A taught place: with the hands there, the tool goes there. Metres, frame `base`.

    With a `radius` the place is a flat neighbourhood: the point and its twelve neighbours, one hand coordinate `radius` away each, whose tool
    position is the same, or moves with the hand named in `follow`.
    """

    name: Name
    left: Point
    right: Point
    tool: Point
    std: Annotated[float, msgspec.Meta(ge=1e-6, le=1)] = 0.0001
    radius: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.0
    follow: Literal["none", "left", "right"] = "none"


class _Operation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="op"):
    pass


class Add(_Operation, frozen=True, tag="add"):
    """Teach places; all or nothing; a name given again replaces. A reference point nearer than `tolerance` [m] gives way."""

    points: Annotated[tuple[ViaPoint, ...], msgspec.Meta(min_length=1, max_length=100)]
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.05


class Remove(_Operation, frozen=True, tag="remove"):
    """Forget places by name; all or nothing."""

    names: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=100)]


class Clear(_Operation, frozen=True, tag="clear"):
    """Forget all places."""


class List(_Operation, frozen=True, tag="list"):
    """Tell the places in force."""


ViaPointsRequest: TypeAlias = Add | Remove | Clear | List


class SkillRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Load another skill: the name of a file in the skill folder."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128, pattern=r"\A\w[\w .-]*\Z", extra=_NAMES)]


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The empty request of hold, resume and reset."""


class TaughtPoint(ViaPoint, frozen=True, kw_only=True):
    """A place in force, and how far the skill misses it [m]."""

    missed_by_m: float


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """The answer to a request: the tick from which it holds, and the places in force."""

    tick: int
    points: tuple[TaughtPoint, ...] | None = None


class RequestError(ExplainedError, ValueError):
    """A request that is not understood; the message names the place in it."""


def decode_request(data: bytes, kind: Any) -> Any:
    """The request in JSON bytes, checked whole against its type. Raises RequestError like "$.points[0].left: 2 numbers, 3 needed"."""
    try:
        given = msgspec.json.decode(data or b"{}")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"not JSON: {error}") from None
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        raise RequestError(explained(error, given, kind)) from None


def encode_json(value: Any) -> bytes:
    """JSON bytes of a request, reply or status."""
    return msgspec.json.encode(value)


class Percentiles(msgspec.Struct, frozen=True):
    """p50, p99 and maximum over the last seconds; NaN-free: 0 before the first value."""

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """What `<cell>/status` carries."""

    cell: str
    mode: str
    reason: str
    flags: tuple[str, ...]
    tick: int
    rate_hz: float
    missed: int
    realtime: bool
    skill: str
    places: tuple[str, ...]
    rejected: dict[str, int]
    hand_age_ms: dict[str, float]
    lateness_us: Percentiles
    work_us: Percentiles
    latency_ms: Percentiles  # hand stamp to command published; tells of clocks too, where they are not one
    scribe: dict[str, Any]
    endpoints: tuple[str, ...]
    version: str
