"""Any value of this package as named arrays, exact to the bit: fields by name, values in values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kmp import named_arrays
from kmp.affine_mean import AffineMean
from kmp.constraints import LinearConstraints
from kmp.correlation import Correlation, Improvement
from kmp.gaussians import Gaussians
from kmp.gmm import GaussianMixture
from kmp.immutable import frozen
from kmp.kernel import GaussianKernel
from kmp.orientation import OrientationKMP
from kmp.predictor import Uncertainty
from kmp.primitive import KMP
from kmp.query import MotionPrediction
from kmp.references import CoordinateFrame, LocalKMP
from kmp.selection import Learned, Score
from kmp.time_kernels import PeriodicKernel, VelocityKernel

KIND = "kind"
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        *(KMP, OrientationKMP, LocalKMP, CoordinateFrame, LinearConstraints, AffineMean),
        *(Gaussians, GaussianMixture, GaussianKernel, VelocityKernel, PeriodicKernel),
        *(Correlation, Improvement, Learned, Score, Uncertainty, MotionPrediction),
    )
}


def to_arrays(value: object, prefix: str = "") -> dict[str, NDArray[Any]]:
    """The arrays of a value, its kind among them, their names behind the prefix.

    Raises ValueError if the value is none of this package.
    """
    kind = type(value).__name__
    if _KINDS.get(kind) is not type(value):
        raise ValueError(f"value: {kind} given, one of {', '.join(_KINDS)} needed.")
    arrays = {prefix + KIND: np.array(kind)}
    if isinstance(value, KMP):
        return arrays | {prefix + name: array for name, array in named_arrays.to_arrays(value).items()}
    for name in _fields(value):
        arrays |= _of_field(getattr(value, name), prefix + name)
    return arrays


def from_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Any:
    """The value that `to_arrays` gave these arrays for. Raises ValueError if there is none."""
    kind = _KINDS.get(str(arrays[prefix + KIND]))
    if kind is None:
        raise ValueError(f"{prefix}{KIND}: {arrays[prefix + KIND]!s:.60} given, one of {', '.join(_KINDS)} needed.")
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
    return to_arrays(value, f"{name}.")


def _field(arrays: Mapping[str, NDArray[Any]], name: str) -> Any:
    if name in arrays:
        array = np.array(arrays[name])
        return frozen(array) if array.ndim else array.item()
    if f"{name}.count" in arrays:
        return tuple(_field(arrays, f"{name}.{i}") for i in range(int(arrays[f"{name}.count"])))
    return from_arrays(arrays, f"{name}.") if f"{name}.{KIND}" in arrays else None
