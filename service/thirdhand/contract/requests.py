"""Types of requests, replies and the status, as JSON; validation errors name the place."""

from __future__ import annotations

import codecs
import json
import math
from typing import Annotated, Any, Literal, TypeAlias

import msgspec

from thirdhand.contract.explain import ExplainedError, explained, in_words
from thirdhand.contract.messages import Vector3
from thirdhand.contract.records import GONE_S, SIDES

_NAMES = {"accepted": "1 to 64 letters, digits, spaces and . _ -"}
_NO_NAME = {"accepted": "a name of up to 64 letters, digits, spaces and . _ -"}
ANSWER_TIMEOUT_S = 30.0  # every request is answered within this time of its arrival
STARTING = "starting: "  # begins every answer of a daemon that is not ready yet
REQUEST_NORM_TOLERANCE = 1e-3  # accepted difference of a quaternion's norm from 1
MAX_REACH_M = 0.4  # hands farther away than this are not examined for the reach of a correction
TOLERANCE_M = 0.05  # by default, a via-point replaces reference points nearer than this
Metre = Annotated[float, msgspec.Meta(ge=-10, le=10, extra={"accepted": "-10 to 10 m"})]
Point = tuple[Metre, Metre, Metre]
Turned = Annotated[float, msgspec.Meta(ge=-1.001, le=1.001, extra={"accepted": "-1 to 1"})]
Orientation = tuple[Turned, Turned, Turned, Turned]  # quaternion x y z w
Hands: TypeAlias = Literal["both", "left", "right", "neither"]
Name = Annotated[
    str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[\w .-]+\Z", extra=_NAMES)
]


class ViaPoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Positions of both hands and the tool position that belongs to them [m], frame `base`.

    `std` is the standard deviation [m] of the tool position on each axis.

    With a `radius`, the via-point has a flat neighbourhood: twelve neighbours, each with one hand
    coordinate `radius` away. Their tool position is the same, or moves with the hand named in
    `follow`. `orientation` is the tool's, a quaternion x y z w of norm 1; `gripper` opens or closes
    the gripper there. Both apply to the neighbourhood too.

    With a `segment`, the name of a via-point of the task at which a segment begins, the via-point
    moves the tool in that segment only. `corrections` is the number of corrections that led to it.
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
    segment: Name | None = None
    corrections: Annotated[int, msgspec.Meta(ge=0, le=1000)] = 0

    def __post_init__(self) -> None:
        if (
            self.orientation is not None
            and abs(math.hypot(*self.orientation) - 1.0) > REQUEST_NORM_TOLERANCE
        ):
            norm = math.hypot(*self.orientation)
            raise ValueError(
                f"orientation: {list(self.orientation)} has norm {norm:.4g}; 1 needed (x y z w)"
            )


class _Operation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="op"):
    pass


class Add(_Operation, frozen=True, tag="add"):
    """Teach via-points, all or none. Each replaces a via-point of the same name, and reference
    points nearer than `tolerance` [m].
    """

    points: Annotated[tuple[ViaPoint, ...], msgspec.Meta(min_length=1, max_length=100)]
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=10)] = TOLERANCE_M

    def __post_init__(self) -> None:
        names = [point.name for point in self.points]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise ValueError(
                    f"$.points[{i}].name: {name!r} given twice, names once each needed"
                )


class Remove(_Operation, frozen=True, tag="remove"):
    """Remove via-points by name, all or none."""

    names: Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, max_length=100)]


class Clear(_Operation, frozen=True, tag="clear"):
    """Remove all via-points."""


class List(_Operation, frozen=True, tag="list"):
    """List the via-points in force."""


ViaPointsRequest: TypeAlias = Add | Remove | Clear | List


class SkillRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Load another skill: the name of a file in the skill folder."""

    name: Annotated[
        str, msgspec.Meta(min_length=1, max_length=128, pattern=r"\A\w[\w .-]*\Z", extra=_NAMES)
    ]


class SegmentRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State that the task has reached the via-point of this name."""

    name: Name


class Correct(_Operation, frozen=True, tag="add"):
    """State, in a hold, where the tool belongs: where the arm was led by hand, or at `tool` [m].

    The hands that it belongs to are those at which the hold began (`held`), because leading takes a
    hand, or those of this moment (`now`). If `turned`, the orientation of the led tool is part of
    the correction.
    """

    tool: Point | None = None
    hands: Literal["held", "now"] = "held"
    turned: bool = False

    def __post_init__(self) -> None:
        if self.turned and self.tool is not None:
            raise ValueError(
                "turned: true given with a tool; only an arm that was led has turned the tool"
            )


class UndoCorrection(_Operation, frozen=True, tag="undo"):
    """Undo the last correction that is in force."""


