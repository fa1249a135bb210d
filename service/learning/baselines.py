"""What a skill is set beside: predictions that need no learning, of demonstrations left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.core.frame import Vector
from service.learning.demonstration import Demonstration

Predictor = Callable[[Vector, Vector, Vector], Vector]


def linear(hands: Vector, tool: Vector, asked: Vector) -> Vector:
    """The tool (M, 3) [m] for hands `asked` (M, 6): the linear function that fits hands (T, 6) and
    tool (T, 3) best.
    """
    fitted, *_ = np.linalg.lstsq(np.column_stack([hands, np.ones(len(hands))]), tool, rcond=None)
    return np.asarray(np.column_stack([asked, np.ones(len(asked))]) @ fitted)


def look_up(hands: Vector, tool: Vector, asked: Vector) -> Vector:
    """The tool (M, 3) [m] where hands (T, 6) are nearest to those `asked` (M, 6)."""
    return np.asarray(tool[cKDTree(hands).query(asked)[1]])


def left_out(paths: Sequence[tuple[Vector, Vector]], together: NDArray[np.intp], predict: Predictor) -> list[Vector]:
    """Errors (T, 3) [m] of each demonstration, hands (T, 6) and tool (T, 3) [m], predicted from
    those that are not left out `together` (H,) with it; none where there are no others.
    """
    if len(set(together.tolist())) < 2:
        return []
    errors = []
    for (hands, tool), group in zip(paths, together, strict=True):
        others = [path for path, other in zip(paths, together, strict=True) if other != group]
        known, shown = (np.concatenate(parts) for parts in zip(*others, strict=True))
        errors.append(tool - predict(known, shown, hands))
    return errors


def same_time(demonstrations: Sequence[Demonstration], together: NDArray[np.intp]) -> list[Vector]:
    """As `left_out`, where the tool is said to be in the mean of the others after as much time."""
    if len(set(together.tolist())) < 2:
        return []
    errors = []
    for one, group in zip(demonstrations, together, strict=True):
        others = [other for other, its in zip(demonstrations, together, strict=True) if its != group]
        means = [
            np.mean([np.interp(one.seconds, other.seconds, other.tool[:, axis]) for other in others], axis=0)
            for axis in range(3)
        ]
        errors.append(one.tool[:, :3] - np.stack(means, axis=1))
    return errors
