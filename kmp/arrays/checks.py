"""What the values of this package demand of the numbers they are made of, and what it warns of."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.immutable import frozen

Array: TypeAlias = NDArray[np.float64]


class ViaPointMissed(UserWarning):
    """A via-point is missed by more than its own deviation allows."""


class RankReached(UserWarning):
    """The rank was too low for the data, and accuracy was lost."""


def real(name: str, value: ArrayLike) -> Array:
    """The value as an array, without a copy if it is one. Raises ValueError unless it is real."""
    try:
        given = np.asarray(value)
    except ValueError:
        raise ValueError(f"{name}: rows of different lengths given, an array of real numbers needed.") from None
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


_LARGEST = 1e150  # of a number: sums of squares of larger ones may be infinite
_SHOWN = 60  # characters of a value in a message


def brief(value: object) -> str:
    """The value as a message shows it: an array by its shape where it is long."""
    text = " ".join(repr(value.tolist() if isinstance(value, np.ndarray) else value).split())
    if len(text) <= _SHOWN:
        return text
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return text[: _SHOWN - 4] + " ..."


def check_finite(name: str, array: Array, what: str = "") -> None:
    """Raises ValueError unless every number is finite, and so is its square."""
    flat = array.ravel()
    with np.errstate(over="ignore"):
        if math.isfinite(np.dot(flat, flat)):  # quicker than a look at each number
            return
        of = f"{name}: {what} " if what else name
        for place in np.argwhere(~(np.abs(array) <= _LARGEST))[:1].tolist():
            needed = "finite" if not np.isfinite(array[tuple(place)]) else f"at most {_LARGEST:g} in size"
            raise ValueError(f"{of}{place or ''} is {array[tuple(place)]:g}, and every number must be {needed}.")


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


def not_negative(name: str, value: float | Array) -> float:
    """The value as a float. Raises ValueError unless it is one number, and not below zero."""
    given = real(name, value)
    check_shape(name, given)
    if not given >= 0:
        raise ValueError(f"{name} is {given:g}, and must not be below 0.")
    return float(given)


def squared(name: str, deviation: float | Array) -> float:
    """The variance. Raises ValueError unless the deviation is above zero, and its square too."""
    variance = float(np.square(positive(name, deviation)))
    if not 0 < variance < math.inf:
        raise ValueError(f"{name} is {deviation:g}, and its square must be a number above 0.")
    return variance


def seeded(value: object) -> int:
    """The seed. Raises ValueError unless it is a whole number of 32 bits, not below zero."""
    return whole("seed", value, least=0, most=2**32 - 1)


def check_some(name: str, values: Sized) -> None:
    """Raises ValueError if there is none."""
    if len(values) == 0:
        raise ValueError(f"{name}: none given, at least 1 needed.")


def parts_of(name: str, value: Any, kind: type | None = None, how: str = "") -> list[Any]:
    """The parts, each of that kind. Raises ValueError unless there is one at least."""
    if not isinstance(value, (list, tuple)) and np.ndim(value if isinstance(value, np.ndarray) else 0) == 0:
        raise ValueError(f"{name}: {type(value).__name__} given, a list needed.")
    check_some(name, value)
    for i, part in enumerate(value):
        if kind is not None:
            check_kind(f"{name}[{i}]", part, kind, how)
    return list(value)


def whole(name: str, value: object, *, least: int = 1, most: int = 2**31 - 1) -> int:
    """The value as an integer. Raises ValueError unless it is one, from the least to the most."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        raise ValueError(f"{name} is {brief(value)}, and must be a whole number.")
    if value < least:
        raise ValueError(f"{name} is {value}, and must be at least {least}.")
    if value > most:
        raise ValueError(f"{name} is too large, and must be at most {most}.")
    return int(value)


def check_kind(name: str, value: object, kind: type, how: str) -> None:
    """Raises ValueError unless the value is of that kind; `how` says how one is made."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: {type(value).__name__} given, {kind.__name__} needed: {how}.")


def one_of(name: str, value: object, words: Sequence[str]) -> None:
    """Raises ValueError unless the value is one of the words."""
    if not isinstance(value, str) or value not in words:
        *most, last = map(repr, words)
        raise ValueError(f"{name}: {brief(value)} given, {', '.join(most)} or {last} needed.")


def pair(name: str, demonstration: object) -> tuple[ArrayLike, ArrayLike]:
    """Inputs and outputs of a demonstration. Raises ValueError unless it is a pair."""
    if isinstance(demonstration, (tuple, list)) and len(demonstration) == 2:
        return demonstration[0], demonstration[1]
    of = f" of shape {demonstration.shape}" if isinstance(demonstration, np.ndarray) else ""
    needed = "a pair needed: inputs (T, I) and outputs (T, O)"
    raise ValueError(f"{name}: {type(demonstration).__name__}{of} given, {needed}.")


def checked_demonstrations(demonstrations: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[Array, Array]]:
    """Inputs (T, I) and outputs (T, O) of each. Raises ValueError if one has no sample."""
    data: list[tuple[Array, Array]] = []
    for h, demonstration in enumerate(parts_of("demonstrations", demonstrations)):
        inputs, outputs = pair(f"demonstrations[{h}]", demonstration)
        i, o = (data[0][0].shape[1], data[0][1].shape[1]) if data else ("I", "O")
        s = numbers(f"demonstrations[{h}] inputs", inputs, "T", i)
        data.append((s, numbers(f"demonstrations[{h}] outputs", outputs, len(s), o)))
        if len(s) == 0:
            raise ValueError(f"demonstrations[{h}]: no sample given, at least 1 needed.")
    return data
