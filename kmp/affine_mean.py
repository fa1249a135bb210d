"""A prior mean that goes with the input: what is learned is how the output departs from it."""

from __future__ import annotations

from dataclasses import dataclass

from kmp.checks import Array, numbers
from kmp.immutable import Immutable


@dataclass(frozen=True, eq=False, repr=False)
class AffineMean(Immutable):
    """matrix @ s + offset at an input s (I,): linear regression, or a straight way over time.

    matrix (O, I) [unit of the outputs / unit of the inputs], offset (O,) [unit of the outputs].
    Read-only. Far from the data it extrapolates, where a constant would stay. Raises ValueError if
    shapes do not agree or a number is not finite.
    """

    matrix: Array
    offset: Array

    def __post_init__(self) -> None:
        matrix = numbers("prior_mean.matrix", self.matrix, "O", "I")
        offset = numbers("prior_mean.offset", self.offset, "O")
        if len(matrix) != len(offset):
            raise ValueError(
                f"prior_mean: matrix of shape {matrix.shape} and offset of shape {offset.shape} given, "
                f"(O, I) and (O,) needed."
            )
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "offset", offset)
