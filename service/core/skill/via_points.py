"""What via-points are made of; and how a tool that is told where to be goes through others too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from service.contract.requests import ViaPoint
from service.core.frame import Vector
from service.core.skill.tuning import LEAST_PULL_VARIANCE_SHARE, PULL_SHARPNESS_PER_M2

NEIGHBOURS = 12  # of a via-point with a radius: one either way along each of both hands' coordinates


def neighbourhoods(via_points: Sequence[ViaPoint]) -> tuple[Vector, Vector, Vector]:
    """Inputs (V, 6), outputs (V, 3) and standard deviations (V,) of via-points: each alone, or with
    its neighbours.
    """
    inputs: list[Vector] = []
    outputs: list[Vector] = []
    deviations: list[float] = []
    follow = {"none": np.zeros((3, 6)), "left": np.eye(3, 6), "right": np.eye(3, 6, 3)}
    here, around = np.zeros((1, 6)), np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
    for point in via_points:
        steps = point.radius * around if point.radius else here
        inputs.extend(np.array([*point.left, *point.right]) + steps)
        outputs.extend(np.array(point.tool) + steps @ follow[point.follow].T)
        deviations.extend([point.std] * len(steps))
    return np.array(inputs).reshape(-1, 6), np.array(outputs).reshape(-1, 3), np.array(deviations)


def bent(mean: Callable[[Vector], Vector], kept: Vector, via_points: Sequence[ViaPoint]) -> tuple[Vector, Vector]:
    """Centres (X, 6) [m] and weights (X, 3) [m] of kernels of PULL_SHARPNESS_PER_M2, by which a
    mean of hands at rest, (T, 6) to (T, 3) [m], passes through via-points, and stays at `kept`
    hands (K, 6).
    """
    inputs, outputs, deviations = neighbourhoods(via_points)
    if not len(inputs):
        return inputs, outputs.reshape(0, 3)
    centres = np.concatenate([inputs, kept])
    off = np.concatenate([outputs - mean(inputs), np.zeros((len(kept), 3))])
    square = ((centres[:, None] - centres) ** 2).sum(axis=2)
    noise = np.concatenate([deviations**2, np.zeros(len(kept))]) + LEAST_PULL_VARIANCE_SHARE
    return centres, np.linalg.solve(np.exp(-PULL_SHARPNESS_PER_M2 * square) + np.diag(noise), off)
