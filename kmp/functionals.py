"""Linear functionals of the output: xi(s), or the derivative d/dt xi(s + t v) at t = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import Array, numbers
from kmp.arrays.immutable import Immutable, frozen


@dataclass(frozen=True, eq=False, repr=False)
class Functionals(Immutable):
    """N linear functionals of the output: its value at an input, or its derivative there.

    The kernel between two derivatives along u and v is u^T (d^2 k(s, s') / ds ds') v (Rasmussen and
    Williams 2006, section 9.4).
    """

    inputs: Array  # (N, I)
    directions: Array | None = None
    """(N, I) the direction of each derivative, zero for a value; None where all are values."""

    @classmethod
    def checked(cls, inputs: Array, directions: ArrayLike | None) -> Functionals:
        """The functionals at inputs (N, I). Raises ValueError if the directions are not (N, I)."""
        if directions is None:
            return cls(inputs)
        along = numbers("directions", directions, *inputs.shape)
        return cls(inputs, along if along.any() else None)

    @staticmethod
    def concatenated(parts: Sequence[Functionals]) -> Functionals:
        """All functionals of the parts, in order."""
        if len(nonempty := [part for part in parts if len(part)]) == 1:
            return nonempty[0]
        inputs = frozen(np.concatenate([part.inputs for part in parts]))
        if all(part.directions is None for part in parts):
            return Functionals(inputs)
        return Functionals(inputs, frozen(np.concatenate([part.along for part in parts])))

    def __len__(self) -> int:
        return len(self.inputs)

    def take(self, index: NDArray[Any] | slice) -> Functionals:
        """The chosen functionals, in the order of the index."""
        directions = None if self.directions is None else frozen(self.directions[index].copy())
        return Functionals(frozen(self.inputs[index].copy()), directions)

    @property
    def along(self) -> Array:
        """(N, I) the directions, all zero where all are values."""
        return np.zeros(self.inputs.shape) if self.directions is None else self.directions

    @cached_property
    def values(self) -> NDArray[np.bool_]:
        """(N,) true for a value, false for a derivative."""
        if self.directions is None:
            return frozen(np.ones(len(self), dtype=bool))
        return frozen(np.asarray(~self.directions.any(axis=1)))
