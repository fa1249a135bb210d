"""Judgement of a skill before it is used: its figures, from held-out takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp.criteria.errors import rms
from thirdhand.core.frame import Vector
from thirdhand.core.skill.model import LEVELS, Regions
from thirdhand.core.skill.skill import is_reachable
from thirdhand.settings.config import Reach
from thirdhand.workbench.learning.ambiguity import COMPARED, Contradictions, contradictions, lengths
from thirdhand.workbench.learning.baselines import baselines, constant_errors
from thirdhand.workbench.learning.records import (
    Figures,
    Fitted,
    HeldOut,
    Pose,
    Row,
    Spread,
    TimedErrors,
    Verdict,
    persons_of,
)
from thirdhand.workbench.learning.regions import (
    calibrated,
    calibrated_without,
    timed_errors,
    unknown_std,
)
from thirdhand.workbench.learning.takes import Division, conductor_of
from thirdhand.workbench.learning.verdicts import Subject, conclusion, verdicts

CONTRADICTION_M = 0.10  # tools this far from each other contradict each other at the same hands


class Judgement(NamedTuple):
    """The figures of a skill, the regions of its covariance, and the shares (L,) of the samples
    inside the regions of LEVELS, each take's calibrated without it.
    """

    figures: Figures
    regions: Regions
    inside: Vector


def judged(
    division: Division, fitted: Fitted, pose: Pose, reach: Reach, *, accepted_by: str = ""
) -> Judgement:
    """The judgement of a model and pose that were learned from takes; `accepted_by` is the person
    who accepts its residual risks.

    With the errors e of held-out takes and d those of the mean position of the other persons' tool,
    the explained share of the variance is 1 - Σ |e|² / Σ |d|².
    """
    takes = division.takes
    held_out = fitted.held_out
    persons = persons_of(takes)
    timed = [result.timed or timed_errors(result) for result in held_out]
    checked = calibrated_without(timed, persons)
    rows, overall = _rows(held_out, fitted, checked, {**fitted.baselines, **baselines(takes)})
    contradicting = _contradictions(held_out, division)
    figures = Figures(
        demonstrations=rows,
        all=overall,
        held_std=float(np.std([row.held for row in rows])),
        gate_mm=1000 * fitted.gate.threshold,
        swapped=100 * fitted.gate.caught.swapped,
        beside=100 * fitted.gate.caught.beside,
        one_beside=100 * fitted.gate.caught.one_beside,
        ambiguous=100 * contradicting.share,
        beyond_reach=100 * _share_beyond(held_out, reach),
        explained=_explained(held_out, constant_errors(takes)),
        orientation_error_deg=pose.turn_error_deg,
        gripper_right=pose.gripper_right,
        by_person=len(np.unique(persons)) < len(takes),
        spread=_spread(checked, persons),
        alone=True if conductor_of(division, fitted) is not None else msgspec.UNSET,
        **_of_choice(fitted),
    )
    subject = Subject(
        figures,
        fitted.gate,
        sorted({take.demonstration.frame for take in takes}),
        f"{contradicting.pair} have the hands {1000 * contradicting.hands_m:.0f} mm from each "
        f"other and the tools {1000 * contradicting.tools:.0f} mm",
        float(np.median([row.error_mm for row in rows])),
        1000 * math.sqrt(3.0) * unknown_std(takes),
    )
    remarks = (*division.remarks, *fitted.remarks)
    figures = _with_verdicts(figures, [*verdicts(subject), *pose.verdicts], remarks, accepted_by)
    figures = msgspec.structs.replace(
        figures, conclusion=conclusion(subject._replace(figures=figures))
    )
    inside = np.mean([errors.inside(regions) for errors, regions in checked], axis=0)
    return Judgement(figures, calibrated(timed, persons), inside)


def _contradictions(held_out: Sequence[HeldOut], division: Division) -> Contradictions:
    """The samples with the same hands and the tool elsewhere."""
    return contradictions(
        held_out,
        [take.position for take in division.takes],
        [np.linalg.norm(result.errors, axis=1) for result in held_out],
        lengths,
        different=CONTRADICTION_M,
        near_m=division.near_m,
    )


def _rows(
    held_out: Sequence[HeldOut],
    fitted: Fitted,
    checked: Sequence[tuple[TimedErrors, Regions]],
    baselines_m: Mapping[str, Sequence[Vector]],
) -> tuple[tuple[Row, ...], Row]:
    """The figures of each held-out take and of all, with the errors (T, 3) [m] of each baseline."""
    limit_m = fitted.gate.threshold
    rows = tuple(
        _row(
            result.take.name,
            result.errors,
            result.gate_m > limit_m,
            checked[i : i + 1],
            {name: errors[i] for name, errors in baselines_m.items()},
        )
        for i, result in enumerate(held_out)
    )
    overall = _row(
        "all",
        np.concatenate([result.errors for result in held_out]),
        np.concatenate([result.gate_m for result in held_out]) > limit_m,
        checked,
        {name: np.concatenate(errors) for name, errors in baselines_m.items()},
    )
    return rows, overall


def _of_choice(fitted: Fitted) -> dict[str, Any]:
    """The figures of what was chosen: inputs, weight and delay, with the errors of candidates."""
    figures: dict[str, Any] = {}
    if fitted.tried_m:
        figures["tried_mm"] = _mm(fitted.tried_m)
        figures["taken"] = fitted.taken
    if fitted.weights:
        figures["weights_mm"] = _mm(fitted.weights.tried_m)
        figures["weight"] = fitted.weights.taken
    if fitted.delay:
        figures["delay_s"] = fitted.delay.mean_s
        figures["delay_std_s"] = fitted.delay.std_s
    return figures


def _mm(errors_m: Mapping[str, float]) -> dict[str, float]:
    return {name: 1000 * error_m for name, error_m in errors_m.items()}


def _with_verdicts(
    figures: Figures, findings: Sequence[Verdict], remarks: Sequence[str], accepted_by: str
) -> Figures:
    """The figures with verdicts by their severity; remarks are warnings, too."""
    warnings, residual, unsafe = (
        tuple(finding.text for finding in findings if finding.severity == severity)
        for severity in ("warning", "residual", "unsafe")
    )
    return msgspec.structs.replace(
        figures,
        warnings=(*remarks, *warnings),
        residual=residual,
        accepted_by=accepted_by if residual else "",
        unsafe=unsafe,
    )


def _spread(
    checked: Sequence[tuple[TimedErrors, Regions]], persons: NDArray[np.intp]
) -> Spread | None:
    """The spread of the error over these persons (H,)."""
    own = [
        [checked[i] for i in np.flatnonzero(persons == person).tolist()]
        for person in np.unique(persons)
    ]
    if len(own) < 2:
        return None
    errors_mm = list(map(_moment_mm, own))
    expected_mm = list(map(_expected_mm, own))
    return Spread(
        len(own),
        min(errors_mm),
        max(errors_mm),
        float(np.std(errors_mm, ddof=1)),
        int(np.sum(np.array(errors_mm) <= expected_mm)),
    )


def _moment_mm(checked: Sequence[tuple[TimedErrors, Regions]]) -> float:
    """The error [mm] at the same moment."""
    return 1000 * rms(np.concatenate([timed.errors for timed, _ in checked]))


def _expected_mm(checked: Sequence[tuple[TimedErrors, Regions]]) -> float:
    """That error [mm] as the calibrated covariance predicts it."""
    expected_m = [timed.expected_m(regions) for timed, regions in checked]
    return 1000 * rms(np.concatenate(expected_m)[:, None])


def _share_beyond(held_out: Sequence[HeldOut], reach: Reach) -> float:
    """The share of the tool's positions that are out of the arm's reach."""
    paths = (result.take.position[:: max(1, len(result.errors) // COMPARED)] for result in held_out)
    return float(
        np.mean(
            [not is_reachable(position, reach) for positions in paths for position in positions]
        )
    )


def _explained(held_out: Sequence[HeldOut], constant: Sequence[Vector]) -> float | None:
    """The share [%] of the tool's variance that is explained, given the errors (T, 3) [m] of a
    constant prediction of each take; None if there are none.
    """
    if not constant:
        return None
    missed, varies = (
        float(sum((errors**2).sum() for errors in take_errors))
        for take_errors in ([result.errors for result in held_out], constant)
    )
    return 100 * (1 - missed / varies) if varies > 0.0 else None


def _row(
    name: str,
    errors: Vector,
    is_held: NDArray[np.bool_],
    checked: Sequence[tuple[TimedErrors, Regions]],
    others: Mapping[str, Vector],
) -> Row:
    """The figures of errors (T, 3) [m], of one take or of all."""
    inside = 100 * np.mean([timed.inside(regions) for timed, regions in checked], axis=0)
    is_wrong = np.concatenate([timed.is_wrong for timed, _ in checked])
    is_unsure = np.concatenate(
        [timed.probabilities(regions) > (regions.alarm or 1.0) for timed, regions in checked]
    )
    return Row(
        name=name,
        error_mm=1000 * rms(errors),
        worst_mm=1000 * float(np.linalg.norm(errors, axis=1).max()),
        moment_mm=_moment_mm(checked),
        predicted_mm=_expected_mm(checked),
        within_50=float(inside[LEVELS.index(0.5)]),
        within_95=float(inside[LEVELS.index(0.95)]),
        held=100 * float(is_held.mean()),
        wrong=100 * float(is_wrong.mean()),
        told=100 * float(is_unsure[is_wrong].mean()) if is_wrong.any() else None,
        falsely_told=100 * float(is_unsure[~is_wrong].mean()) if not is_wrong.all() else 0.0,
        other_mm={name: 1000 * rms(missed) for name, missed in others.items()},
    )
