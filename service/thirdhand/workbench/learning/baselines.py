"""Baselines: simple predictions of held-out takes that a skill is compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from thirdhand.core.frame import Vector
from thirdhand.workbench.learning.records import Take

Predictor = Callable[[Vector, Vector, Vector], Vector]
# in a skill's figures
LINEAR = "linear"
LOOK_UP = "look-up"
SAME_TIME = "same elapsed time"


def baselines(takes: Sequence[Take]) -> dict[str, list[Vector]]:
    """The errors (T, 3) [m] of each take by baselines from other persons' takes, by name; empty if
    there is one person only.
    """
    if len({take.person for take in takes}) < 2:
        return {}
    return {
        LINEAR: held_out_errors(takes, linear),
        LOOK_UP: held_out_errors(takes, look_up),
        SAME_TIME: [
            take.demonstration.tool[:, :3] - same_time(take, others)
            for take, others in _with_others(takes)
        ],
    }


def constant_errors(takes: Sequence[Take]) -> list[Vector]:
    """The errors (T, 3) [m] of each take by the mean position of the tool in other persons' takes;
    empty if there is one person only.
    """
    if len({take.person for take in takes}) < 2:
        return []
    return held_out_errors(takes, lambda hands, tool, queries: tool.mean(axis=0))


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
    """The errors (T, 3) [m] of each take, predicted from other persons' takes."""
    errors = []
    for take, others in _with_others(takes):
        hands, tool = (
            np.concatenate(parts)
            for parts in zip(*((o.hands, o.position) for o in others), strict=True)
        )
        errors.append(take.position - predict(hands, tool, take.hands))
    return errors


def same_time(take: Take, others: Sequence[Take]) -> Vector:
    """The mean position (T, 3) [m] of the other takes' tool after the same time."""
    seconds = take.demonstration.seconds
    demonstrations = [other_take.demonstration for other_take in others]
    means = [
        np.mean(
            [np.interp(seconds, other.seconds, other.tool[:, axis]) for other in demonstrations],
            axis=0,
        )
        for axis in range(3)
    ]
    return np.stack(means, axis=1)


def _with_others(takes: Sequence[Take]) -> list[tuple[Take, list[Take]]]:
    """Each take, and those of other persons."""
    return [(take, [other for other in takes if other.person != take.person]) for take in takes]
