"""What a skill is set beside: predictions that need no learning, of demonstrations left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from service.core.frame import Vector

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


def left_out(paths: Sequence[tuple[Vector, Vector]], predict: Predictor) -> list[Vector]:
    """Errors (T, 3) [m] of each demonstration, hands (T, 6) and tool (T, 3) [m], predicted from the
    others; none of a single one.
    """
    if len(paths) < 2:
        return []
    errors = []
    for h, (hands, tool) in enumerate(paths):
        others = [path for i, path in enumerate(paths) if i != h]
        known, shown = (np.concatenate(parts) for parts in zip(*others, strict=True))
        errors.append(tool - predict(known, shown, hands))
    return errors
