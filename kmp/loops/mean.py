"""Equation (8) as compiled loops that vector units can execute.

xi(s) = sum_r exp(-scale |x - x_r|^2) w_r + m(s) in the coordinates x = stretch * s.

A table (I + O, P) holds the coordinates x_r and the weights w_r of R centres as rows. P is R
rounded up to LANES; the padding has weight 0. Each sum consists of LANES sums of every LANES-th
term, so that its order is the same on every CPU.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array
from kmp.compiled import compiled

LANES = 4  # partial sums of each sum: a vector unit of 256 bits adds four numbers at once

# exp(x) = 2^k exp(f) with k whole and |f| <= ln 2 / 2, as in C libraries, without branch or table.
_LOG2_E = 1.4426950408889634
_LN2_HIGH = 6.93147180369123816490e-01  # its last bits are 0, so that k times it is exact
_LN2_LOW = 1.90821492927058770002e-10
# 1.5 * 2^52: x + _ROUND holds x, rounded to a whole number, in its last bits
_ROUND = 6755399441055744.0
_LEAST = -708.0  # exp of less is below 1e-307, and set to 0
_EXPONENT = 52  # position of the exponent in the bits of a number


def table_of(centres: Array, weights: Array) -> Array:
    """The table (I + O, P) of centres (R, I) and weights (R, O)."""
    count, inputs = centres.shape
    outputs = weights.shape[1]
    table = np.zeros((inputs + outputs, -(-count // LANES) * LANES))
    table[:inputs, :count] = centres.T
    table[inputs:, :count] = weights.T
    return table


@compiled
def exponentials(values: Array, scale: float, steps: Array) -> None:
    """Replace each v >= 0 of the values (P,) by exp(-scale v), to one unit in the last place.

    `steps` (P,) is working memory.
    """
    for r in range(len(values)):
        x = values[r] * -scale
        step = x * _LOG2_E + _ROUND
        k = step - _ROUND
        f = (x - k * _LN2_HIGH) - k * _LN2_LOW
        # The series to f^13, in terms that do not depend on each other.
        g = f * f
        h = g * g
        p = (0.5 + f * (1 / 6)) + g * (1 / 24 + f * (1 / 120))
        q = (1 / 720 + f * (1 / 5040)) + g * (1 / 40320 + f * (1 / 362880))
        q += h * ((1 / 3628800 + f * (1 / 39916800)) + g * (1 / 479001600 + f * (1 / 6227020800)))
        p = 1.0 + (f + g * (p + h * q))
        values[r] = p if x > _LEAST else 0.0
        steps[r] = step if x > _LEAST else _ROUND
    bits = values.view(np.int64)
    whole = steps.view(np.int64)
    for r in range(len(bits)):
        bits[r] += whole[r] << _EXPONENT


@compiled
def _kernel_values(x: Array, table: Array, scale: float, values: Array, room: Array) -> None:
    """Write exp(-scale |x - x_r|^2) of x (I,) to `values` (P,). `room` (P,) is working memory."""
    inputs = len(x)
    values[:] = 0.0
    for i in range(0, inputs - 1, 2):
        coordinate = x[i]
        other_coordinate = x[i + 1]
        centres = table[i]
        others = table[i + 1]
        for r in range(len(values)):
            offset = coordinate - centres[r]
            other = other_coordinate - others[r]
            values[r] += offset * offset + other * other
    if inputs % 2:
        coordinate = x[inputs - 1]
        centres = table[inputs - 1]
        for r in range(len(values)):
            offset = coordinate - centres[r]
            values[r] += offset * offset
    exponentials(values, scale, room)


@compiled
def _derive(
    x: Array, table: Array, places: NDArray[np.intp], along: Array, scale: float, values: Array
) -> None:
    """Replace the values at indices `places` (R',) by derivatives along `along` (R', I)."""
    for n in range(len(places)):
        r = places[n]
        away = 0.0
        for i in range(len(x)):
            away += (x[i] - table[i, r]) * along[n, i]
        values[r] *= 2.0 * scale * away


@compiled
def sum_products(a: Array, b: Array) -> float:
    """sum_r a_r b_r (P,)."""
    # Signed indices may count from the end, which costs a check each.
    unit = np.uint64(1)
    two = np.uint64(2)
    three = np.uint64(3)
    first = second = third = fourth = 0.0
    for k in range(len(a) // LANES):
        r = np.uint64(LANES * k)
        first += a[r] * b[r]
        second += a[r + unit] * b[r + unit]
        third += a[r + two] * b[r + two]
        fourth += a[r + three] * b[r + three]
    return (first + second) + (third + fourth)


@compiled
def add_table(x: Array, table: Array, scale: float, values: Array, room: Array, out: Array) -> None:
    """Add sum_r exp(-scale |x - x_r|^2) w_r at x (I,), in the kernel's coordinates, to `out` (O,).

    `values` (P,), which receives the kernel row, and `room` (P,) are working memory.
    """
    _kernel_values(x, table, scale, values, room)
    for o in range(len(out)):
        out[o] += sum_products(values, table[len(x) + o])


@compiled
def means(
    queries: Array,
    table: Array,
    places: NDArray[np.intp],
    along: Array,
    coordinates: Array,
    prior: Array,
    values: Array,
    out: Array,
) -> bool:
    """Write xi at queries (M, I) to `out` (M, O), the last kernel row to `values` (P,).

    Returns true if all is finite. `places` (R',) are the indices of the centres that are
    derivatives along `along` (R', I); `coordinates` (1 + I,) the kernel's scale and the stretch of
    each input; `prior` the prior mean's offset and matrix (O, 1 + I).
    """
    scale = coordinates[0]
    stretch = coordinates[1:]
    outputs = len(prior)
    inputs = len(stretch)
    x = np.empty(inputs)
    room = np.empty(len(values))
    total = 0.0
    for m in range(len(queries)):
        for i in range(inputs):
            x[i] = queries[m, i] * stretch[i]
            total += x[i]
        _kernel_values(x, table, scale, values, room)
        _derive(x, table, places, along, scale, values)
        for o in range(outputs):
            mean = sum_products(values, table[inputs + o]) + prior[o, 0]
            for i in range(inputs):
                mean += prior[o, 1 + i] * queries[m, i]
            out[m, o] = mean
            total += mean
    return math.isfinite(total)
