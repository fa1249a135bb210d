"""Whether demonstrations contradict each other: the same hands, as far as the tracker can tell, and
another tool.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from service.core.frame import Vector
from service.learning.demonstration import Demonstration

COMPARED = 100  # samples of a demonstration, of which each is compared with each
ALIKE_M = 0.02  # hands so near contradict each other if nothing else tells their tools apart either
SAME_M = 0.003  # hands so near are the same, however good the tracker: nobody holds still any better
NOISES = 7.0  # deviations of the noise between two sightings of the same two hands: 99.9 % are nearer
WINDOW_S, LEAST_SAMPLES = 0.1, 7  # in which hands move along a parabola, but for noise


def same_hands_m(demonstrations: Iterable[Demonstration]) -> float:
    """The distance of hands (6) [m] below which their tracker cannot tell them apart."""
    return float(np.clip(NOISES * tracker_noise_m(demonstrations), SAME_M, ALIKE_M))


def tracker_noise_m(demonstrations: Iterable[Demonstration]) -> float:
    """The standard deviation of the noise in hands' positions, on each axis [m]: what is left over
    of parabolas, in the median of short windows, as few of them hold a jerk. 0: none is found.
    """
    variances = [np.zeros(0)]
    for one in demonstrations:
        hands, count = one.hands, max(LEAST_SAMPLES, round(WINDOW_S / one.period_s))
        parts = hands[: len(hands) // count * count].reshape(-1, count, 6)
        parabolas, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), 3))
        left = parts - parabolas @ (parabolas.T @ parts)
        variances.append((left**2).sum(axis=(1, 2)) / (6 * (count - 3)))
    found = np.concatenate(variances)
    return float(np.sqrt(np.median(found))) if len(found) else 0.0


def ambiguity(
    hands: Sequence[Vector],
    tools: Sequence[Vector],
    names: Sequence[str],
    distances: Callable[[Vector], Vector],
    *,
    apart: float,
    near_m: float,
    missed: Sequence[Vector],
    told: Callable[[float], str],
) -> tuple[float, str]:
    """The share of samples that have another with the same hands and the tool `apart` from theirs,
    and the worst such pair in words.

    Hands are the same nearer than `near_m` to each other; and nearer than ALIKE_M where what was
    learned from other demonstrations misses the tool (T,) by half of `apart`: it cannot tell them
    apart. `distances` are those (M, M) from each to each of some tools, `told` one in words.
    """
    at = [np.linspace(0, len(some) - 1, min(COMPARED, len(some))).round().astype(int) for some in hands]
    known, shown, off = (
        np.concatenate([x[i] for x, i in zip(some, at, strict=True)]) for some in (hands, tools, missed)
    )
    owner = [f"{name} (sample {i})" for name, some in zip(names, at, strict=True) for i in some]
    squares = _squares(known)
    same = (squares < near_m**2) | ((squares < ALIKE_M**2) & (off > apart / 2)[:, None])
    found = distances(shown) * same
    i, j = np.unravel_index(int(found.argmax()), found.shape)
    worst = (
        f"{owner[i]} and {owner[j]} have the hands {1000 * np.linalg.norm(known[i] - known[j]):.0f} mm from each other "
        f"and the tools {told(found[i, j])}"
    )
    return float((found.max(axis=1) > apart).mean()), worst


def lengths(points: Vector) -> Vector:
    """Distances (M, M) of points (M, D) from each other."""
    return np.sqrt(np.maximum(_squares(points), 0.0))


def _squares(points: Vector) -> Vector:
    squares = (points**2).sum(axis=1)
    return np.asarray(squares[:, None] + squares - 2 * points @ points.T)
