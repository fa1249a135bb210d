"""Requests and replies as JSON: their types, checked whole, with errors that say where.

And the status.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec

from service.contract.explain import ExplainedError, explained

_NAMES = {"accepted": "1 to 64 letters, digits, spaces and . _ -"}
TOLERANCE_M = 0.05  # a reference point nearer to a via-point gives way, unless said otherwise
Metre = Annotated[float, msgspec.Meta(ge=-10, le=10, extra={"accepted": "-10 to 10 m"})]
Point = tuple[Metre, Metre, Metre]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[\w .-]+\Z", extra=_NAMES)]


class ViaPoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """With the hands there, the tool goes there. Metres, frame `base`.

    With a `radius` it is a flat neighbourhood: the point and its twelve neighbours, one hand
    coordinate `radius` away each, whose tool position is the same, or moves with the hand named in
    `follow`.
    """

    name: Name
    left: Point
    right: Point
    tool: Point
    std: Annotated[float, msgspec.Meta(ge=1e-5, le=1)] = 0.0001
    radius: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.0
    follow: Literal["none", "left", "right"] = "none"


class _Operation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="op"):
    pass


class Add(_Operation, frozen=True, tag="add"):
    """Teach via-points; all or nothing; a name given again replaces.

    A reference point nearer than `tolerance` [m] gives way.
    """

    points: Annotated[tuple[ViaPoint, ...], msgspec.Meta(min_length=1, max_length=100)]
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=10)] = TOLERANCE_M


class Remove(_Operation, frozen=True, tag="remove"):
    """Forget via-points by name; all or nothing."""

    names: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=100)]


class Clear(_Operation, frozen=True, tag="clear"):
    """Forget all via-points."""


class List(_Operation, frozen=True, tag="list"):
    """Tell the via-points in force."""


ViaPointsRequest: TypeAlias = Add | Remove | Clear | List


class SkillRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Load another skill: the name of a file in the skill folder."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128, pattern=r"\A\w[\w .-]*\Z", extra=_NAMES)]


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The empty request of hold, resume and reset."""


class ViaPointInForce(ViaPoint, frozen=True, kw_only=True):
    """A via-point in force, and how far the skill misses it [m]."""

    missed_by_m: float


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """The answer to a request: the tick from which it holds, and the via-points in force.

    `warnings` say which of them are missed by more than 5 mm, and which others were moved by more.
    """

    tick: int
    points: tuple[ViaPointInForce, ...] | None = None
    warnings: tuple[str, ...] = ()


class RequestError(ExplainedError, ValueError):
    """A request that is not understood; the message says where in it."""


def decode_request(data: bytes, kind: Any) -> Any:
    """The request in JSON bytes, checked whole against its type.

    Raises RequestError like "$.points[0].left: 2 numbers, 3 needed".
    """
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
    memory_locked: bool
    skill: str
    places: tuple[str, ...]
    rejected: dict[str, int]
    received: dict[str, int] = {}  # messages that the loop took, by channel; of many in one tick the newest
    hand_age_ms: dict[str, float]
    hand_distance_m: float  # of the nearest hand from the arm; 3 at most, and where none is seen
    hand_limit_m_s: float  # least speed toward a hand that is allowed at some part of the arm
    lateness_us: Percentiles
    work_us: Percentiles
    latency_ms: Percentiles  # hand stamp to command published; tells of clocks too, where they are not one
    scribe: dict[str, Any]
    endpoints: tuple[str, ...]
    version: str
