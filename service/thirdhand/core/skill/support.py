"""Errors of held-out demonstrations, and how far a prediction is supported by them.

The covariance of a prediction is the scatter of held-out errors at similar inputs. Far from all
demonstrations, it is the scatter of the tool over all of them.
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
from thirdhand.core.skill.model import LEVELS
from thirdhand.core.skill.tuning import LEAST_STD_M, SUPPORT_MASS, SUPPORT_SHARPNESS, UNSURE_M

# -log of the share of errors beyond each level
SURVIVAL = np.round(-np.log1p(-np.array(LEVELS)), 12)


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
        scale, stretch = primitive.kernel.coordinates(inputs.shape[1])
        factors = math.sqrt(SUPPORT_SHARPNESS * scale) * np.asarray(stretch, np.float64)
        table = error_table(inputs * factors, errors)
        return cls(
            np.array(inputs, order="C"), np.array(errors, order="C"), factors, table, unknown_std_m
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
def error_probability(covariance: Vector, added: float, ratios: Vector) -> float:
    """Probability, rounded, that the tool belongs farther than UNSURE_M from its prediction with
    the calibrated covariance C (3, 3) [m²]. The variance `added` [m²] is added to tr C.

    `ratios` (L,) are the quantiles of |e|² / tr C at LEVELS. With u = UNSURE_M² / tr C, -log of the
    probability is interpolated linearly in log u between them, and beyond the last ones with their
    slope. Below the first one, the share of smaller errors is proportional to u.
    """
    trace = covariance[0, 0] + covariance[1, 1] + covariance[2, 2] + added
    if trace <= 0.0:
        return 0.0
    ratio = UNSURE_M**2 / trace
    if ratio <= ratios[0]:
        probability = 1.0 - LEVELS[0] * ratio / ratios[0]
    else:
        k = 1
        while k < len(ratios) - 1 and ratio > ratios[k]:
            k += 1
        width = max(log(ratios[k] / ratios[k - 1]), 1e-3)
        along = log(ratio / ratios[k - 1]) / width
        probability = exp(-(SURVIVAL[k - 1] + along * (SURVIVAL[k] - SURVIVAL[k - 1])))
    return float(np.rint(probability * PROBABILITY_ROUND_TO) / PROBABILITY_ROUND_TO)


@compiled
def error_probabilities(covariances: Vector, ratios: Vector, out: Vector) -> None:
    """Error probabilities of calibrated covariances (T, 3, 3) [m²], written to `out` (T,)."""
    for t in range(len(covariances)):
        out[t] = error_probability(covariances[t], 0.0, ratios)
