"""Records: NumPy structured arrays of one element, which compiled functions take whole."""

from __future__ import annotations

import functools
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.compiled import PLAIN
from service.contract.records import Layout

Vector: TypeAlias = NDArray[np.float64]
Record: TypeAlias = np.void
Records: TypeAlias = NDArray[np.void]
DType: TypeAlias = np.dtype[np.void]


@functools.cache
def dtype_of(layout: Layout, joints: int) -> DType:
    """The memory of a layout for an arm with so many joints: NumPy's own order, little endian."""
    return np.dtype([(field.name, np.dtype(field.type).newbyteorder("<"), field.shape_for(joints)) for field in layout])


def structured(count: int, fields: Any) -> Records:
    """So many records of zeros, whose fields compiled functions, and their plain Python, read by
    name.
    """
    records = np.zeros(count, fields)
    return records.view(np.recarray) if PLAIN else records


def parameters(**values: ArrayLike) -> Records:
    """The parameters of a stage: numbers and arrays by name, as one record (1,)."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    record = structured(1, [(name, array.dtype, array.shape) for name, array in arrays.items()])
    for name, array in arrays.items():
        record[name][0] = array
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
    """The memory (1,) of a record that `blank` or `copied` made, as compiled functions take it."""
    memory: Any = record.base
    return memory.view(np.recarray) if PLAIN else memory  # type: ignore[no-any-return]


def frozen(record: Record) -> Record:
    """A copy that cannot be changed."""
    copy: Record = np.frombuffer(record.tobytes(), record.dtype)[0]
    return copy
