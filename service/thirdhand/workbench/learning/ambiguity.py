"""Contradictions between takes: samples with the same hands, as far as the tracker can tell, and
different tools.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.records import HeldOut

COMPARED = 100  # samples of a take that are compared with those of all takes
MOST_COMPARED = 10_000  # of all takes: the time to compare them grows with its square
COMPARED_AT_ONCE = 256  # samples that are compared with all others at once, which bounds the memory
# hands up to this distance are the same if predictions cannot tell their tools apart either
ALIKE_M = 0.02
# hands up to this distance are the same with any tracker, as nobody holds still any better
SAME_HANDS_M = 0.003
# two measurements of the same hands are nearer than 7 standard deviations in 99.9 % of all cases
NOISE_RATIO = 7.0
PARABOLA_S = 0.1  # hands move along a parabola in windows of this length
WINDOW_SAMPLES = 7  # samples of a window


class Contradictions(NamedTuple):
    """The share of samples that contradict another one, and the worst pair."""

    share: float
    pair: str  # names the two samples
    hands_m: float  # distance of the pair's hands
    tools: float  # distance of the pair's tools


def same_hands_m(demonstrations: Iterable[Demonstration]) -> float:
    """The distance of hands (6) [m] below which the tracker cannot tell them apart:
    NOISES times its noise, from SAME_M to ALIKE_M.
    """
    return float(np.clip(NOISE_RATIO * tracker_noise_m(demonstrations), SAME_HANDS_M, ALIKE_M))


def tracker_noise_m(demonstrations: Iterable[Demonstration]) -> float:
    """The standard deviation [m] of the hands' positions on each axis, or 0 without samples.

    It is the residual of a parabola in the median of short windows, few of which contain a jerk.
    """
    variances = [np.zeros(0)]
    for demonstration in demonstrations:
        hands = demonstration.hands
        count = max(WINDOW_SAMPLES, round(PARABOLA_S / demonstration.period_s))
        parts = hands[: len(hands) // count * count].reshape(-1, count, 6)
        parabolas, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), 3))
        left = parts - parabolas @ (parabolas.T @ parts)
        variances.append((left**2).sum(axis=(1, 2)) / (6 * (count - 3)))
    all_variances = np.concatenate(variances)
    return float(np.sqrt(np.median(all_variances))) if len(all_variances) else 0.0


def contradictions(
    held_out: Sequence[HeldOut],
    tools: Sequence[Vector],
    missed: Sequence[Vector],
    distances: Callable[[Vector, Vector], Vector],
    *,
    different: float,
    near_m: float,
) -> Contradictions:
    """The contradictions between takes: tools (T, O) at the same hands whose distance is more than
    `different`.

    Hands are the same up to `near_m`, or up to ALIKE_M where the prediction from other takes misses
    the tool (T,) by more than half of `different`. `distances` (M, N) are those between tools
    (M, O) and (N, O).
    """
    count = min(COMPARED, max(1, MOST_COMPARED // len(held_out)))
    sampled_rows = [
        np.linspace(0, len(result.known) - 1, min(count, len(result.known))).round().astype(int)
        for result in held_out
    ]
    known_m, outputs, errors = (
        np.concatenate([values[rows] for values, rows in zip(column, sampled_rows, strict=True)])
        for column in ([result.known for result in held_out], tools, missed)
    )
    owner = [
        f"{result.take.name} (sample {i})"
        for result, rows in zip(held_out, sampled_rows, strict=True)
        for i in rows
    ]
    squares = (known_m**2).sum(axis=1)
    worst = -1.0
    pair = (0, 0)
    count = 0
    for first in range(0, len(known_m), COMPARED_AT_ONCE):
        rows = slice(first, first + COMPARED_AT_ONCE)
        hands = squares[rows, None] + squares - 2 * known_m[rows] @ known_m.T
        is_alike = (hands < near_m**2) | (
            (hands < ALIKE_M**2) & (errors[rows] > different / 2)[:, None]
        )
        differences = distances(outputs[rows], outputs) * is_alike
        count += int((differences.max(axis=1) > different).sum())
        if differences.max() > worst:
            worst = float(differences.max())
            row, column = divmod(int(differences.argmax()), len(known_m))
            pair = first + row, column
    i, j = pair
    return Contradictions(
        count / len(known_m),
        f"{owner[i]} and {owner[j]}",
        float(np.linalg.norm(known_m[i] - known_m[j])),
        worst,
    )


def lengths(points: Vector, others: Vector) -> Vector:
    """The distances (M, N) between points (M, D) and (N, D)."""
    squares = (points**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2 * points @ others.T
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))
