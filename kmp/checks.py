"""What the values of this package demand of the numbers they are made of, and what it warns of."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.immutable import frozen

Array: TypeAlias = NDArray[np.float64]


class ViaPointMissed(UserWarning):
    """A via-point is missed by more than its own deviation allows."""


class RankReached(UserWarning):
    """The rank was too low for the data, and accuracy was lost."""


def real(name: str, value: ArrayLike) -> Array:
    """The value as an array, without a copy if it is one. Raises ValueError unless it is real."""
    given = np.asarray(value)
    if given.dtype.char == "d":
        return given
    if given.dtype.kind not in "biuf":
        raise ValueError(f"{name}: numbers of type {given.dtype} given, real ones needed.")
    return np.asarray(given, dtype=np.float64)


def numbers(name: str, value: ArrayLike, *shape: int | str) -> Array:
    """A read-only copy of `value` of the given shape, where a word stands for any length.

    Raises ValueError if the shape is another or a number is not real and finite.
    """
    array = np.array(real(name, value), dtype=np.float64, order="C")
    check_shape(name, array, *shape)
    check_finite(name, array)
    return frozen(array)


def check_finite(name: str, array: Array) -> None:
    """Raises ValueError unless every number is finite."""
    flat = array.ravel()
    if math.isfinite(np.dot(flat, flat)):  # quicker than a look at each number
        return
    for place in np.argwhere(~np.isfinite(array))[:1].tolist():
        raise ValueError(f"{name}{place} is {array[tuple(place)]}, and every number must be finite.")


def check_shape(name: str, array: Array, *shape: int | str) -> None:
    """Raises ValueError unless the array has that shape, where a word stands for any length."""
    if array.shape == shape:
        return
    if array.ndim == len(shape) and all(n == m or isinstance(n, str) for n, m in zip(shape, array.shape, strict=True)):
        return
    wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    raise ValueError(f"{name}: shape {array.shape} given, ({wanted}) needed.")


def positive(name: str, value: float | Array) -> float:
    """The value as a float. Raises ValueError unless it is one number, finite and above zero."""
    given = real(name, value)
    check_shape(name, given)
    number = float(given)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} is {number:g}, and must be finite and above 0.")
    return number


def whole(name: str, value: object, *, least: int = 1) -> int:
    """The value as an integer. Raises ValueError unless it is one, and not below the least."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        raise ValueError(f"{name} is {value!r}, and must be a whole number.")
    if value < least:
        raise ValueError(f"{name} is {value}, and must be at least {least}.")
    return int(value)


def check_kind(name: str, value: object, kind: type, how: str) -> None:
    """Raises ValueError unless the value is of that kind; `how` says how one is made."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: {type(value).__name__} given, {kind.__name__} needed: {how}.")


def pair(name: str, demonstration: object) -> tuple[ArrayLike, ArrayLike]:
    """Inputs and outputs of a demonstration. Raises ValueError unless it is a pair."""
    if isinstance(demonstration, (tuple, list)) and len(demonstration) == 2:
        return demonstration[0], demonstration[1]
    of = f" of shape {demonstration.shape}" if isinstance(demonstration, np.ndarray) else ""
    needed = "a pair needed: inputs (T, I) and outputs (T, O)"
    raise ValueError(f"{name}: {type(demonstration).__name__}{of} given, {needed}.")
