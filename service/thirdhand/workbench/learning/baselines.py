"""Baselines: simple predictions of held-out takes that a skill is compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from thirdhand.core.frame import Vector
from thirdhand.workbench.learning.records import Take, by_fold

Predictor = Callable[[Vector, Vector, Vector], Vector]
# in a skill's figures
LINEAR = "linear"
LOOK_UP = "look-up"
SAME_TIME = "same elapsed time"


def baselines(takes: Sequence[Take]) -> dict[str, list[Vector]]:
    """The errors (T, 3) [m] of each take by baselines from the takes of other folds, by name; empty
    if there is one person only.
    """
    if len({take.person for take in takes}) < 2:
        return {}
    return {
        LINEAR: held_out_errors(takes, linear),
        LOOK_UP: held_out_errors(takes, look_up),
        SAME_TIME: held_out(takes, same_time),
    }


def constant_errors(takes: Sequence[Take]) -> list[Vector]:
    """The errors (T, 3) [m] of each take by the mean position of the tool in the takes of other
    folds; empty if there is one person only.
    """
    if len({take.person for take in takes}) < 2:
        return []
    return held_out_errors(
        takes, lambda hands, tool, queries: np.tile(tool.mean(axis=0), (len(queries), 1))
    )


def linear(hands: Vector, tool: Vector, queries: Vector) -> Vector:
    """The tool (M, 3) [m] for hands `queries` (M, 6), by the affine function that fits hands (T, 6)
    and tool (T, 3) best.
    """
    fitted, *_ = np.linalg.lstsq(np.column_stack([hands, np.ones(len(hands))]), tool, rcond=None)
    return np.asarray(np.column_stack([queries, np.ones(len(queries))]) @ fitted)


def look_up(hands: Vector, tool: Vector, queries: Vector) -> Vector:
    """The tool (M, 3) [m] at those of the hands (T, 6) that are nearest to `queries` (M, 6)."""
    return np.asarray(tool[cKDTree(hands).query(queries)[1]])


def held_out_errors(takes: Sequence[Take], predict: Predictor) -> list[Vector]:
    """The errors (T, 3) [m] of each take, predicted from the samples of other folds."""

    def predicted(asked: Sequence[Take], others: Sequence[Take]) -> list[Vector]:
        hands = np.concatenate([take.hands for take in others])
        tool = np.concatenate([take.position for take in others])
        ends = np.cumsum([len(take.hands) for take in asked])[:-1]
        return np.split(predict(hands, tool, np.concatenate([take.hands for take in asked])), ends)

    return held_out(takes, predicted)


def held_out(
    takes: Sequence[Take], predicted: Callable[[Sequence[Take], Sequence[Take]], list[Vector]]
) -> list[Vector]:
    """The errors (T, 3) [m] of each take; each fold is `predicted` from the takes of the others."""
    out: dict[int, Vector] = {}
    for _, asked, others in by_fold(takes):
        tools = predicted([takes[i] for i in asked], [takes[i] for i in others])
        out |= {i: takes[i].position - tool for i, tool in zip(asked, tools, strict=True)}
    return [out[i] for i in range(len(takes))]


def same_time(asked: Sequence[Take], others: Sequence[Take]) -> list[Vector]:
    """The mean positions (T, 3) [m] of the other takes' tool after the same time."""
    period_s = min(take.demonstration.period_s for take in others)
    grid = np.arange(0.0, max(take.demonstration.seconds[-1] for take in others), period_s)
    mean = np.zeros((len(grid), 3))
    for take in others:
        mean += _at(grid, take.demonstration.seconds, take.position) / len(others)
    return [_at(take.demonstration.seconds, grid, mean) for take in asked]


def _at(times: Vector, known: Vector, values: Vector) -> Vector:
    """Values (K, D) at the times `known` (K,), interpolated at `times` (T,)."""
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)
