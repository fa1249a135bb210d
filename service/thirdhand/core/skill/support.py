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

    spread²    (3 ν σ² + Σ_n g_n |y_n - m|²) / (ν + D),   m = Y / D
    distance   D |m - f| / (ν + D)

with the standard deviation σ of the tool where nothing was demonstrated. Each is the logarithm of a
length in UNSURE_M.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kmp import KMP
from kmp.arrays.immutable import Immutable, frozen
from kmp.compiled import compiled
from kmp.elementary import exp, log
from kmp.loops.mean import add_table, table_of
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

WIDTHS = 3  # in which signs are taken


@dataclass(frozen=True, eq=False, repr=False)
class LocalErrors(Immutable):
    """Errors e_m of held-out demonstrations at inputs x_m of a primitive.

    * `inputs` (M, I).
    * `errors` (M, 3) [m].
    * `stretch` (I,): factors c_i of the kernel exp(-Σ_i (c_i (x_i - x_mi))²).
    * `table`: both, as in `error_table`.
    * `rows` (M, I + 3): c_i x_mi and the errors, as in `write_signs`.
    * `unknown_std_m`: standard deviation of the tool on each axis where no demonstration was.
    """

    inputs: Vector
    errors: Vector
    stretch: Vector
    table: Vector
    rows: Vector
    unknown_std_m: float

    def __post_init__(self) -> None:
        for part in (self.inputs, self.errors, self.stretch, self.table, self.rows):
            frozen(part)

    @classmethod
    def of(
        cls, primitive: KMP, inputs: Vector, errors: Vector, unknown_std_m: float
    ) -> LocalErrors:
        """Errors (M, 3) [m] at inputs (M, I) of a primitive. Its kernel is made SUPPORT_SHARPNESS
        times as sharp.
        """
        scale, stretch = primitive.kernel.coordinates(inputs.shape[1])
        factors = math.sqrt(SUPPORT_SHARPNESS * scale) * np.asarray(stretch, np.float64)
        table = error_table(inputs * factors, errors)
        rows = np.hstack([inputs * factors, errors])
        return cls(
            np.array(inputs, order="C"),
            np.array(errors, order="C"),
            factors,
            table,
            rows,
            unknown_std_m,
        )

    def covariances(self, inputs: Vector) -> Vector:
        """Covariances (T, 3, 3) [m²] at inputs (T, I), see `local_scatter`."""
        out = np.empty((len(inputs), 3, 3))
        for row, covariance in zip(np.array(inputs, order="C"), out, strict=True):
            local_scatter(row, self.stretch, self.table, self.unknown_std_m, covariance)
        return out


def error_table(inputs: Vector, errors: Vector) -> Vector:
    """Errors e_m (M, 3) at inputs x_m (M, I) as a table of `kmp.loops.mean`, with the weights 1 and
    the products of e_m e_mᵀ, row by row.
    """
    products = (errors[:, :, None] * errors[:, None, :]).reshape(-1, 9)
    return table_of(inputs, np.hstack([np.ones((len(errors), 1)), products]))


@compiled
def local_scatter(
    at: Vector, stretch: Vector, table: Vector, unknown_std_m: float, out: Vector
) -> None:
    """Covariance C (3, 3) [m²] of the tool at an input x (I,), written to `out`:

        C = (ν σ² I + Σ_m g_m e_m e_mᵀ) / (ν + Σ_m g_m) + LEAST_STD_M² I
        g_m = exp(-Σ_i (c_i (x_i - x_mi))²),   ν = SUPPORT_MASS,   σ = `unknown_std_m`

    So C is the scatter of the errors e_m at similar inputs x_m, and grows to σ² away from all of
    them. It is the posterior mean of a variance whose prior σ² weighs as much as ν errors. `table`
    is the `error_table` of c_i x_mi.
    """
    near = np.zeros(1 + out.size)
    padded = table.shape[1]
    add_table(at * stretch, table, 1.0, np.empty(padded), np.empty(padded), near)
    total = SUPPORT_MASS + near[0]
    for i in range(3):
        for j in range(3):
            out[i, j] = near[1 + 3 * i + j] / total
        out[i, i] += SUPPORT_MASS * unknown_std_m**2 / total + LEAST_STD_M**2


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
    probability = 1.0 / (1.0 + exp(-logit))
    return float(np.rint(probability * PROBABILITY_ROUND_TO) / PROBABILITY_ROUND_TO)


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
    return 0.5 * log(square / UNSURE_M**2 + (LEAST_STD_M / UNSURE_M) ** 2)


