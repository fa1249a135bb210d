"""Several references combined into one by priorities: the superposition of IJRR 2019."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, numbers, parts_of, real
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, check_alike, fused_mean


def superposed(references: Sequence[Gaussians], priorities: ArrayLike) -> Gaussians:
    """L references over the same N inputs, combined into one by their priorities g.

    Priorities (L,) or (L, N) have the sum 1: Sigma = (sum_l (Sigma_l / g_l)^-1)^-1,
    mu = Sigma sum_l (Sigma_l / g_l)^-1 mu_l. Priority 0 excludes a reference; priorities that
    change along the inputs blend from one reference to the next. IJRR 2019, superposition.

    Raises ValueError if there is no reference, shapes do not agree, or a priority is below 0 or
    their sum is not 1.
    """
    check_alike("references", parts_of("references", references))
    g = _priorities(priorities, len(references), len(references[0]))
    inverses = [np.linalg.inv(normals.covariance) for normals in references]
    precisions = [
        weight[:, None, None] * inverse for weight, inverse in zip(g, inverses, strict=True)
    ]
    covariance = np.linalg.inv(np.sum(precisions, axis=0))
    return Gaussians(fused_mean(covariance, precisions, references), symmetric(covariance))


def _priorities(priorities: ArrayLike, count: int, n: int) -> Array:
    """The priorities (L, N) or (L, 1), checked."""
    array = real("priorities", priorities)
    g = numbers("priorities", array[:, None] if array.ndim == 1 else array, count, "N")
    if g.shape[1] not in {1, n}:
        raise ValueError(
            f"priorities: shape {array.shape} given, ({count},) or {(count, n)} needed."
        )
    least = g.min()
    total = g.sum(axis=0)
    if least < 0 or np.abs(total - 1).max() > 1e-6:
        raise ValueError(
            f"priorities: from {least:g}, of sum {total[0]:g} given; needed are sums of 1, none "
            "below 0."
        )
    return g
