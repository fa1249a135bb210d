"""Requests and replies as JSON: their types, checked whole, with errors that say where.

And the status.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeAlias

import msgspec

from service.contract.explain import ExplainedError, explained, in_words
from service.contract.messages import Vector3
from service.contract.records import GONE_S, SIDES

_NAMES = {"accepted": "1 to 64 letters, digits, spaces and . _ -"}
STARTING = "starting: "  # how every answer of a daemon begins that is not ready yet
NORM = 1e-3  # by which that of a quaternion may differ from 1
TOLERANCE_M = 0.05  # a reference point nearer to a via-point gives way, unless said otherwise
Metre = Annotated[float, msgspec.Meta(ge=-10, le=10, extra={"accepted": "-10 to 10 m"})]
Point = tuple[Metre, Metre, Metre]
Turned = Annotated[float, msgspec.Meta(ge=-1.001, le=1.001, extra={"accepted": "-1 to 1"})]
Orientation = tuple[Turned, Turned, Turned, Turned]  # quaternion x y z w
Hands: TypeAlias = Literal["both", "left", "right"]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[\w .-]+\Z", extra=_NAMES)]


class ViaPoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """With the hands there, the tool goes there. Metres, frame `base`.

    With a `radius` it is a flat neighbourhood: the point and its twelve neighbours, one hand
    coordinate `radius` away each, whose tool position is the same, or moves with the hand named in
    `follow`. With an `orientation`, a quaternion x y z w of norm 1, the tool is turned so there;
    with a `gripper` that opens or closes there. Both hold for the neighbourhood too.
    """

    name: Name
    left: Point
    right: Point
    tool: Point
    std: Annotated[float, msgspec.Meta(ge=1e-5, le=1)] = 0.0001
    radius: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.0
    follow: Literal["none", "left", "right"] = "none"
    orientation: Orientation | None = None
    gripper: Literal["open", "closed"] | None = None

    def __post_init__(self) -> None:
        if self.orientation is not None and abs(math.hypot(*self.orientation) - 1.0) > NORM:
            norm = math.hypot(*self.orientation)
            raise ValueError(f"orientation: {list(self.orientation)} has norm {norm:.4g}; 1 needed (x y z w)")


class _Operation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="op"):
    pass


class Add(_Operation, frozen=True, tag="add"):
    """Teach via-points; all or nothing; a name given again replaces.

    A reference point nearer than `tolerance` [m] gives way.
    """

    points: Annotated[tuple[ViaPoint, ...], msgspec.Meta(min_length=1, max_length=100)]
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=10)] = TOLERANCE_M

    def __post_init__(self) -> None:
        names = [point.name for point in self.points]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise ValueError(f"$.points[{i}].name: {name!r} given twice, names once each needed")


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


class StageRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The task has come to the via-point of this name."""

    name: Name


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The empty request of hold, resume and reset."""


class ViaPointInForce(ViaPoint, frozen=True, kw_only=True):
    """A via-point in force, and how far the skill misses it [m], and its orientation [rad]."""

    missed_by_m: float
    missed_by_rad: float | None = None


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """The answer to a request: the tick from which it holds, and the via-points in force.

    `warnings` say which of them are missed by more than 5 mm, and which others were moved by more.
    Of hold, resume and reset: the mode that resulted, its reason, and a note where there was
    nothing to do.
    """

    tick: int
    points: tuple[ViaPointInForce, ...] | None = None
    warnings: tuple[str, ...] = ()
    mode: str = ""
    reason: str = ""
    note: str = ""


class RequestError(ExplainedError, ValueError):
    """A request that is not understood; the message says where in it."""


def decode_request(data: bytes, kind: Any) -> Any:
    """The request in JSON bytes, checked whole against its type.

    Raises RequestError like "$.points[0].left: 2 numbers, 3 needed".
    """
    try:
        given = msgspec.json.decode(data or b"{}")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"not JSON: {in_words(error, named=False)}") from None
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        raise RequestError(explained(error, given, kind)) from None


encode_json = msgspec.json.encode
"""JSON bytes of a request, reply or status."""


class Percentiles(msgspec.Struct, frozen=True):
    """p50, p99 and maximum over the last seconds; NaN-free: 0 before the first value."""

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """What comes in of one hand, or of the arm."""

    rate_hz: float = 0.0  # messages in the last second, accepted or not; of the arm, states of all its joints
    age_ms: float | None = None  # of the newest accepted sample; None: none yet
    fresh: bool = False  # whether that is young enough to go by
    clock_ms: float | None = None  # stamp to arrival, median of the last second; below 0: a clock that is ahead
    late_ms: float | None = None  # of a hand's newest 49 samples behind the quickest, mean; None: no steady clock
    late_95_ms: float | None = None  # of 95 in 100 of them at most
    frame: str = ""  # that the newest message names
    rejected: dict[str, int] = {}  # samples by cause, `malformed` among them
    cause: str = ""  # of the newest one rejected in the last second
    refused: str = ""  # that one in words: what came, and what is accepted
    advice: str = ""  # what to do about that one
    contested: float = 0.0  # share of the last second's samples that contradict the rest
    scatter_mm: float | None = None  # standard deviation of a hand's samples about its motion, each axis


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
    hands: Hands = "both"  # by which the skill goes
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
    because: str = ""  # the reason in words, with its figures
    remedy: str = ""  # what to do about it
    time_ns: int = 0  # when it was made, by the daemon's clock
    sources: dict[str, Source] = {}  # by `left`, `right` and, where it is measured, `arm`
    frames: tuple[str, ...] = ()  # in which a hand's pose may be; empty: as the tracker's
    joints: tuple[str, ...] = ()  # their names, in order
    hands_m: dict[str, Vector3] = {}  # as estimated at this tick, frame `base`; those that are seen
    demonstrated_m: dict[str, tuple[Vector3, Vector3]] = {}  # least and greatest corner of where each is known
    tool_m: Vector3 | None = None  # as commanded; None before the first tick
    tool_measured_m: Vector3 | None = None  # by the joints that the arm told last; None: none lately
    target_m: Vector3 | None = None  # None where a hand is not seen
    setpoint_m: Vector3 | None = None
    std_m: float | None = None  # of the target, root mean square over the axes
    turn_off_rad: float | None = None  # of the tool as commanded from how the target is turned, or where that points
    turn_std_rad: float | None = None  # of how the target is turned; None: the skill did not learn it
    gripper: str = ""  # `open` or `closed`, as commanded; empty: the skill knows of none
    closure: float | None = None  # of the gripper as predicted, 0 to 1
    stage: tuple[str, ...] = ()  # of the task: the via-points it comes from and goes to; empty: not known
    stage_belief: float = 0.0  # how probable that is
    deviation_m: float | None = None  # of the hands from what the skill knows
    threshold_m: float = 0.0  # a greater deviation is far from the demonstrations
    command_heard: bool = True  # whether anybody listens to `joints/command`
    busy: str = ""  # how the daemon's machine is too busy, or was when the arm stopped; empty: it is not

    @property
    def needed(self) -> tuple[str, ...]:
        """The hands that must be seen: those by which the skill goes, and any that was lately."""
        lately = {side for side, age_ms in self.hand_age_ms.items() if age_ms < 1000 * GONE_S}
        return tuple(side for side in SIDES if self.hands in ("both", side) or side in lately)
