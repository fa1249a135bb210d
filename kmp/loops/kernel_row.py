"""The Gaussian kernel between a query and each centre, for compiled loops.

k(x, x_r) = exp(-scale |x - x_r|^2) in the coordinates x = stretch * s. The paper, section III.
"""

from __future__ import annotations

import numpy as np

from kmp.arrays.checks import Array
from kmp.compiled import compiled
from kmp.elementary import exp


@compiled
def kernel_value(query: Array, centre: Array, scale: float, offset: Array) -> float:
    """k(x, x_r) of a query x (I,) and a centre, whose first I numbers are x_r.

    Writes x - x_r to `offset` (I,).
    """
    square = 0.0
    for i in range(len(query)):
        offset[i] = query[i] - centre[i]
        square += offset[i] * offset[i]
    return exp(-scale * square)


@compiled
def add_weighted(query: Array, rows: Array, scale: float, out: Array) -> None:
    """Add sum_r k(x, x_r) w_r to `out` (O,), equation (8).

    x (I,) is the query; each of the rows (R, I + O) is a centre x_r and its weights w_r.
    """
    inputs = len(query)
    offset = np.empty(inputs)
    for r in range(len(rows)):
        value = kernel_value(query, rows[r], scale, offset)
        for o in range(len(out)):
            out[o] += value * rows[r, inputs + o]
