"""Event, Tick, Frame, State: what goes into the core, what comes out, and what it remembers.

Frame, State and Timing are NumPy structured scalars laid out as `service.contract.records` says.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from kmp.compiled import compiled
from service.contract import cdr, records
from service.core.rotation import quaternion_of

Vector: TypeAlias = NDArray[np.float64]
Record: TypeAlias = np.void
Records: TypeAlias = NDArray[np.void]
DType: TypeAlias = np.dtype[np.void]
Frame: TypeAlias = Record  # of the layout `frame_layout`
Lap: TypeAlias = Callable[[str], None]


def no_lap(stage: str) -> None:
    """Measures nothing: outside of the shell nobody asks how long a stage took."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that may change the next command: its kind, the bytes that a recording keeps, and
    what they mean.
    """

    kind: str
    payload: bytes
    value: Any


def order(kind: str, text: str = "{}") -> Event:
    """A hold, resume, reset or fault as an event, and what a recording keeps of it."""
    return Event(kind, cdr.encode_string(text), None)


@dataclass(frozen=True, slots=True)
class Tick:
    """A deadline's number since start, and the events that it consumes, in order."""

    index: int
    inbox: tuple[Event, ...] = ()


@functools.cache
def _dtype(layout: records.Layout, joints: int) -> DType:
    # ">" or "<" are said by none of the types: NumPy's own order is that of CDR on every machine
    # that this runs on
    return np.dtype([(field.name, np.dtype(field.type).newbyteorder("<"), field.shape_for(joints)) for field in layout])


def frame_layout(joints: int) -> DType:
    """The layout of a Frame for an arm with so many joints."""
    return _dtype(records.FRAME, joints)


def state_layout(joints: int) -> DType:
    """The layout of a State for an arm with so many joints."""
    return _dtype(records.STATE, joints)


TIMING = _dtype(records.TIMING, 0)


def timed(
    tick: int,
    time_ns: int,
    missed: int,
    lateness_us: float,
    work_us: float,
    latency_us: float,
    stages_us: Sequence[float],
) -> Record:
    """A Timing of these, which are its fields, made whole."""
    fields = (tick, time_ns, missed, lateness_us, work_us, latency_us, stages_us)
    record: Record = np.array([fields], TIMING)[0]
    return record


def blank(layout: DType) -> Record:
    """A record of zeros, to be filled."""
    record: Record = np.zeros(1, layout)[0]
    return record


def copied(record: Record) -> Record:
    """A copy with memory of its own, as `blank` makes it."""
    copy: Record = np.array([record])[0]
    return copy


def as_array(record: Record) -> Records:
    """The memory (1,) of a record that was made by `blank` or `copied`, as compiled functions take
    it.
    """
    memory: Any = record.base
    return memory  # type: ignore[no-any-return]


def frozen(record: Record) -> Record:
    """A copy that cannot be changed."""
    copy: Record = np.frombuffer(record.tobytes(), record.dtype)[0]
    return copy


def encode(record: Record) -> bytes:
    """CDR bytes of a record."""
    return cdr.encode_record(record.tobytes())


def decode(data: bytes, layout: DType) -> Record:
    """The record in CDR bytes. Raises WireError."""
    record: Record = np.frombuffer(bytearray(cdr.decode_record(data, layout.itemsize)), layout)[0]
    return record


def differences(a: Record, b: Record) -> dict[str, float]:
    """The fields in which two records of one layout differ, bit for bit, with the largest
    difference.
    """
    if a.tobytes() == b.tobytes():
        return {}
    return {
        field: float(np.max(np.abs(np.asarray(a[field], np.float64) - np.asarray(b[field], np.float64))))
        for field in a.dtype.names or ()
        if a[field].tobytes() != b[field].tobytes()
    }


@compiled
def fill(
    frames: Records,
    states: Records,
    tool: Vector,
    rotation: Vector,
    target: Vector,
    velocity: Vector,
    acceleration: Vector,
    covariance: Vector,
    deviation: float,
    orientation: Vector,
    turning: Vector,
    orientation_covariance: Vector,
    told: Vector,
) -> None:
    """Into the memory of a blank frame what the state's memory holds, and what was predicted."""
    frame, state = frames[0], states[0]
    frame.tick, frame.mode, frame.reason = state.tick, state.mode, state.reason
    left, right = state.hand_ticks[0], state.hand_ticks[1]
    if left == right:
        frame.hand_stamp_ns = max(state.hand_stamps_ns[0], state.hand_stamps_ns[1])
    else:
        frame.hand_stamp_ns = state.hand_stamps_ns[0 if left > right else 1]
    for side in range(2):
        seen = state.hand_ticks[side]
        frame.hand_ages[side] = -1 if seen < 0 else state.tick - seen
        frame.hands[side], frame.hand_velocities[side] = state.hands[side, 0], state.hands[side, 1]
    frame.setpoint[:], frame.setpoint_velocity[:] = state.setpoint[0], state.setpoint[1]
    frame.setpoint_acceleration[:] = state.setpoint[2]
    frame.target[:], frame.target_velocity[:], frame.target_acceleration[:] = target, velocity, acceleration
    frame.covariance[:], frame.deviation = covariance, deviation
    frame.orientation[:], frame.turning[:] = orientation, turning
    frame.orientation_covariance[:] = orientation_covariance
    frame.setpoint_orientation[:], frame.setpoint_turning[:] = state.orientation, state.turning
    frame.tool[:] = tool
    quaternion_of(rotation, frame.tool_orientation)
    frame.closure, frame.gripper = state.closure, state.gripper
    frame.joints[:], frame.joint_velocities[:] = state.joints[0], state.joints[1]
    frame.joint_accelerations[:] = state.joints[2]
    frame.rejected[:] = state.rejected
    frame.hand_distance, frame.hand_limit = told[0], told[1]
