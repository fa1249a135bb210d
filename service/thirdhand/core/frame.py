"""Data types of the core: Event and Tick are its input, Frame is its output, State is its memory.

Frame and State are NumPy structured records, which compiled functions take as arrays of one
element. Each stage declares its fields in its package; this module assembles them.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.compiled import PLAIN
from thirdhand.contract import cdr
from thirdhand.contract.records import Field, Layout, assembled, definition
from thirdhand.core import arm, decision, intake, limiter, separation, setpoint, skill, wish

Vector: TypeAlias = NDArray[np.float64]
Record: TypeAlias = np.void
Records: TypeAlias = NDArray[np.void]
Struct: TypeAlias = Any
"""One of `Records` in a compiled function, which reads its fields as attributes."""
DType: TypeAlias = np.dtype[np.void]
Outputs: TypeAlias = Sequence[tuple[str, bytes]]
"""Keys below the cell's, each with the bytes to publish."""


@functools.cache
def dtype_of(layout: Layout, joints: int) -> DType:
    """NumPy type of a layout for an arm with this number of joints, in little endian."""
    return np.dtype(
        [
            (field.name, np.dtype(field.type).newbyteorder("<"), field.shape_for(joints))
            for field in layout
        ]
    )


as_array: Callable[[Record], Records] = operator.attrgetter("base")
"""Array (1,) of a record that `blank` or `copied` made, as compiled functions take it."""


RECORDS: Any = np.recarray if PLAIN else np.ndarray
"""Type of arrays of records, made from shape, layout and memory. Where compiled functions run as
plain Python, it allows them to read fields as attributes. Records are copied as bytes, because
NumPy copies them field by field, which takes ten times as long.
"""


_LAYOUTS: dict[DType, DType] = {}


def shared_dtype(fields: Any) -> DType:
    """NumPy type with these fields, one object for all equal ones: at each call, Numba recognises
    the same object at once, but compares an equal one field by field, in microseconds.
    """
    layout = np.dtype(fields)
    return _LAYOUTS.setdefault(layout, layout)


def structured(count: int, fields: Any) -> Records:
    """Records of zeros (`count`,), whose fields compiled functions read as attributes."""
    layout = shared_dtype(fields)
    records: Records = RECORDS(count, layout, bytearray(count * layout.itemsize))
    return records


def parameters(**values: ArrayLike) -> Records:
    """Parameters of a stage, numbers and arrays by name, as one record (1,)."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    record = structured(1, [(name, array.dtype, array.shape) for name, array in arrays.items()])
    for name, array in arrays.items():
        record[name][0] = array
    return record


def blank(layout: DType) -> Record:
    """Record of zeros."""
    record: Record = structured(1, layout)[0]
    return record


def copied(record: Record) -> Record:
    """Copy of a record with memory of its own, as `blank` makes it."""
    copy: Record = RECORDS(1, record.dtype, bytearray(record.tobytes()))[0]
    return copy


def part_of(record: Record, layout: DType, offset: int) -> Record:
    """The part of a record with this layout and offset [bytes], in the same memory."""
    part: Record = RECORDS(1, layout, as_array(record).view(np.uint8), offset)[0]
    return part


def frozen(record: Record) -> Record:
    """Read-only copy of a record."""
    copy: Record = np.frombuffer(record.tobytes(), record.dtype)[0]
    return copy


Frame: TypeAlias = Record  # a record of `frame_layout`
Lap: TypeAlias = Callable[[str], None]

_PACKAGES: tuple[ModuleType, ...] = (intake, skill, decision, separation, setpoint, arm, limiter)
# in the order of the data
STAGES = tuple(package.__name__.rsplit(".", 1)[1] for package in _PACKAGES)
_TICK = (Field("tick", "int64"),)
FRAME = assembled(_TICK, *(package.FRAME for package in _PACKAGES))
STATE = assembled(_TICK, *(package.STATE for package in _PACKAGES))
# after these, where a policy leads
WISH_STATE = assembled(wish.STATE)
TIMING_FIELDS = (
    Field("tick", "int64"),
    Field("time_ns", "int64"),  # the tick's deadline on the wall clock
    Field("missed", "int64"),  # deadlines skipped since start
    Field("lateness_us", "float32"),  # from the deadline to the begin of the tick
    Field("work_us", "float32"),  # from the begin of the tick to its published command
    # from the newest hand sample's stamp to the published command; 0: no new one
    Field("latency_us", "float32"),
    # durations, in the order of STAGES; of the rehearsal, if its frame is the tick's
    Field("stages_us", "float32", (len(STAGES),)),
)
TIMING = dtype_of(TIMING_FIELDS, 0)
_TIMING = struct.Struct(f"<3q3f{len(STAGES)}f")  # as TIMING


@dataclass(frozen=True, slots=True)
class Event:
    """Input of the core: its kind, the bytes that a recording keeps, and the value decoded from
    them.
    """

    kind: str
    payload: bytes
    value: Any


def order(kind: str, text: str = "{}") -> Event:
    """Event of kind hold, resume, reset, begin or fault, with the text that a recording keeps."""
    return Event(kind, cdr.encode_string(text), None)


@dataclass(frozen=True, slots=True)
class Tick:
    """Number of a deadline since start, and the events that it consumes, in order."""

    index: int
    inbox: tuple[Event, ...] = ()
    # of the deadline: the stamp of its messages, with which the stamps of wishes are compared
    time_ns: int = 0


def frame_layout(joints: int) -> DType:
    """Layout of a Frame for an arm with this number of joints."""
    return dtype_of(FRAME, joints)


def state_layout(joints: int, *, has_wishes: bool = False) -> DType:
    """Layout of a State for an arm with this number of joints; where a policy leads, it
    `has_wishes`.
    """
    return dtype_of(STATE + WISH_STATE if has_wishes else STATE, joints)


def definitions(joints: int, *, has_wishes: bool = False) -> dict[str, str]:
    """ROS 2 definitions of Frame, State and Timing for an arm with this number of joints."""
    state = STATE + WISH_STATE if has_wishes else STATE
    layouts = {"Frame": FRAME, "State": state, "Timing": TIMING_FIELDS}
    return {f"thirdhand/{name}": definition(layout, joints) for name, layout in layouts.items()}


def timed(
    tick: int,
    time_ns: int,
    missed: int,
    lateness_us: float,
    work_us: float,
    latency_us: float,
    stages_us: Sequence[float],
) -> Record:
    """Timing record of these values, which are its fields."""
    fields = _TIMING.pack(tick, time_ns, missed, lateness_us, work_us, latency_us, *stages_us)
    record: Record = np.frombuffer(fields, TIMING)[0]
    return record


def encode(record: Record) -> bytes:
    """CDR bytes of a record."""
    return cdr.encode_record(record.tobytes())


def decode(data: bytes, layout: DType) -> Record:
    """Record in CDR bytes. Raises WireError."""
    record: Record = np.frombuffer(bytearray(cdr.decode_record(data, layout.itemsize)), layout)[0]
    return record


def differences(a: Record, b: Record) -> dict[str, float]:
    """Fields in which two records of one layout differ bit for bit, each with the largest
    difference.
    """
    if a.tobytes() == b.tobytes():
        return {}
    return {
        field: float(
            np.max(np.abs(np.asarray(a[field], np.float64) - np.asarray(b[field], np.float64)))
        )
        for field in a.dtype.names or ()
        if a[field].tobytes() != b[field].tobytes()
    }
