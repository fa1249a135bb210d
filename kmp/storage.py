"""Files of primitives and other values: .npz without pickle, exact to the bit, with units.

A file has the arrays of the value, `kmp_format`, both units and a BLAKE2 checksum. The arrays of a
primitive are those of `named_arrays`; other values are named by their fields, nested with dots.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from kmp import named_arrays
from kmp.arrays.checks import brief, check_kind
from kmp.arrays.immutable import frozen
from kmp.constraints import LinearConstraints
from kmp.gaussians import Gaussians
from kmp.kernel import GaussianKernel
from kmp.mixture import GaussianMixture
from kmp.orientation import OrientationKMP
from kmp.predictor import Uncertainty
from kmp.primitive import KMP
from kmp.problem.hyperparameters import AffineMean
from kmp.query import MotionPrediction
from kmp.references.correlation import Correlation, Improvement
from kmp.references.frames import CoordinateFrame, LocalKMP
from kmp.selection import Learned, Score
from kmp.time_kernels import PeriodicKernel, VelocityKernel

_FORMAT = 1  # number of the file format
_KIND = "kind"
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        *(KMP, OrientationKMP, LocalKMP, CoordinateFrame, LinearConstraints, AffineMean),
        *(Gaussians, GaussianMixture, GaussianKernel, VelocityKernel, PeriodicKernel),
        *(Correlation, Improvement, Learned, Score, Uncertainty, MotionPrediction),
    )
}


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
    for name, given in (
        ("path", str(path) if isinstance(path, Path) else path),
        ("input_unit", input_unit),
        ("output_unit", output_unit),
    ):
        check_kind(name, given, str, "a text")
    units = {
        "kmp_format": np.array(_FORMAT),
        "input_unit": np.array(input_unit),
        "output_unit": np.array(output_unit),
    }
    arrays: dict[str, Any] = units | (named_arrays.to_arrays(value) if isinstance(value, KMP) else value_arrays(value))
    with Path(path).open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, checksum=np.array(checksum(arrays)))


def load(path: str | Path) -> Stored:
    """The value that `save` wrote, and the units; a primitive predicts the same, bit for bit.

    Raises OSError if the file cannot be read, and ValueError if `save` did not write it or it was
    changed since. Files of earlier versions have no checksum, and load without.
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
        raise ValueError(f"{path}: not an .npz file that `kmp.save` wrote, or damaged: save it again.")
    if (given := arrays["kmp_format"].tolist()) != _FORMAT:
        raise ValueError(f"{path}: format {brief(given)} given, {_FORMAT} needed. Load it with the kmp that wrote it.")
    if "checksum" in arrays and str(arrays["checksum"]) != checksum(arrays):
        raise ValueError(
            f"{path}: the numbers are not those that were saved: their checksum is another. Copy or save it again."
        )
    try:
        value = value_of(arrays) if _KIND in arrays else named_arrays.from_arrays(arrays)
        return Stored(value, str(arrays["input_unit"]), str(arrays["output_unit"]))
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def value_arrays(value: object, prefix: str = "") -> dict[str, NDArray[Any]]:
    """The arrays of a value and of its kind, with this prefix before each name.

    Raises ValueError if the value is not of this package.
    """
    kind = type(value).__name__
    if _KINDS.get(kind) is not type(value):
        raise ValueError(f"value: {kind} given, one of {', '.join(_KINDS)} needed.")
    arrays = {prefix + _KIND: np.array(kind)}
    if isinstance(value, KMP):
        return arrays | {prefix + name: array for name, array in named_arrays.to_arrays(value).items()}
    for name in _fields(value):
        arrays |= _of_field(getattr(value, name), prefix + name)
    return arrays


def value_of(arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Any:
    """The value of the arrays of `value_arrays`. Raises ValueError if its kind is unknown."""
    kind = _KINDS.get(str(arrays[prefix + _KIND]))
    if kind is None:
        raise ValueError(f"{prefix}{_KIND}: {arrays[prefix + _KIND]!s:.60} given, one of {', '.join(_KINDS)} needed.")
    if kind is KMP:
        return named_arrays.from_arrays(
            {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}
        )
    return kind(**{name: _field(arrays, prefix + name) for name in _fields(kind)})


def _fields(kind: Any) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind)) if is_dataclass(kind) else kind._fields


def _of_field(value: object, name: str) -> dict[str, NDArray[Any]]:
    if value is None:
        return {}
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        parts = [_of_field(part, f"{name}.{i}") for i, part in enumerate(value)]
        return {f"{name}.count": np.array(len(value))} | {key: array for part in parts for key, array in part.items()}
    if isinstance(value, (np.ndarray, float, int, str)):
        return {name: np.array(value)}
    return value_arrays(value, f"{name}.")


def _field(arrays: Mapping[str, NDArray[Any]], name: str) -> Any:
    if name in arrays:
        array = np.array(arrays[name])
        return frozen(array) if array.ndim else array.item()
    if f"{name}.count" in arrays:
        return tuple(_field(arrays, f"{name}.{i}") for i in range(int(arrays[f"{name}.count"])))
    return value_of(arrays, f"{name}.") if f"{name}.{_KIND}" in arrays else None
