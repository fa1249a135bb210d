"""Calibration of a model's covariance and of its regions, by takes that the model was not learned
from.

The tool is judged at the same moment, including its lag. With e the errors, C the model's
covariances and v the recent velocities of its predictions, the timing's standard deviation is

    τ = argmin mean(log det C_τ) + 3 log mean(eᵀ C_τ^-1 e),   C_τ = C + τ² v vᵀ

in which each take counts equally. The squared radius of a level p is

    ρ_p = Q_p(d²) min(max(Q_p(d² / Q_p(d² of the other blocks)), 1), 100),   d² = eᵀ C_τ^-1 e

with the quantile Q_p in which each take counts equally, as the samples of a take depend on each
other. The second factor widens a region until it holds on blocks of takes that it was found without
(conformal prediction across folds; Barber et al. 2021). The published covariance is scaled by
ρ_0.95 / χ²_0.95.

The error probability, that the tool is farther than UNSURE_M from its prediction, is that of a
logistic regression on the trace of the published covariance and the signs of an error, whose
weights w are the most probable ones with the normal distribution's weights n as their mean before:

    argmin -Σ log p(wrong or not) + DETECTOR_PENALTY |w - n|² / 2

The skill is unsure where it is above the alarm: the smallest probability, by weights from the other
blocks, that is exceeded at FALSE_ALARM_SHARE of the moments at which the tool is nearer; or a
larger one that is still exceeded at ALARM_SHARE of the other moments.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from kmp import KMP, ViaPointMissed
from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.frame import Vector
from thirdhand.core.skill import SIGNS
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.model import (
    LEVELS,
    NORMAL,
    NORMAL_WEIGHTS,
    REGION_95,
    Regions,
)
from thirdhand.core.skill.step import recent
from thirdhand.core.skill.support import LocalErrors
from thirdhand.process.parallel import Workers
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError
from thirdhand.skills.via_points import check_agreement
from thirdhand.workbench.learning.choice import LEAST_BLOCKS, rows_at, sampled
from thirdhand.workbench.learning.records import HeldOut, Take, TimedErrors, persons_of

# largest number of blocks of successive takes, often of one person or hour, that are held out
REGION_BLOCKS = 6
JUDGED_SAMPLES = 150  # samples of a take that are judged, at most
# Candidates for the timing's standard deviation. A larger one explains few large errors by making
# all motion uncertain.
TIMINGS_S = (0.0, 0.02, 0.04, 0.07, 0.1, 0.14)
WIDEST = 100.0  # a region's squared radius is widened at most by this factor
LEAST_SQUARE = 1e-12  # squared Mahalanobis distances below this one count as this one
LEAST_RADIUS = 1e-9  # a squared radius is at least this large
# shares of the right and of the wrong moments at which the skill is unsure
FALSE_ALARM_SHARE = 0.14
ALARM_SHARE = 0.95
LEAST_WRONG = 10  # fewer wrong moments do not show which share of them an alarm detects
# range of the alarm: a smaller probability is no alarm, and a larger one always is
ALARMS = (0.005, 0.5)
# Penalty on the squared deviation of the detector's weights. On recorded partners, a tenth lowers
# the area under the ROC curve by up to 0.06, ten times by up to 0.01.
DETECTOR_PENALTY = 10.0
WEIGHT_DECIMALS = 6
# errors that a model of the hands' inputs keeps, which bound the duration of a tick
LOCAL_ERRORS_RETAINED = 300


def blocks_of(persons: NDArray[np.intp], most: int = REGION_BLOCKS) -> list[list[int]]:
    """The numbers of the takes that are held out at once, by the takes' persons (H,), in at most
    `most` blocks, or BLOCKS.
    """
    numbers = np.unique(persons)
    blocks = np.array_split(numbers, max(1, min(REGION_BLOCKS, most, len(numbers))))
    return [np.flatnonzero(np.isin(persons, block)).tolist() for block in blocks if len(block)]


def timed_errors(one: HeldOut) -> TimedErrors:
    """The errors of a held-out take at the same moment."""
    rows = _judged_rows(len(one.errors))
    signs = np.zeros((len(rows), SIGNS))
    return _timed(one.take, one.take.position - one.errors, one.covariance[rows], signs)


def calibrated(errors: Sequence[TimedErrors], persons: NDArray[np.intp]) -> Regions:
    """The regions that the errors of takes by these persons (H,) lead to; those of a normal
    distribution if there are fewer than LEAST_BLOCKS blocks.
    """
    blocks = blocks_of(persons)
    if len(blocks) < LEAST_BLOCKS:
        return NORMAL
    std_s = min(TIMINGS_S, key=lambda candidate_s: _cost(errors, candidate_s))
    squares = [take_errors.squares(std_s) for take_errors in errors]
    radii = np.maximum.accumulate([_radius(squares, blocks, level) for level in LEVELS])
    scale = float(radii[LEVELS.index(0.95)]) / REGION_95
    regions = Regions(scale, std_s, tuple((radii / scale).tolist()))
    probabilities: dict[int, Vector] = {}
    for block in blocks:
        without = regions._replace(
            weights=_weights([part for i, part in enumerate(errors) if i not in block], regions)
        )
        probabilities |= {i: errors[i].probabilities(without) for i in block}
    alarm = _alarm(errors, [probabilities[i] for i in range(len(errors))])
    return regions._replace(weights=_weights(errors, regions), alarm=alarm)


def _weights(errors: Sequence[TimedErrors], regions: Regions) -> tuple[float, ...]:
    """The weights of a detector that learns which of these samples are wrong."""
    signs = np.concatenate([take_errors.features(regions) for take_errors in errors])
    wrong = np.concatenate([take_errors.is_wrong for take_errors in errors])
    normal = np.array(NORMAL_WEIGHTS)

    def cost(weights: Vector) -> tuple[float, Vector]:
        logits = signs @ weights
        away = weights - normal
        unlikely = (np.logaddexp(0.0, logits) - wrong * logits).sum()
        slope = signs.T @ (expit(logits) - wrong) + DETECTOR_PENALTY * away
        return float(unlikely + 0.5 * DETECTOR_PENALTY * away @ away), slope

    best = minimize(cost, normal, jac=True, method="L-BFGS-B").x
    return tuple(np.round(best, WEIGHT_DECIMALS).tolist())


def _alarm(errors: Sequence[TimedErrors], probabilities: Sequence[Vector]) -> float:
    """The error probability above which a skill with these errors is unsure; `probabilities` (S,)
    of each take are those of a detector that was learned without its block.
    """
    wrong = [take_errors.is_wrong for take_errors in errors]
    right = [
        values[~is_wrong]
        for values, is_wrong in zip(probabilities, wrong, strict=True)
        if not is_wrong.all()
    ]
    alarm = _quantile(right, 1.0 - FALSE_ALARM_SHARE) if right else ALARMS[0]
    among = np.concatenate(probabilities)[np.concatenate(wrong)]
    if len(among) >= LEAST_WRONG:
        alarm = max(alarm, float(np.quantile(among, 1.0 - ALARM_SHARE)))
    return min(max(alarm, ALARMS[0]), ALARMS[1])


def local_errors(
    takes: Sequence[Take],
    inputs: Sequence[Vector],
    primitive: KMP,
    refitted: Callable[[list[int]], HandsKMP],
    spread: Workers,
) -> tuple[list[TimedErrors], LocalErrors]:
    """The errors at the same moment of takes with inputs (T, I), by models that are `refitted` to
    all blocks of takes but their own, with covariances and signs by the errors of the other blocks;
    and those errors that a model with this primitive keeps.

    Hyper-parameters are chosen without the held-out block, too. A model passes through the
    via-points of the demonstration, as it will in use.
    """
    blocks = blocks_of(persons_of(takes))
    unknown_std_m = unknown_std(takes)
    others = [[i for i in range(len(takes)) if i not in block] for block in blocks]
    models = list(spread(refitted, others))
    tools: dict[int, Vector] = {}
    for block, model in zip(blocks, models, strict=True):
        for i in block:
            through = _through_via_points(model, takes[i].demonstration)
            tools[i] = through.tools(inputs[i])
    errors = [take.position - tools[i] for i, take in enumerate(takes)]
    shares = sampled(LOCAL_ERRORS_RETAINED, len(takes), 0, 1, LOCAL_ERRORS_RETAINED)

    def retained(kmp: KMP, numbers: Sequence[int]) -> LocalErrors:
        rows = [rows_at(shares[i], len(inputs[i])) for i in numbers]
        kept_inputs, kept_errors = (
            np.concatenate([values[i][kept] for i, kept in zip(numbers, rows, strict=True)])
            for values in (inputs, errors)
        )
        return LocalErrors.of(kmp, kept_inputs, kept_errors, unknown_std_m)

    out: dict[int, TimedErrors] = {}
    for block, numbers, model in zip(blocks, others, models, strict=True):
        of_others = replace(model, errors=retained(model.primitive, numbers))
        for i in block:
            rows = _judged_rows(len(tools[i]))
            uncertainty = of_others.uncertainty(inputs[i][rows], tools[i][rows])
            out[i] = _timed(takes[i], tools[i], *uncertainty)
    return [out[i] for i in range(len(takes))], retained(primitive, range(len(takes)))


def unknown_std(takes: Sequence[Take]) -> float:
    """The standard deviation [m] of the tool's positions on each axis, root mean square."""
    return float(np.sqrt(np.concatenate([take.position for take in takes]).var(axis=0).mean()))