CorrectRequest: TypeAlias = Correct | UndoCorrection


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The empty request of status, reset and begin."""


class HoldRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold, or end a hold. With `by`, the name of who holds, a resume ends that hold, and is
    refused if the arm is held by anybody else. Without, it ends all holds.
    """

    by: Annotated[str, msgspec.Meta(max_length=64, pattern=r"\A[\w .-]*\Z", extra=_NO_NAME)] = ""


class ViaPointInForce(ViaPoint, frozen=True, kw_only=True):
    """A via-point in force, and how far the skill misses its position [m] and orientation [rad]."""

    missed_by_m: float
    missed_by_rad: float | None = None


class Correction(msgspec.Struct, frozen=True):
    """A correction, made or undone: the via-point that it is, and how it moves the tool.

    At the hands that it belongs to, it moves the tool by `moved_m` [m], and by at least half of
    that while a hand is less than `reach_m` [m] away, which is at most MAX_REACH_M.
    """

    name: str
    moved_m: float
    reach_m: float
    # the via-points at which its segment begins and ends; empty: in the whole skill
    segment: tuple[str, ...] = ()
    corrections: int = 1  # number of corrections at these hands
    undone: bool = False

    @property
    def text(self) -> str:
        """The correction in words."""
        segment = f" in the segment {' -> '.join(self.segment)}" if self.segment else ""
        effect = "no longer moves" if self.undone else "moves"
        return (
            f"it {effect} the tool by {100 * self.moved_m:.1f} cm{segment} at these hands, and by "
            f"half of that or more while a hand is less than {100 * self.reach_m:.0f} cm away"
        )


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """The answer to a request: the tick from which it is in force, and the via-points in force.

    `warnings` name those that are missed by more than 5 mm, and others that moved by more. The
    answer to hold, resume and reset has the resulting mode, its reason, and a note if there was
    nothing to do.
    """

    tick: int
    points: tuple[ViaPointInForce, ...] | None = None
    warnings: tuple[str, ...] = ()
    mode: str = ""
    reason: str = ""
    note: str = ""
    correction: Correction | None = None


class RequestError(ExplainedError, ValueError):
    """An invalid request; the message names the place in it."""


def decode_request(data: bytes, kind: Any) -> Any:
    """The request in JSON bytes, validated against its type.

    Raises RequestError like "$.points[0].left: 2 numbers, 3 needed".
    """
    data = data.removeprefix(codecs.BOM_UTF8)
    try:
        request = msgspec.json.decode(data or b"{}")
        json.loads(data or b"{}", object_pairs_hook=_check_once)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"not JSON: {in_words(error, named=False)}") from None
    try:
        return msgspec.convert(request, kind)
    except msgspec.ValidationError as error:
        raise RequestError(explained(error, request, kind)) from None


def _check_once(pairs: list[tuple[str, Any]]) -> None:
    """Raise RequestError for a name that an object has twice, as readers differ in which counts."""
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"{name!r} given twice in one object; each name once needed")


encode_json = msgspec.json.encode
"""JSON bytes of a request, reply or status."""


class Percentiles(msgspec.Struct, frozen=True):
    """p50, p99 and maximum over the last seconds; 0 before the first value."""

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """The input of one hand, or of the arm."""

    # messages in the last second, accepted or rejected; for the arm, states of all its joints
    rate_hz: float = 0.0
    age_ms: float | None = None  # age of the newest accepted sample; None: none yet
    fresh: bool = False  # True if that sample is recent enough
    # time from stamp to arrival, median of the last second; negative: the clock is ahead
    clock_ms: float | None = None
    # mean delay of a hand's newest 49 samples beyond the minimum; None: no steady clock
    late_ms: float | None = None
    late_95_ms: float | None = None  # 95th percentile of these delays
    frame: str = ""  # frame in the newest message
    rejected: dict[str, int] = {}  # rejected samples by cause, `malformed` included
    cause: str = ""  # cause of the newest rejection in the last second
    refused: str = ""  # that rejection in words: what arrived, and what is accepted
    advice: str = ""  # what to do about that rejection
    contested: float = 0.0  # share of the arm's states in the last second that contradict the rest
    # standard deviation of a hand's samples about its motion, each axis
    scatter_mm: float | None = None
    # the unit in which a hand's positions seem to be, if it is not that of the settings
    unit: str = ""
    # interval of the batches in which a hand's samples arrive, if it is too long; 0: none
    batches_ms: float = 0.0


ANY_DIRECTION = "in any direction"
ALONG_TASK = "along the task"


