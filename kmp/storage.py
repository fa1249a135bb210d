"""Files of primitives and other values: .npz without pickle, exact to the bit, with units.

A file has the arrays of the value, `kmp_format`, both units and a BLAKE2 checksum. The arrays of a
primitive are those of `named_arrays`; other values are named by their fields, nested with dots.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import brief, check_kind
from kmp.named_arrays import from_arrays, to_arrays
from kmp.primitive import KMP

_FORMAT = 1  # number of the file format
# begin of a file that Git LFS has not fetched
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"


class Stored(NamedTuple):
    """The contents of a file."""

    value: Any
    """A `KMP`, or another value of this package."""
    input_unit: str
    output_unit: str

    @property
    def primitive(self) -> KMP:
        """The value as a `KMP`. Raises ValueError if it is none."""
        check_kind("the stored value", self.value, KMP, "take `value` for what is none")
        return cast(KMP, self.value)


def checksum(arrays: Mapping[str, NDArray[Any]]) -> str:
    """BLAKE2b of named arrays in 32 hexadecimal digits; an array named `checksum` is left out."""
    sums = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        if name != "checksum":
            array = np.asarray(arrays[name])
            sums.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            sums.update(np.ascontiguousarray(array).tobytes())
    return sums.hexdigest()


def save(path: str | Path, value: object, *, input_unit: str = "", output_unit: str = "") -> None:
    """Write a primitive and the units of its numbers ("m", "s", "m, m/s") to an .npz file.

    Or any other value of this package. No suffix is added to the path. Raises OSError if the file
    cannot be written, and ValueError if the value is of another type.
    """
    for name, text in (
        ("path", str(path) if isinstance(path, Path) else path),
        ("input_unit", input_unit),
        ("output_unit", output_unit),
    ):
        check_kind(name, text, str, "a text")
    units = {
        "kmp_format": np.array(_FORMAT),
        "input_unit": np.array(input_unit),
        "output_unit": np.array(output_unit),
    }
    arrays: dict[str, Any] = units | to_arrays(value)
    with Path(path).open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, checksum=np.array(checksum(arrays)))


def load(path: str | Path, *, kernels: Mapping[str, type] | None = None) -> Stored:
    """The value that `save` wrote, and the units; a primitive predicts the same, bit for bit.

    `kernels` are the classes of kernels of your own, by their names: {"Cauchy": Cauchy}.

    Raises OSError if the file cannot be read, and ValueError if `save` did not write it or it was
    changed since.
    """
    check_kind("path", str(path) if isinstance(path, Path) else path, str, "the file's name")
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
    except OSError:
        raise
    except Exception:  # NumPy documents no list of errors for damaged archives
        arrays = {}
    if "kmp_format" not in arrays:
        with Path(path).open("rb") as file:
            is_pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
        if is_pointer:
            raise ValueError(
                f"{path}: a pointer of Git LFS and not the file itself; `git lfs pull` fetches "
                "that."
            )
        raise ValueError(
            f"{path}: not an .npz file that `kmp.save` wrote, or damaged: save it again."
        )
    if (version := arrays["kmp_format"].tolist()) != _FORMAT:
        raise ValueError(
            f"{path}: format {brief(version)} given, {_FORMAT} needed. Load it with the kmp that "
            "wrote it."
        )
    if str(arrays.get("checksum")) != checksum(arrays):
        raise ValueError(
            f"{path}: the numbers are not those that were saved: their checksum is another. Copy "
            "or save it again."
        )
    try:
        value = from_arrays(arrays, kernels)
        return Stored(value, str(arrays["input_unit"]), str(arrays["output_unit"]))
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