def calibrated_without(
    errors: Sequence[TimedErrors], persons: NDArray[np.intp]
) -> list[tuple[TimedErrors, Regions]]:
    """The errors of each take, and the regions that the other blocks lead to."""
    out: dict[int, tuple[TimedErrors, Regions]] = {}
    for block in blocks_of(persons):
        numbers = [i for i in range(len(errors)) if i not in block]
        regions = calibrated([errors[i] for i in numbers], persons[numbers])
        out |= {i: (errors[i], regions) for i in block}
    return [out[i] for i in range(len(errors))]


def _judged_rows(count: int) -> NDArray[np.intp]:
    """The rows that are judged, of some `count`, even in time."""
    return rows_at(np.linspace(0.0, 1.0, min(JUDGED_SAMPLES, count)), count)


def _timed(take: Take, mean: Vector, covariance: Vector, signs: Vector) -> TimedErrors:
    """The errors of a mean (T, 3) [m], with covariances (S, 3, 3) [m²] and signs (S, SIGNS) at the
    judged samples.
    """
    rows = _judged_rows(len(mean))
    trail = mean[0].copy()
    velocity = np.empty_like(mean)
    begins = take.demonstration.begins if len(mean) == len(take.demonstration.tool) else ()
    for i, position in enumerate(mean):
        if i in begins:
            trail[:] = position
        velocity[i] = recent(position, take.demonstration.period_s, trail)
    return TimedErrors((take.position - mean)[rows], covariance, velocity[rows], signs)


