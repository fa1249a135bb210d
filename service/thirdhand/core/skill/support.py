"""Errors of held-out demonstrations and reference points nearby: how far they support a prediction,
and a local average of the tool.

The covariance of a prediction is the scatter of held-out errors at similar inputs. Far from all
demonstrations, it is the scatter of the tool over all of them.

**Neighbours.** Tasks that look alike pull the mean of a kernel over all of them to a tool that
belongs to none. The average over what was demonstrated nearby stays with one of them.

With the primitive's mean k, its reference points x_n with tools y_n, and g_n = exp(-|c (x - x_n)|²
/ (2 h²)), the mean of the mixture is

    f = k + a (Y - D k) / (ν + D),   D = Σ_n g_n,   Y = Σ_n g_n y_n

in which a is the share of the neighbours, h = NEIGHBOUR_M, ν = NEIGHBOUR_MASS and c the stretch of
the inputs: away from all points, f is k. Along x' and x'', with u_n = -c² (x - x_n) x' / h²,

    g_n' = g_n u_n,   g_n'' = g_n (u_n² - (|c x'|² + c² (x - x_n) x'') / h²)

The signs are taken with g_n, g_n^(1/4) and g_n^(1/16), that is with h, 2 h and 4 h:

    spread²    (3 ν σ² + Σ_n g_n |y_n|² - |Y|² / max(D, ν)) / (ν + D)
    distance   |Y - D f| / (ν + D)

with the standard deviation σ of the tool where nothing was demonstrated. Each is the logarithm of a
length in UNSURE_M.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from kmp import KMP, GaussianKernel
from kmp.arrays.immutable import Immutable, frozen
from kmp.compiled import compiled
from kmp.elementary import exp, log
from kmp.loops.mean import add_table, exponentials, sum_products, table_of
from thirdhand.core.frame import Vector
from thirdhand.core.numerics import PROBABILITY_ROUND_TO
from thirdhand.core.skill.task_clock import TaskClock
from thirdhand.core.skill.tuning import (
    LEAST_STD_M,
    NEIGHBOUR_CLOCK_MPS,
    NEIGHBOUR_M,
    NEIGHBOUR_MASS,
    SUPPORT_MASS,
    SUPPORT_SHARPNESS,
    UNSURE_M,
)
from thirdhand.core.vectors import rounded


@dataclass(frozen=True, eq=False, repr=False)
class LocalErrors(Immutable):
    """Errors e_m of held-out demonstrations at inputs x_m of a primitive.

    * `inputs` (M, I).
    * `errors` (M, 3) [m].
    * `stretch` (I,): factors c_i of the kernel exp(-Σ_i (c_i (x_i - x_mi))²).
    * `table`: both, as in `error_table`.
    * `unknown_std_m`: standard deviation of the tool on each axis where no demonstration was.
    """

    inputs: Vector
    errors: Vector
    stretch: Vector
    table: Vector
    unknown_std_m: float

    def __post_init__(self) -> None:
        for part in (self.inputs, self.errors, self.stretch, self.table):
            frozen(part)

    @classmethod
    def of(
        cls, primitive: KMP, inputs: Vector, errors: Vector, unknown_std_m: float
    ) -> LocalErrors:
        """Errors (M, 3) [m] at inputs (M, I) of a primitive. Its kernel is made SUPPORT_SHARPNESS
        times as sharp.
        """
        scale, stretch = cast(GaussianKernel, primitive.kernel).coordinates(inputs.shape[1])
        factors = math.sqrt(SUPPORT_SHARPNESS * scale) * np.asarray(stretch, np.float64)
        table = error_table(inputs * factors, errors)
        return cls(
            np.array(inputs, order="C"), np.array(errors, order="C"), factors, table, unknown_std_m
        )

    def covariances(self, inputs: Vector) -> Vector:
        """Covariances (T, 3, 3) [m²] at inputs (T, I), see `local_scatter`."""
        out = np.empty((len(inputs), 3, 3))
        signs = np.empty(2)
        for row, covariance in zip(np.array(inputs, order="C"), out, strict=True):
            self.scatter(row, covariance, signs)
        return out

    def scatter(self, at: Vector, out: Vector, signs: Vector) -> None:
        """Write the covariance at an input (I,) to `out`, and two signs of an error, see
        `local_scatter`.
        """
        local_scatter(at, self.stretch, self.table, self.unknown_std_m, out, signs)


def error_table(inputs: Vector, errors: Vector) -> Vector:
    """Errors e_m (M, 3) at inputs x_m (M, I) as a table of `kmp.loops.mean`, with the weights 1 and
    the products of e_m e_mᵀ, row by row.
    """
    products = (errors[:, :, None] * errors[:, None, :]).reshape(-1, 9)
    return table_of(inputs, np.hstack([np.ones((len(errors), 1)), products]))


@compiled
def local_scatter(
    at: Vector, stretch: Vector, table: Vector, unknown_std_m: float, out: Vector, signs: Vector
) -> None:
    """Covariance C (3, 3) [m²] of the tool at an input x (I,), written to `out`:

        C = (ν σ² I + Σ_m g_m e_m e_mᵀ) / (ν + Σ_m g_m) + LEAST_STD_M² I
        g_m = exp(-Σ_i (c_i (x_i - x_mi))²),   ν = SUPPORT_MASS,   σ = `unknown_std_m`

    So C is the scatter of the errors e_m at similar inputs x_m, and grows to σ² away from all of
    them. It is the posterior mean of a variance whose prior σ² weighs as much as ν errors. `table`
    is the `error_table` of c_i x_mi.

    The lengths of the scatter with g_m² and g_m^(1/4) are two signs of an error, written to `signs`
    (2,).
    """
    near = np.zeros(1 + out.size)
    padded = table.shape[1]
    g = np.empty(padded)
    other = np.empty(padded)
    add_table(at * stretch, table, 1.0, g, other, near)
    total = SUPPORT_MASS + near[0]
    for i in range(3):
        for j in range(3):
            out[i, j] = near[1 + 3 * i + j] / total
        out[i, i] += SUPPORT_MASS * unknown_std_m**2 / total + LEAST_STD_M**2

    products = table[len(at) :]
    for m in range(padded):
        other[m] = g[m] * g[m]
        g[m] = math.sqrt(math.sqrt(g[m]))
    signs[0] = _scatter_length(other, products, unknown_std_m)
    signs[1] = _scatter_length(g, products, unknown_std_m)


@compiled
def _scatter_length(weights: Vector, products: Vector, unknown_std_m: float) -> float:
    """Length of the scatter of errors with these weights (P,), as a sign of an error; `products`
    (10, P) are the last rows of their `error_table`.
    """
    scatter = 3.0 * SUPPORT_MASS * unknown_std_m**2
    for i in range(3):
        scatter += sum_products(weights, products[1 + 4 * i])
    return _log_length(scatter / (SUPPORT_MASS + sum_products(weights, products[0])))


@compiled
def error_probability(covariance: Vector, added: float, signs: float, weights: Vector) -> float:
    """Probability, rounded, that the tool belongs farther than UNSURE_M from its prediction with
    the calibrated covariance C (3, 3) [m²]. The variance `added` [m²] is added to tr C.

        p = 1 / (1 + exp(-(w_0 + w_1 log(tr C / UNSURE_M²) + `signs`)))

    `signs` is the sum of the signs of an error by the other `weights` w.
    """
    trace = covariance[0, 0] + covariance[1, 1] + covariance[2, 2] + added
    if trace <= 0.0:
        return 0.0
    logit = weights[0] + weights[1] * log(trace / UNSURE_M**2) + signs
    return rounded(1.0 / (1.0 + exp(-logit)), PROBABILITY_ROUND_TO)


def stretch_of(clock: TaskClock | None, inputs: Vector) -> Vector:
    """Stretch (I,) of inputs (T, I), of which the last one is the clock if that has a weight: it
    counts with at most NEIGHBOUR_CLOCK_MPS.
    """
    out = np.ones(inputs.shape[1])
    if clock is not None and clock.weight > 0.0:
        out[-1] = min(1.0, NEIGHBOUR_CLOCK_MPS / clock.weight)
    return out


@compiled
def _log_length(square: float) -> float:
    """Logarithm of the length in UNSURE_M whose square [m²] is given, and at least LEAST_STD_M."""
    return 0.5 * log(max(square, 0.0) / UNSURE_M**2 + (LEAST_STD_M / UNSURE_M) ** 2)


def averages(squares: Vector, tools: Vector) -> tuple[Vector, Vector]:
    """D / (ν + D) (T, 1) and Y / (ν + D) (T, 3) [m] of reference points with these tools (R, 3) [m]
    at squared distances c² |x - x_n|² (T, R).
    """
    near = np.exp(-squares / (2.0 * NEIGHBOUR_M**2))
    mass = near.sum(axis=1, keepdims=True)
    return mass / (NEIGHBOUR_MASS + mass), near @ tools / (NEIGHBOUR_MASS + mass)


def neighbour_table(inputs: Vector, tools: Vector) -> Vector:
    """Reference points, inputs c x_n (R, I) and tools y_n (R, 3) [m], as a table of
    `kmp.loops.mean` with the weights 1, y_n and |y_n|².
    """
    squares = (tools**2).sum(axis=1, keepdims=True)
    return table_of(inputs, np.hstack([np.ones_like(squares), tools, squares]))


@compiled
def mix(
    moving: Vector,
    table: Vector,
    stretch: Vector,
    share: float,
    unknown_std_m: float,
    motion: Vector,
    signs: Vector,
) -> None:
    """Mix the neighbours with the `share` a into the motion k, k', k'' (3, 3) [m, m/s, m/s²], in
    place, and write the signs of an error of the result to `signs` (6,), unless that is empty; see
    the equations of this module.

    `moving` (3, I) are the inputs with their velocity and acceleration. `table` is the
    `neighbour_table` of the reference points. `stretch` (I,) is c.
    """
    inputs = len(stretch)
    padded = table.shape[1]
    g = np.zeros(padded)
    along = np.zeros(padded)
    bend = np.zeros(padded)
    wide = np.empty(padded)
    middle = np.empty(padded)
    speed = 0.0
    for i in range(inputs):
        x = stretch[i] * moving[0, i]
        v = stretch[i] * moving[1, i]
        w = stretch[i] * moving[2, i]
        speed += v * v
        centres = table[i]
        for n in range(padded):
            offset = x - centres[n]
            g[n] += offset * offset
            along[n] += offset * v
            bend[n] += offset * w
    wide[:] = g
    exponentials(wide, 1.0 / (32.0 * NEIGHBOUR_M**2), middle)
    for n in range(padded):
        square = wide[n] * wide[n]
        middle[n] = square * square
        square = middle[n] * middle[n]
        g[n] = square * square
        slope = -along[n] / NEIGHBOUR_M**2
        bend[n] = g[n] * (slope * slope - (speed + bend[n]) / NEIGHBOUR_M**2)
        along[n] = g[n] * slope

    rows = table[inputs:]
    if share > 0.0:
        mass = NEIGHBOUR_MASS + sum_products(g, rows[0])
        near = mass - NEIGHBOUR_MASS
        near_rate = sum_products(along, rows[0])
        near_bend = sum_products(bend, rows[0])
        b = share / mass
        rate = near_rate / mass
        b_rate = -b * rate
        b_bend = b * (2.0 * rate * rate - near_bend / mass)
        for j in range(3):
            tools = rows[1 + j]
            k, v, w = motion[0, j], motion[1, j], motion[2, j]
            away = sum_products(g, tools) - near * k
            away_rate = sum_products(along, tools) - near_rate * k - near * v
            away_bend = sum_products(bend, tools) - near_bend * k
            away_bend -= 2.0 * near_rate * v + near * w
            motion[0, j] = k + b * away
            motion[1, j] = v + b_rate * away + b * away_rate
            motion[2, j] = w + b_bend * away + 2.0 * b_rate * away_rate + b * away_bend
    if len(signs):
        _write_signs(g, rows, motion[0], unknown_std_m, signs[:2])
        _write_signs(middle, rows, motion[0], unknown_std_m, signs[2:4])
        _write_signs(wide, rows, motion[0], unknown_std_m, signs[4:6])


@compiled
def _write_signs(
    weights: Vector, rows: Vector, tool: Vector, unknown_std_m: float, out: Vector
) -> None:
    """Spread and distance from the `tool` (3,) [m] of neighbours with these weights (P,), written
    to `out` (2,); `rows` (5, P) are the last ones of their `neighbour_table`.
    """
    mass = sum_products(weights, rows[0])
    total = NEIGHBOUR_MASS + mass
    spread = 3.0 * NEIGHBOUR_MASS * unknown_std_m**2 + sum_products(weights, rows[4])
    square = 0.0
    for j in range(3):
        tools = sum_products(weights, rows[1 + j])
        spread -= tools * tools / max(mass, NEIGHBOUR_MASS)
        square += (tools - mass * tool[j]) ** 2
    out[0] = _log_length(spread / total)
    out[1] = _log_length(square / (total * total))
