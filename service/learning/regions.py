"""Regions that hold what they say: how a model's covariance is scaled, and how far its regions
reach, by demonstrations that had no part in what predicts them.

Judged is the tool at that moment, its lag left in. Samples of a demonstration tell little more than
one, and takes of one person are alike: so a quantile counts each demonstration as much as another,
and is widened until it holds in blocks of demonstrations what it was found without (a conformal
prediction across folds; Barber et al. 2021).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp import ViaPointMissed
from service.contract.requests import TOLERANCE_M
from service.core.frame import Vector
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.model import LEVELS, NORMAL, REGION_95, Regions, standard_deviations
from service.core.skill.step import recent
from service.learning.choice import mahalanobis
from service.learning.demonstration import Demonstration, at_the_moment
from service.learning.judgement import HeldOut
from service.learning.skill_file import SkillError
from service.learning.via_points import check_agreement

LEAST = 2  # blocks of demonstrations, of which fewer tell nothing of regions
FOLDS = 6  # at most, of demonstrations that follow each other: those are of one person or hour
SAMPLES = 150  # of a demonstration, at most: more tell no more
STDS_S = (0.0, 0.02, 0.04, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)  # of the time: most teachers react in less
WIDEST = 100.0  # times that a region may be widened


class Apart(NamedTuple):
    """What is predicted of a demonstration by a model that it had no part in, at some samples (T):
    errors (T, 3) [m], covariances (T, 3, 3) [m²] and recent velocities (T, 3) [m/s].
    """

    errors: Vector
    covariance: Vector
    velocity: Vector

    def squares(self, std_s: float) -> Vector:
        """Squared Mahalanobis distances (T,), with such a deviation of the time."""
        return mahalanobis(self.errors, self._with_time(std_s))

    def deviations(self, regions: Regions) -> Vector:
        """How far off the tool is said to be, root mean square (T,) [m]."""
        return np.asarray(np.sqrt(3 * regions.scale) * standard_deviations(self._with_time(regions.std_s)))

    def inside(self, regions: Regions) -> Vector:
        """The shares of the samples in the regions of LEVELS."""
        squares = self.squares(regions.std_s)[:, None] / regions.scale
        return np.asarray((squares <= regions.radii).mean(axis=0))

    def likelihood(self, std_s: float) -> tuple[float, float]:
        """Mean logarithm of the determinant of the covariances, and mean square of the errors."""
        covariance = self._with_time(std_s)
        return float(np.linalg.slogdet(covariance)[1].mean()), float(mahalanobis(self.errors, covariance).mean())

    def _with_time(self, std_s: float) -> Vector:
        return np.asarray(self.covariance + std_s**2 * self.velocity[:, :, None] * self.velocity[:, None, :])


def folds(together: NDArray[np.intp]) -> list[list[int]]:
    """Blocks of demonstrations that are left out at once: of those that are left out `together`
    (H,), and of some that follow each other.
    """
    groups = np.unique(together)
    blocks = np.array_split(groups, max(1, min(FOLDS, len(groups))))
    return [np.flatnonzero(np.isin(together, block)).tolist() for block in blocks if len(block)]


def of_held_out(
    demonstrations: Sequence[Demonstration], paths: Sequence[tuple[Vector, Vector]], held_out: Sequence[HeldOut]
) -> list[Apart]:
    """Of what was predicted of demonstrations; inputs (T, I) and tool (T, 3) are as learned."""
    out = []
    for demonstration, (_, tool), one in zip(demonstrations, paths, held_out, strict=True):
        rows = _some(len(tool))
        out.append(_apart(demonstration, tool - one.errors, one.covariance[rows]))
    return out


def of_models(
    demonstrations: Sequence[Demonstration],
    paths: Sequence[tuple[Vector, Vector]],
    together: NDArray[np.intp],
    made: Callable[[list[int]], HandsKMP],
) -> list[Apart]:
    """Of demonstrations left out in blocks, by the model that is made of the others: what is chosen
    to predict some of them best would say nothing of new ones.

    A model goes through the places that a demonstration names, as it will where it is used.
    """
    out: dict[int, Apart] = {}
    for block in folds(together):
        model = made([i for i in range(len(paths)) if i not in block])
        for i in block:
            (inputs, _), there = paths[i], _taught(model, demonstrations[i])
            covariance = there.primitive.predict(inputs[_some(len(inputs))]).covariance
            out[i] = _apart(demonstrations[i], there.primitive.mean(inputs), covariance)
    return [out[i] for i in range(len(paths))]


def calibrated(apart: Sequence[Apart], together: NDArray[np.intp]) -> Regions:
    """The regions of which what was left out tells; as of a normal, of fewer than LEAST blocks."""
    blocks = folds(together)
    if len(blocks) < LEAST:
        return NORMAL
    std_s = min(STDS_S, key=lambda std_s: _unlikeliness(apart, std_s))
    squares = [one.squares(std_s) for one in apart]
    radii = np.maximum.accumulate([_radius(squares, blocks, level) for level in LEVELS])
    scale = float(radii[LEVELS.index(0.95)]) / REGION_95
    return Regions(scale, std_s, tuple((radii / scale).tolist()))


def of_the_others(apart: Sequence[Apart], together: NDArray[np.intp]) -> list[tuple[Apart, Regions]]:
    """Each demonstration, and the regions of which those in other blocks tell."""
    out: dict[int, tuple[Apart, Regions]] = {}
    for block in folds(together):
        kept = [i for i in range(len(apart)) if i not in block]
        regions = calibrated([apart[i] for i in kept], together[kept])
        out |= {i: (apart[i], regions) for i in block}
    return [out[i] for i in range(len(apart))]


def _some(count: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, min(SAMPLES, count)).round().astype(np.intp)


def _apart(demonstration: Demonstration, mean: Vector, covariance: Vector) -> Apart:
    """Of a mean (T, 3) [m], and of covariances (S, 3, 3) [m²] at some of its samples."""
    rows, trail, velocity = _some(len(mean)), mean[0].copy(), np.empty_like(mean)
    begins = demonstration.begins if len(mean) == len(demonstration.tool) else ()
    for i, position in enumerate(mean):
        if i in begins:
            trail[:] = position
        velocity[i] = recent(position, demonstration.period_s, trail)
    tool = at_the_moment(demonstration, len(mean))
    return Apart((tool - mean)[rows], covariance, velocity[rows])


def _taught(model: HandsKMP, demonstration: Demonstration) -> HandsKMP:
    """The model through the places of a demonstration, if these agree."""
    if not demonstration.places:
        return model
    try:
        check_agreement(demonstration.places)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)  # what is missed is in the errors
            weight = 1.0 / len(model.primitive.base.inputs)
            return model.through(demonstration.places, tolerance=TOLERANCE_M, weight=weight)
    except (SkillError, ValueError):
        return model


def _unlikeliness(apart: Sequence[Apart], std_s: float) -> float:
    """Of errors under a normal with such a deviation of the time, at whatever scale; each
    demonstration counts as much as another.
    """
    size, square = np.mean([one.likelihood(std_s) for one in apart], axis=0)
    return float(size + 3.0 * np.log(max(square, 1e-12)))


def _radius(squares: Sequence[Vector], blocks: Sequence[Sequence[int]], level: float) -> float:
    """The quantile of squared distances, widened by as much as those in a block are wider than what
    is found without it.
    """
    relative: list[Vector] = [np.empty(0)] * len(squares)
    for block in blocks:
        others = _quantile([one for i, one in enumerate(squares) if i not in block], level)
        for i in block:
            relative[i] = squares[i] / max(others, 1e-12)
    widened = min(max(_quantile(relative, level), 1.0), WIDEST)
    return max(_quantile(squares, level) * widened, 1e-9)


def _quantile(values: Sequence[Vector], level: float) -> float:
    """Below which that share of values (T,) lies, each group counting as much as another."""
    all_of, order = np.concatenate(values), np.argsort(np.concatenate(values))
    share = np.cumsum(np.concatenate([np.full(len(one), 1.0 / len(one)) for one in values])[order])
    return float(np.interp(level, share / share[-1], all_of[order]))
