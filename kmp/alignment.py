"""Demonstrations of different durations over a common phase."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, check_kind, checked_demonstrations
from kmp.arrays.immutable import frozen


def aligned(
    demonstrations: Sequence[tuple[ArrayLike, ArrayLike]], *, velocity: bool = False
) -> list[tuple[Array, Array]]:
    """The demonstrations over their phase: for each its phase (T, 1) from 0 to 1, outputs (T, O).

    Each demonstration is time (T, 1) and outputs (T, O); begins, durations and numbers of samples
    may differ. The phase is the time since the first sample over the duration. With `velocity`, the
    outputs are values and then their rates over time, which become rates over the phase: they are
    multiplied by the duration.

    Raises ValueError if shapes do not agree, a number is not finite, or a time does not increase.
    """
    check_kind("velocity", velocity, bool, "True or False")
    over_phase = []
    for h, (time, outputs) in enumerate(checked_demonstrations(demonstrations)):
        width = outputs.shape[1]
        if time.shape[1] != 1 or (velocity and width % 2):
            raise ValueError(
                f"demonstrations[{h}]: {time.shape[1]} inputs and {width} outputs given, needed is "
                "time, and with `velocity` as many rates as values."
            )
        duration = time[-1, 0] - time[0, 0]
        if not (duration > 0 and (np.diff(time[:, 0]) >= 0).all()):
            raise ValueError(f"demonstrations[{h}]: time falls or stands still, and must increase.")
        scale = np.ones(width)
        scale[width // 2 :] = duration if velocity else 1.0
        over_phase.append((frozen((time - time[0]) / duration), frozen(outputs * scale)))
    return over_phase
