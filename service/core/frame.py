"""Event, Tick, Frame, State: what goes into the core, what comes out, and what it remembers.

Frame, State and Timing are NumPy structured scalars laid out as `service.contract.records` says.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from service.contract import cdr, records
from service.contract.channels import Channel, sent_by_the_loop
from service.contract.messages import BASE, PoseStamped, PoseWithCovarianceStamped

Vector: TypeAlias = NDArray[np.float64]
Record: TypeAlias = np.void
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


def blank(layout: DType) -> Record:
    """A record of zeros, to be filled."""
    record: Record = np.zeros(1, layout)[0]
    return record


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


def outgoing(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> Iterator[tuple[Channel, bytes]]:
    """What goes out with a frame, and on which channels; `joints` are the names of the commanded
    ones.

    Live and in a recording alike. Nothing is commanded before the arm is ready, and nothing aimed
    at without both hands.
    """
    for channel in sent_by_the_loop(int(frame["tick"])):
        payload = _OUTPUTS[channel.key](frame, stamp_ns, joints)
        if payload is not None:
            yield channel, payload


def _command(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["commanded"]:
        return None
    return cdr.encode_command(stamp_ns, joints, frame["joints"].tolist(), frame["joint_velocities"].tolist())


def _target(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["covariance"].any():
        return None
    covariance = [0.0] * 36
    for i, row in enumerate(frame["covariance"].tolist()):
        covariance[6 * i : 6 * i + 3] = row
    position, orientation = tuple(frame["target"].tolist()), tuple(frame["orientation"].tolist())
    message = PoseWithCovarianceStamped(stamp_ns, BASE, position, orientation, tuple(covariance))
    return cdr.encode_pose_with_covariance(message)


def _setpoint(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    message = PoseStamped(stamp_ns, BASE, tuple(frame["setpoint"].tolist()), tuple(frame["orientation"].tolist()))
    return cdr.encode_pose(message)


_OUTPUTS: dict[str, Callable[[Frame, int, tuple[str, ...]], bytes | None]] = {
    "joints/command": _command,
    "tool/target": _target,
    "tool/setpoint": _setpoint,
}
