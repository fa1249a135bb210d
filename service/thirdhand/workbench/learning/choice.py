"""Selection of hyper-parameters for takes, in metres: the reference points, and the scales of
`kmp.criteria.direct`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kmp.criteria.direct import DirectSelection, Scales
from thirdhand.core.frame import Vector
from thirdhand.skills.via_points import MAX_GAIN

# an input that varies by less, as trembling hands do, does not move the affine mean
RIDGE_M = 0.005
NOISE_M = 0.001  # noise of a good tracker on each axis
# this share of the reference points is even in time, the rest along the hands' path
DWELL_SHARE = 0.25
LEAST_POINTS = 4  # reference points of a demonstration
POSITION_SCALES = Scales(
    ells=(
        2.0 ** np.arange(-1.0, 4.0)
    ).tolist(),  # [1/m²] beyond these, via-points bend everything or nothing
    ridges=(RIDGE_M,),
    linear_share=0.9,  # an affine mean extrapolates, so it must be clearly better
    max_gain=MAX_GAIN,
    local=0.08,  # [m]
    noise=NOISE_M,
)
RICH_SCALES = POSITION_SCALES._replace(
    ells=(
        2.0 ** np.arange(-1.0, 6.0)
    ).tolist(),  # [1/m²] inputs with memory or turns are farther from each other
    ridges=(RIDGE_M, 0.05),  # [m] the second one suppresses redundant inputs
    linear_share=1.0,
)


def selection_of(
    pairs: Sequence[tuple[Vector, Vector]],
    points: int,
    *,
    persons: NDArray[np.intp] | None = None,
    isotropic: bool = False,
    rich: bool = False,
    earlier: int = 0,
    factor: float = 1.0,
) -> DirectSelection:
    """About `points` reference points of demonstrations, each inputs (T, I) and tool (T, 3) [m], in
    groups by `persons` (H,); None if each is by another person.

    Those of `rich` inputs are even in time, and their prior mean is chosen with the kernel. The
    last `earlier` pairs are of a skill that is refined: their points have this `factor` on their
    noise, and are not judged.
    """
    counts = shared_counts(points, len(pairs) - earlier, earlier, LEAST_POINTS)
    parts = [
        (even_in_time if rich else thinned)(*pair, count)
        for pair, count in zip(pairs, counts, strict=True)
    ]
    numbers = np.arange(len(parts), dtype=np.intp) if persons is None else persons
    inputs, outputs = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    group = np.repeat(numbers, [len(values) for values, _ in parts])
    scales = RICH_SCALES if rich else POSITION_SCALES
    if not earlier:
        return DirectSelection(inputs, outputs, group, scales, isotropic, joint=rich)
    is_new = np.repeat(
        np.arange(len(pairs)) < len(pairs) - earlier, [len(values) for values, _ in parts]
    )
    factors = np.where(is_new, 1.0, factor)
    return DirectSelection(inputs, outputs, group, scales, isotropic, rich, factors, is_new)


def shared_counts(count: int, new: int, earlier: int, least: int) -> list[int]:
    """The numbers of points of each new and each earlier take, of about `count` in all and at least
    `least` each: with earlier takes, half of them are for the new ones.
    """
    if not earlier:
        return [max(least, count // new)] * new
    return [max(least, count // 2 // new)] * new + [max(least, count // 2 // earlier)] * earlier


def thinned(hands: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` samples of hands (T, 6) and tool (T, 3) [m], evenly along the hands' path and,
    so that rests keep some, a little along time.
    """
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(hands, axis=0), axis=1))])
    along = path / max(path[-1], 1e-9) + DWELL_SHARE * np.linspace(0.0, 1.0, len(path))
    rows = np.unique(
        np.searchsorted(along, np.linspace(0.0, along[-1], count)).clip(0, len(path) - 1)
    )
    return hands[rows], tool[rows]


def even_in_time(inputs: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` samples of inputs (T, I) and tool (T, 3), evenly in time."""
    rows = np.unique(np.linspace(0.0, len(inputs) - 1, count).round().astype(int))
    return inputs[rows], tool[rows]
