"""Via-points as data of a primitive, and as pulls on the tool of another model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.numerics import LEAST_PULL_VARIANCE_SHARE, PULL_DECIMALS
from thirdhand.core.skill.tuning import LEAST_PATH_M, PULL_SHARPNESS_PER_M2

NEIGHBOURS = 12  # of a via-point with a radius: two along each coordinate of both hands


def neighbourhoods(via_points: Sequence[ViaPoint]) -> tuple[Vector, Vector, Vector]:
    """Inputs (V, 6) [m], outputs (V, 3) [m] and standard deviations (V,) [m] of via-points.

    A via-point with a radius has NEIGHBOURS more rows: each coordinate of its hands moved by the
    radius both ways, and the tool by as much if it follows that hand.
    """
    inputs: list[Vector] = []
    outputs: list[Vector] = []
    deviations: list[float] = []
    follow = {"none": np.zeros((3, 6)), "left": np.eye(3, 6), "right": np.eye(3, 6, 3)}
    centre = np.zeros((1, 6))
    around = np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
    for point in via_points:
        steps = point.radius * around if point.radius else centre
        inputs.extend(np.array([*point.left, *point.right]) + steps)
        outputs.extend(np.array(point.tool) + steps @ follow[point.follow].T)
        deviations.extend([point.std] * len(steps))
    return np.array(inputs).reshape(-1, 6), np.array(outputs).reshape(-1, 3), np.array(deviations)


def rest_of(point: ViaPoint, names: Sequence[str]) -> str:
    """Name of the via-point of the task at which hands at this `point` rest: its own name, or that
    of the end of the segment in which it acts. `names` are those of the task, in its order.
    """
    return names[names.index(point.segment) + 1] if point.segment in names[:-1] else point.name


def sharpness_between(ends: Vector, via_points: Sequence[ViaPoint]) -> float:
    """Sharpness k [1/m²] of pulls that leave the tool as it is at the `ends` (E, 6) [m] of their
    segment:

        k = max(PULL_SHARPNESS_PER_M2, ln(2) / d²)

    d [m] is the smallest distance of a via-point's hands from an end, so a kernel's half width is
    at most d. The kernel that cancels it at the end makes it overshoot on the other side, by 5 % at
    this width; it would by 44 % at twice this width.
    """
    hands = neighbourhoods(via_points)[0]
    nearest_m = float(np.linalg.norm(hands[:, None] - ends, axis=2).min())
    return max(PULL_SHARPNESS_PER_M2, math.log(2.0) / max(nearest_m, LEAST_PATH_M) ** 2)


def pulls_through(
    mean: Callable[[Vector], Vector],
    unchanged: Vector,
    via_points: Sequence[ViaPoint],
    sharpness: float,
) -> tuple[Vector, Vector]:
    """Kernels that make the mean f of a model, (T, 6) to (T, 3) [m], pass through via-points, and
    leave it as it is at the hands `unchanged` (K, 6).

    Returns centres c (X, 6) [m] and weights W (X, 3) [m] of

        f(h) + Σ_x exp(-k |h - c_x|²) W_x,   k = `sharpness`
        W = (G + diag(σ²) + LEAST_PULL_VARIANCE_SHARE I)⁻¹ E,   G_xy = exp(-k |c_x - c_y|²)

    The centres are the via-points' hands with E = tool - f(c) and the via-points' variance σ² [m²],
    and `unchanged` with E = 0 and σ = 0. Without via-points, there are no kernels.
    """
    inputs, outputs, deviations = neighbourhoods(via_points)
    if not len(inputs):
        return inputs, outputs.reshape(0, 3)
    centres = np.concatenate([inputs, unchanged])
    errors = np.concatenate([outputs - mean(inputs), np.zeros((len(unchanged), 3))])
    square = ((centres[:, None] - centres) ** 2).sum(axis=2)
    noise = np.concatenate([deviations**2, np.zeros(len(unchanged))]) + LEAST_PULL_VARIANCE_SHARE
    weights = np.linalg.solve(np.exp(-sharpness * square) + np.diag(noise), errors)
    return centres, np.asarray(np.round(weights, PULL_DECIMALS), np.float64)
