"""Event, Tick, Frame, State: what goes into the core, what comes out, and what it remembers.

Frame, State and Timing are records of fixed layout: NumPy structured scalars whose bytes are, behind the four-byte header, the CDR encoding of
a ROS 2 message, and whose message definition is derived from the layout. Fields are ordered by size, so that no padding is needed.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from service.wire import (
    BASE,
    CDR_HEADER,
    PoseStamped,
    PoseWithCovarianceStamped,
    WireError,
    encode_pose,
    encode_pose_with_covariance,
)

Vector: TypeAlias = NDArray[np.float64]
Record: TypeAlias = np.void
Frame: TypeAlias = Record  # of layout FRAME
Lap: TypeAlias = Callable[[str], None]


def no_lap(stage: str) -> None:
    """Takes no time."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that may change the next command: its kind, the bytes that a recording keeps, and what they mean."""

    kind: str
    payload: bytes
    value: Any


@dataclass(frozen=True, slots=True)
class Tick:
    """A deadline's number since start, and the events that it consumes, in order."""

    index: int
    inbox: tuple[Event, ...] = ()


EVENT_KINDS = ("hands/left", "hands/right", "joints/state", "skill", "hold", "resume", "reset")
SIDES = ("left", "right")
STAGES = ("intake", "skill", "smoother", "arm", "limiter")


class Mode(enum.IntEnum):
    """What the controller does."""

    HOLD = 0
    FOLLOW = 1
    FAULT = 2


class Reason(enum.IntEnum):
    """Why it holds or is at fault."""

    NONE = 0
    NO_HANDS = 1
    STALE_HAND = 2
    FAR_FROM_DEMONSTRATIONS = 3
    OPERATOR = 4
    ARM_NOT_READY = 5
    ARM_ERROR = 6
    ARM_SILENT = 7
    TOOL_SPEED = 8  # measured


class Flag(enum.IntFlag):
    """What limits it while it follows."""

    TARGET_CLAMPED = 1
    SPEED_LIMITED = 2
    NEAR_JOINT_LIMIT = 4


class Cause(enum.IntEnum):
    """Why a sample was rejected."""

    NOT_FINITE = 0
    NOT_A_ROTATION = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    OLDER = 4
    INCOMPLETE = 5


FRAME = np.dtype(
    [
        ("tick", "<i8"),
        ("hand_stamp_ns", "<i8"),  # of the newest sample in it; 0: none yet
        ("hands", "<f8", (2, 3)),  # left and right, filtered, at this tick [m]
        ("hand_velocities", "<f8", (2, 3)),
        ("target", "<f8", (3,)),  # what the skill predicts, clamped [m]
        ("target_velocity", "<f8", (3,)),
        ("target_acceleration", "<f8", (3,)),
        ("covariance", "<f8", (3, 3)),  # of the prediction [m²]
        ("deviation", "<f8"),  # its standard deviation, root mean square over the axes [m]
        ("setpoint", "<f8", (3,)),  # after smoothing [m]
        ("setpoint_velocity", "<f8", (3,)),
        ("setpoint_acceleration", "<f8", (3,)),
        ("tool", "<f8", (3,)),  # where the commanded joints put the tool [m]
        ("orientation", "<f8", (4,)),  # of the target, quaternion x y z w
        ("joints", "<f8", (7,)),  # the command [rad]
        ("joint_velocities", "<f8", (7,)),
        ("joint_accelerations", "<f8", (7,)),
        ("hand_ages", "<i4", (2,)),  # ticks since the newest sample; -1: none yet
        ("rejected", "<u4", (len(Cause),)),
        ("mode", "u1"),
        ("reason", "u1"),
        ("flags", "u1"),
        ("commanded", "u1"),  # 0: the joints are not to be sent
    ]
)
STATE = np.dtype(
    [
        ("tick", "<i8"),
        ("hand_stamps_ns", "<i8", (2,)),
        ("hand_ticks", "<i8", (2,)),  # tick of the newest sample; -1: none yet
        ("arm_stamp_ns", "<i8"),
        ("arm_tick", "<i8"),
        ("slow_tick", "<i8"),  # the last one at which the tool was not too fast
        ("filters", "<f8", (2, 3, 3)),  # position, velocity, acceleration; by axis
        ("filter_covariances", "<f8", (2, 3, 3)),
        ("measured", "<f8", (7,)),
        ("measured_velocities", "<f8", (7,)),
        ("setpoint", "<f8", (3, 3)),  # position, velocity, acceleration; by axis
        ("joints", "<f8", (3, 7)),  # position, velocity, acceleration; by joint
        ("covariance", "<f8", (3, 3)),  # of the prediction at the newest hand sample; zeros: none
        ("rejected", "<u4", (len(Cause),)),
        ("mode", "u1"),
        ("reason", "u1"),
        ("operator_hold", "u1"),
        ("arm_ready", "u1"),
        ("skill", "u1", (16,)),  # digest of the skill in force, which is recorded apart
    ]
)
TIMING = np.dtype(
    [
        ("tick", "<i8"),
        ("time_ns", "<i8"),  # the tick's deadline on the wall clock
        ("missed", "<i8"),  # deadlines skipped since start
        ("lateness_us", "<f4"),
        ("work_us", "<f4"),
        ("latency_us", "<f4"),  # newest hand's stamp to command published; 0: no new sample
        ("stages_us", "<f4", (len(STAGES),)),
    ]
)


