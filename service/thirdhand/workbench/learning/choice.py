"""Selection of hyper-parameters for takes, in metres: the reference points, and the scales of
`direct_selection`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thirdhand.core.frame import Vector
from thirdhand.skills.via_points import MAX_GAIN
from thirdhand.workbench.learning.direct_selection import DirectSelection, Scales

# an input that varies by less, as trembling hands do, does not move the affine mean
RIDGE_M = 0.005
NOISE_M = 0.001  # noise of a good tracker on each axis
# this share of the reference points is even in time, the rest along the hands' path
DWELL_SHARE = 0.25
ADVISED = 5  # demonstrations; fewer may not tell kinds of inputs apart
LEAST_BLOCKS = 2  # fewer blocks of takes leave nothing to compare or to calibrate by
# The demonstrations together have at most this many reference points, or about this many: the time
# and the memory to learn grow with its cube and its square.
MOST_SAMPLED = 600
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0  # its multiples are even in every interval of length 1
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
    shares = sampled(points, len(pairs) - earlier, earlier, LEAST_POINTS)
    parts = [
        (even_in_time if rich else thinned)(*pair, take_shares)
        for pair, take_shares in zip(pairs, shares, strict=True)
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


def is_clear(gains: Vector) -> bool:
    """True if the mean of gains (B,) in blocks is above one standard error of it."""
    return len(gains) < LEAST_BLOCKS or bool(
        gains.mean() > gains.std(ddof=1) / math.sqrt(len(gains))
    )


def sampled(
    count: int, new: int, earlier: int, least: int, most: int = MOST_SAMPLED
) -> list[Vector]:
    """The shares, from 0 to 1, at which each new and each earlier take is sampled: about `count` in
    all and at least `least` in each, but at most `most` in all. With earlier takes, half of them
    are in the new ones.

    Where takes have fewer than `least`, each is sampled elsewhere than the one before.
    """
    if earlier:
        return [
            *sampled(count // 2, new, 0, least, most // 2),
            *sampled(count // 2, earlier, 0, least, most // 2),
        ]
    each = max(count // new, min(least, most // new))
    if each >= least:
        return [np.linspace(0.0, 1.0, each)] * new
    counts = [each] * new if each else np.diff(np.arange(new + 1) * most // new).tolist()
    return [(np.arange(n) + i * GOLDEN % 1.0) / max(n, 1) for i, n in enumerate(counts)]


def thinned(hands: Vector, tool: Vector, shares: Vector) -> tuple[Vector, Vector]:
    """Samples of hands (T, 6) and tool (T, 3) [m] at shares of the hands' path and, so that rests
    keep some, a little of the time.
    """
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(hands, axis=0), axis=1))])
    along = path / max(path[-1], 1e-9) + DWELL_SHARE * np.linspace(0.0, 1.0, len(path))
    rows = np.unique(np.searchsorted(along, shares * along[-1]).clip(0, len(path) - 1))
    return hands[rows], tool[rows]


def even_in_time(inputs: Vector, tool: Vector, shares: Vector) -> tuple[Vector, Vector]:
    """Samples of inputs (T, I) and tool (T, 3) at shares of the time."""
    rows = rows_at(shares, len(inputs))
    return inputs[rows], tool[rows]


def rows_at(shares: Vector, count: int) -> NDArray[np.intp]:
    """The different rows, of some `count`, at shares from 0 to 1."""
    return np.unique((shares * (count - 1)).round().astype(np.intp))
