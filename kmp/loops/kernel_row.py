"""The kernel row of one query, centre by centre, for compiled loops: the Gaussian kernel, in the
coordinates in which one scale serves all inputs.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.arrays.checks import Array
from kmp.compiled import compiled


@compiled
def kernel_value(query: Array, centre: Array, scale: float, offset: Array) -> float:
    """k(x, x_r) = exp(-scale |x - x_r|^2) of a query x (I,) and a centre, whose first I numbers are
    x_r; x - x_r into `offset` (I,). The paper, section III.
    """
    square = 0.0
    for i in range(len(query)):
        offset[i] = query[i] - centre[i]
        square += offset[i] * offset[i]
    return math.exp(-scale * square)


@compiled
def add_weighted(query: Array, rows: Array, scale: float, out: Array) -> None:
    """Adds sum_r k(x, x_r) w_r to `out` (O,), for a query x (I,) and rows (R, I + O) of a centre
    and its weights each. Equation (8).
    """
    inputs = len(query)
    offset = np.empty(inputs)
    for r in range(len(rows)):
        value = kernel_value(query, rows[r], scale, offset)
        for o in range(len(out)):
            out[o] += value * rows[r, inputs + o]