class ToolLimits(msgspec.Struct, frozen=True):
    """Largest speed and acceleration of the tool; the joint that limits each, empty: `[tool]`."""

    speed: float  # [m/s]
    speed_joint: str
    acceleration: float  # [m/s²]
    acceleration_joint: str

    @property
    def text(self) -> str:
        """The limits in words."""
        speed, acceleration = (
            joint or "[tool]" for joint in (self.speed_joint, self.acceleration_joint)
        )
        return f"{self.speed:.2f} m/s ({speed}) and {self.acceleration:.1f} m/s² ({acceleration})"


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """The status of a cell, as on `<cell>/status`."""

    cell: str
    mode: str
    reason: str
    flags: tuple[str, ...]
    tick: int
    rate_hz: float
    missed: int
    realtime: bool
    memory_locked: bool
    awake: bool
    skill: str
    hands: Hands = "both"  # hands that the skill follows; `neither`: wishes lead
    via_points: tuple[str, ...]
    rejected: dict[str, int]
    received: dict[str, int] = {}  # messages that arrived, by channel of each input
    hand_age_ms: dict[str, float]
    # distance of the nearest hand from the arm; 3 if it is farther, or no hand is seen
    hand_distance_m: float
    hand_limit_m_s: float  # smallest speed allowed toward a hand, over all parts of the arm
    lateness_us: Percentiles
    work_us: Percentiles
    # from a hand's stamp to the published command; contains the difference of clocks
    latency_ms: Percentiles
    scribe: dict[str, Any]
    endpoints: tuple[str, ...]
    version: str
    because: str = ""  # the reason in words, with its figures
    remedy: str = ""  # what to do about it
    time_ns: int = 0  # time of the status by the daemon's clock
    sources: dict[str, Source] = {}  # by `left`, `right`, and `arm` and `wish` where they are heard
    streams: dict[str, Source] = {}  # all other streams that the cell receives, by key
    # accepted names of a hand's frame; the empty name stands for the tracker's
    frames: tuple[str, ...] = ()
    # pose of each known tracker frame in `base`, by the frame's name
    trackers: dict[str, tuple[float, ...]] = {}
    joints: tuple[str, ...] = ()  # their names, in order
    # estimated positions of the hands that were seen, frame `base`
    hands_m: dict[str, Vector3] = {}
    # depth of hands below the table top: an error of the tracker's calibration
    below_table_m: dict[str, float] = {}
    # least and greatest corner of the demonstrated box
    demonstrated_m: dict[str, tuple[Vector3, Vector3]] = {}
    # left and right hand at each learned via-point
    hands_at_m: dict[str, tuple[Vector3, Vector3]] = {}
    tool_m: Vector3 | None = None  # commanded position; None before the first tick
    tool_measured_m: Vector3 | None = None  # by the newest joint state; None: not recent
    target_m: Vector3 | None = None  # None if a needed hand is not seen
    setpoint_m: Vector3 | None = None
    std_m: float | None = None  # standard deviation of the target, root mean square over the axes
    # angle between commanded tool and target, or between their directions
    turn_off_rad: float | None = None
    # standard deviation of the target's orientation; None: not learned
    turn_std_rad: float | None = None
    gripper: str = ""  # commanded, `open` or `closed`; empty: the skill has no gripper
    closure: float | None = None  # predicted closure of the gripper, 0 to 1
    # the via-points at which the segment begins and ends; empty: unknown
    segment: tuple[str, ...] = ()
    segment_belief: float = 0.0  # probability of that segment
    # time since the hands began the task; None: the skill has no clock
    task_clock_s: float | None = None
    # probability that the tool belongs more than 10 cm from its target
    error_probability: float | None = None
    deviation_m: float | None = None  # deviation of the hands from what the skill knows
    threshold_m: float = 0.0  # limit of that deviation
    # limits at the demonstrated positions, by ANY_DIRECTION and ALONG_TASK
    tool_limits: dict[str, ToolLimits] = {}
    binding: str = ""  # the limit that holds the tool back now; empty: none
    command_heard: bool = True  # True if somebody subscribes to `joints/command`
    busy: str = ""  # signs of a busy machine, now or when the arm stopped; empty: none
    residual_risk: str = ""  # of the skill, and who accepted it; empty: none
    guided: bool = False  # True while the arm's driver reports that it is led by hand
    memory_mb: dict[str, float] = {}  # resident memory of the processes `daemon` and `scribe`
    offer: str = ""  # what to learn from corrections that were repeated; empty: nothing

    @property
    def inputs(self) -> dict[str, Source]:
        """All streams that the cell receives: `sources` and `streams`."""
        return self.sources | self.streams

    @property
    def needed(self) -> tuple[str, ...]:
        """The hands that must be seen: those that the skill follows, and any seen recently."""
        recent = {side for side, age_ms in self.hand_age_ms.items() if age_ms < 1000 * GONE_S}
        return tuple(side for side in SIDES if self.hands in ("both", side) or side in recent)
