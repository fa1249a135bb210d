"""What every value of this package demands of the numbers that it is made of."""

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


def numbers(name: str, value: ArrayLike, *shape: int | str) -> Array:
    """A read-only copy of `value`: every number finite, and of the given shape, where a word stands for any length."""
    array = np.array(value, dtype=np.float64, order="C")
    fits = array.ndim == len(shape) and all(n in (m, str(n)) for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        raise ValueError(f"{name}: shape {array.shape} given, ({wanted}) needed.")
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(place)} is {array[place]}, and every number must be finite.")
    return frozen(array)


def positive(name: str, value: float) -> float:
    """The value as a float, finite and above zero."""
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} is {number:g}, and must be finite and above 0.")
    return number