def blank(layout: np.dtype[np.void]) -> Record:
    """A record of zeros, to be filled."""
    record: Record = np.zeros(1, layout)[0]
    return record


def frozen(record: Record) -> Record:
    """A copy that cannot be changed."""
    copy: Record = np.frombuffer(record.tobytes(), record.dtype)[0]
    return copy


def encode(record: Record) -> bytes:
    """CDR bytes of a record."""
    return CDR_HEADER + record.tobytes()


def decode(data: bytes, layout: np.dtype[np.void]) -> Record:
    """The record in CDR bytes. Raises WireError."""
    if len(data) != 4 + layout.itemsize or data[:4] != CDR_HEADER:
        raise WireError(f"{len(data)} bytes, {4 + layout.itemsize} of little-endian CDR needed: was it made by another version?")
    record: Record = np.frombuffer(data, layout, offset=4).copy()[0]
    return record


def definition(layout: np.dtype[np.void]) -> str:
    """The ROS 2 message definition of a layout."""
    names = {"i8": "int64", "f8": "float64", "f4": "float32", "i4": "int32", "u4": "uint32", "u1": "uint8"}
    lines = []
    for field, (kind, *_) in (layout.fields or {}).items():
        size = f"[{int(np.prod(kind.shape))}]" if kind.shape else ""
        lines.append(f"{names[kind.base.str[1:]]}{size} {field}")
    return "\n".join(lines) + "\n"


def differences(a: Record, b: Record) -> dict[str, float]:
    """The fields in which two records of one layout differ, bit for bit, with the largest difference."""
    if a.tobytes() == b.tobytes():
        return {}
    return {
        field: float(np.max(np.abs(np.asarray(a[field], np.float64) - np.asarray(b[field], np.float64))))
        for field in a.dtype.names or ()
        if a[field].tobytes() != b[field].tobytes()
    }


def encode_target(stamp_ns: int, frame: Frame) -> bytes:
    """The frame's target as CDR bytes of `tool/target`."""
    covariance = [0.0] * 36
    for i, row in enumerate(frame["covariance"].tolist()):
        covariance[6 * i : 6 * i + 3] = row
    position, orientation = tuple(frame["target"].tolist()), tuple(frame["orientation"].tolist())
    return encode_pose_with_covariance(PoseWithCovarianceStamped(stamp_ns, BASE, position, orientation, tuple(covariance)))


def encode_setpoint(stamp_ns: int, frame: Frame) -> bytes:
    """The frame's setpoint as CDR bytes of `tool/setpoint`."""
    return encode_pose(PoseStamped(stamp_ns, BASE, tuple(frame["setpoint"].tolist()), tuple(frame["orientation"].tolist())))