def _through_via_points(model: HandsKMP, demonstration: Demonstration) -> HandsKMP:
    """The model adapted to the demonstration's via-points, unless they contradict each other."""
    if not demonstration.via_points:
        return model
    try:
        check_agreement(demonstration.via_points)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)  # the errors contain it
            weight = 1.0 / len(model.primitive.base.inputs)
            return model.through(demonstration.via_points, tolerance=TOLERANCE_M, weight=weight)
    except (SkillError, ValueError):
        return model


def _cost(errors: Sequence[TimedErrors], std_s: float) -> float:
    """The negative log likelihood of the errors at the best scale, but for constants."""
    terms = [
        (
            np.linalg.slogdet(take_errors.with_timing(std_s))[1].mean(),
            take_errors.squares(std_s).mean(),
        )
        for take_errors in errors
    ]
    size, square = np.mean(terms, axis=0)
    return float(size + 3.0 * np.log(max(square, LEAST_SQUARE)))


def _radius(squares: Sequence[Vector], blocks: Sequence[Sequence[int]], level: float) -> float:
    """The squared radius of a level's region for squared distances (T,) of each take."""
    relative: list[Vector] = [np.empty(0)] * len(squares)
    for block in blocks:
        others = _quantile([values for i, values in enumerate(squares) if i not in block], level)
        for i in block:
            relative[i] = squares[i] / max(others, LEAST_SQUARE)
    widened = min(max(_quantile(relative, level), 1.0), WIDEST)
    return max(_quantile(squares, level) * widened, LEAST_RADIUS)


def _quantile(groups: Sequence[Vector], level: float) -> float:
    """The quantile of values (T,) in groups that count equally."""
    values = np.concatenate(groups)
    order = np.argsort(values)
    share = np.cumsum(
        np.concatenate([np.full(len(group), 1.0 / len(group)) for group in groups])[order]
    )
    return float(np.interp(level, share / share[-1], values[order]))