@compiled
def mix(moving: Vector, points: Vector, stretch: Vector, share: float, motion: Vector) -> None:
    """Mix the neighbours with the `share` a into the motion k, k', k'' (3, 3) [m, m/s, m/s²], in
    place; see the equations of this module.

    `moving` (3, I) are the inputs with their velocity and acceleration. `points` (R, I + 3) are
    the reference points, in the inputs c x, with their tools. `stretch` (I,) is c.
    """
    inputs = len(stretch)
    sums = np.zeros((3, 4))  # D and Y with their derivatives
    speed = 0.0
    for i in range(inputs):
        speed += (stretch[i] * moving[1, i]) ** 2
    for n in range(len(points)):
        square = first = second = 0.0
        for i in range(inputs):
            offset = stretch[i] * moving[0, i] - points[n, i]
            square += offset * offset
            first += offset * stretch[i] * moving[1, i]
            second += offset * stretch[i] * moving[2, i]
        g = exp(-square / (2.0 * NEIGHBOUR_M**2))
        along = -first / NEIGHBOUR_M**2
        bend = along * along - (speed + second) / NEIGHBOUR_M**2
        for j in range(4):
            part = g
            if j > 0:
                part = g * points[n, inputs + j - 1]
            sums[0, j] += part
            sums[1, j] += part * along
            sums[2, j] += part * bend
    mass = NEIGHBOUR_MASS + sums[0, 0]
    b = share / mass
    rate = sums[1, 0] / mass
    b_rate = -b * rate
    b_bend = b * (2.0 * rate * rate - sums[2, 0] / mass)
    for j in range(3):
        k, v, w = motion[0, j], motion[1, j], motion[2, j]
        away = sums[0, 1 + j] - sums[0, 0] * k
        away_rate = sums[1, 1 + j] - sums[1, 0] * k - sums[0, 0] * v
        away_bend = sums[2, 1 + j] - sums[2, 0] * k - 2.0 * sums[1, 0] * v - sums[0, 0] * w
        motion[0, j] = k + b * away
        motion[1, j] = v + b_rate * away + b * away_rate
        motion[2, j] = w + b_bend * away + 2.0 * b_rate * away_rate + b * away_bend


@compiled
def average(at: Vector, points: Vector, stretch: Vector, out: Vector) -> float:
    """Y / (ν + D) at an input (I,), written to `out` (3,); returns D / (ν + D)."""
    inputs = len(stretch)
    mass = 0.0
    out[:] = 0.0
    for n in range(len(points)):
        square = 0.0
        for i in range(inputs):
            square += (stretch[i] * at[i] - points[n, i]) ** 2
        g = exp(-square / (2.0 * NEIGHBOUR_M**2))
        mass += g
        for j in range(3):
            out[j] += g * points[n, inputs + j]
    out /= NEIGHBOUR_MASS + mass
    return mass / (NEIGHBOUR_MASS + mass)


@compiled
def write_signs(
    at: Vector,
    tool: Vector,
    points: Vector,
    stretch: Vector,
    errors: Vector,
    error_stretch: Vector,
    unknown_std_m: float,
    out: Vector,
) -> None:
    """Signs of an error of the `tool` (3,) [m] that is predicted at an input (I,), written to `out`
    (SIGNS,): spread and distance of each width, then the scatter of the held-out errors with their
    kernel's square and its fourth root.

    `errors` (M, I + 3) are inputs of held-out errors, stretched by `error_stretch`, and the errors.
    """
    inputs = len(stretch)
    weights = np.empty(WIDTHS)
    masses = np.zeros(WIDTHS)
    sums = np.zeros((WIDTHS, 4))  # of y - f and |y - f|²
    for n in range(len(points)):
        square = 0.0
        for i in range(inputs):
            square += (stretch[i] * at[i] - points[n, i]) ** 2
        wide = exp(-square / (32.0 * NEIGHBOUR_M**2))
        middle = wide * wide * wide * wide
        narrow = middle * middle * middle * middle
        far = 0.0
        for j in range(3):
            far += (points[n, inputs + j] - tool[j]) ** 2
        weights[0], weights[1], weights[2] = narrow, middle, wide
        for w in range(WIDTHS):
            masses[w] += weights[w]
            sums[w, 3] += weights[w] * far
            for j in range(3):
                sums[w, j] += weights[w] * (points[n, inputs + j] - tool[j])
    for w in range(WIDTHS):
        total = NEIGHBOUR_MASS + masses[w]
        square = sums[w, 0] ** 2 + sums[w, 1] ** 2 + sums[w, 2] ** 2
        spread = max(sums[w, 3] - square / max(masses[w], NEIGHBOUR_MASS), 0.0)
        out[2 * w] = _log_length((3.0 * NEIGHBOUR_MASS * unknown_std_m**2 + spread) / total)
        out[2 * w + 1] = _log_length(square / (total * total))

    sharp = soft = SUPPORT_MASS
    scatter = wide_scatter = 3.0 * SUPPORT_MASS * unknown_std_m**2
    for m in range(len(errors)):
        square = 0.0
        for i in range(inputs):
            square += (error_stretch[i] * at[i] - errors[m, i]) ** 2
        far = errors[m, inputs] ** 2 + errors[m, inputs + 1] ** 2 + errors[m, inputs + 2] ** 2
        root = math.sqrt(math.sqrt(exp(-square)))
        sharper = (root * root * root * root) ** 2
        sharp += sharper
        scatter += sharper * far
        soft += root
        wide_scatter += root * far
    out[2 * WIDTHS] = _log_length(scatter / sharp)
    out[2 * WIDTHS + 1] = _log_length(wide_scatter / soft)
