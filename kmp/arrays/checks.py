"""Checks of arguments, each a ValueError that names the argument, and the package's warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.immutable import frozen

Array: TypeAlias = NDArray[np.float64]
Seed: TypeAlias = int | np.random.Generator


class ViaPointMissed(UserWarning):
    """The mean misses a via-point by more than the via-point's deviation allows."""


class RankReached(UserWarning):
    """The rank was too low for the data, so the low rank solution lost accuracy."""


def real(name: str, value: ArrayLike) -> Array:
    """The value as an array of float64, not copied if it is one. Raises ValueError if not real."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise ValueError(
            f"{name}: rows of different lengths given, an array of real numbers needed."
        ) from None
    if array.dtype.char == "d":
        return array
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name}: numbers of type {array.dtype} given, real ones needed.")
    return np.asarray(array, dtype=np.float64)


def numbers(name: str, value: ArrayLike, *shape: int | str) -> Array:
    """A read-only copy of `value`, which must have this shape; a word stands for any length.

    Where the second length may be 1, (N,) is (N, 1): of one input, or one output.

    Raises ValueError if the shape differs or a number is not real and finite.
    """
    array = np.array(real(name, value), dtype=np.float64, order="C")
    if array.ndim == 1 and array.size and shape[1:] in (("I",), (1,)):
        array = array[:, None]
    check_shape(name, array, *shape)
    check_finite(name, array)
    return frozen(array)


_LARGEST = 1e150  # the sum of squares of larger numbers may be infinite
_SHOWN = 60  # a message shows at most this many characters of a value


def brief(value: object) -> str:
    """The value as a message shows it: cut to 60 characters, a long array as its shape."""
    text = " ".join(repr(value.tolist() if isinstance(value, np.ndarray) else value).split())
    if len(text) <= _SHOWN:
        return text
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return text[: _SHOWN - 4] + " ..."


def check_finite(name: str, array: Array, what: str = "") -> None:
    """Raise ValueError unless every number and its square are finite."""
    if math.isfinite(np.vdot(array, array)):  # fast, and of all products the one that never warns
        return
    of = f"{name}: {what} " if what else name
    for place in np.argwhere(~(np.abs(array) <= _LARGEST))[:1].tolist():
        number = array[tuple(place)]
        needed = f"at most {_LARGEST:g} in size" if np.isfinite(number) else "finite"
        raise ValueError(f"{of}{place or ''} is {number:g}, and every number must be {needed}.")


def check_shape(name: str, array: Array, *shape: int | str) -> None:
    """Raise ValueError unless the array has this shape; a word stands for any length."""
    if array.shape == shape:
        return
    if array.ndim == len(shape) and all(
        n == m or isinstance(n, str) for n, m in zip(shape, array.shape, strict=True)
    ):
        return
    shape_text = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    raise ValueError(f"{name}: shape {array.shape} given, ({shape_text}) needed.")


def positive(name: str, value: float | Array) -> float:
    """The value as a float. Raises ValueError unless it is one finite number above 0."""
    array = real(name, value)
    if array.ndim and name.startswith("lambda"):
        raise ValueError(
            f"{name}: shape {array.shape} given, one number needed. For points that are met less, "
            "as by a lambda over time, multiply their covariances in the reference."
        )
    check_shape(name, array)
    number = float(array)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} is {number:g}, and must be finite and above 0.")
    return number


def not_negative(name: str, value: float | Array) -> float:
    """The value as a float. Raises ValueError unless it is one number of at least 0."""
    array = real(name, value)
    check_shape(name, array)
    if not array >= 0:
        raise ValueError(f"{name} is {array:g}, and must not be below 0.")
    return float(array)


def squared(name: str, deviation: float | Array) -> float:
    """The variance of a deviation. Raises ValueError unless both are finite and above 0."""
    variance = float(np.square(positive(name, deviation)))
    if not 0 < variance < math.inf:
        raise ValueError(f"{name} is {deviation:g}, and its square must be a number above 0.")
    return variance


def seeded(value: object) -> int:
    """The seed, or one that is drawn from a generator.

    Raises ValueError unless it is a generator, or a whole number from 0 to 2^32 - 1.
    """
    if isinstance(value, np.random.Generator):
        return int(value.integers(2**32))
    return whole("seed", value, least=0, most=2**32 - 1)


def check_some(name: str, values: Sized) -> None:
    """Raise ValueError if the values are empty."""
    if len(values) == 0:
        raise ValueError(f"{name}: none given, at least 1 needed.")


def parts_of(name: str, value: Any, kind: type | None = None, how: str = "") -> list[Any]:
    """The parts as a list. Raises ValueError if there is none, or one is not of this kind."""
    if (
        not isinstance(value, (list, tuple))
        and np.ndim(value if isinstance(value, np.ndarray) else 0) == 0
    ):
        raise ValueError(f"{name}: {type(value).__name__} given, a list needed.")
    check_some(name, value)
    for i, part in enumerate(value):
        if kind is not None:
            check_kind(f"{name}[{i}]", part, kind, how)
    return list(value)


def whole(name: str, value: object, *, least: int = 1, most: int = 2**31 - 1) -> int:
    """The value as an int. Raises ValueError unless it is whole and from `least` to `most`."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        raise ValueError(f"{name} is {brief(value)}, and must be a whole number.")
    if value < least:
        raise ValueError(f"{name} is {value}, and must be at least {least}.")
    if value > most:
        raise ValueError(f"{name} is too large, and must be at most {most}.")
    return int(value)


def check_kind(name: str, value: object, kind: type, how: str) -> None:
    """Raise ValueError unless the value is of this kind; `how` shows how to make one."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: {type(value).__name__} given, {kind.__name__} needed: {how}.")


def one_of(name: str, value: object, words: Sequence[str]) -> None:
    """Raise ValueError unless the value is one of the words."""
    if not isinstance(value, str) or value not in words:
        *most, last = map(repr, words)
        raise ValueError(f"{name}: {brief(value)} given, {', '.join(most)} or {last} needed.")


def checked_demonstrations(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
) -> list[tuple[Array, Array]]:
    """Inputs (T, I) and outputs (T, O) of each demonstration. Raises ValueError if one is empty."""
    data: list[tuple[Array, Array]] = []
    for h, demonstration in enumerate(parts_of("demonstrations", demonstrations)):
        if not (isinstance(demonstration, (tuple, list)) and len(demonstration) == 2):
            raise ValueError(
                f"demonstrations[{h}]: {brief(demonstration)} given, a pair needed: inputs (T, I) "
                "and outputs (T, O)."
            )
        inputs, outputs = demonstration
        i, o = (data[0][0].shape[1], data[0][1].shape[1]) if data else ("I", "O")
        s = numbers(f"demonstrations[{h}] inputs", inputs, "T", i)
        data.append((s, numbers(f"demonstrations[{h}] outputs", outputs, len(s), o)))
        if len(s) == 0:
            raise ValueError(f"demonstrations[{h}]: no sample given, at least 1 needed.")
    return data
