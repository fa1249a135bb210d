"""Root mean square errors, and the preferred candidate among those with small errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from kmp.arrays.checks import Array

T = TypeVar("T")


def rms(errors: Array) -> float:
    """The root mean square length of errors (M, O)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def preferred(candidates: Sequence[T], scores: Sequence[float], limit: float) -> T:
    """The first candidate, in the order of preference, whose score is at most the limit.

    Raises ValueError if there is none.
    """
    for candidate, score in zip(candidates, scores, strict=True):
        if score <= limit:
            return candidate
    raise ValueError(
        f"limit: {limit:g} given, at least the least score, {min(scores, default=np.nan):g}, "
        "needed."
    )
