"""The place where a task between via-points begins, moved to where the hands rest before it."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Record, Vector
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.task_clock import NOT_BEGUN, PROGRESS

# Hands up to 8 cm beside the start begin a task as well as those at it; at 12 cm, one of 16 does.
BESIDE_M = 0.07
FARTHEST_M = 0.25  # hands farther away are not at the start
RESTING_S = 0.5


class StartPlace:
    """Whether the hands rest beside the start of a skill's task. If so, the task begins there; it
    does where it was once they rest there again.
    """

    def __init__(self, period_s: float) -> None:
        self._rest_ticks = round(RESTING_S / period_s)
        self._since = -1  # the first tick of the rest; -1: the hands move
        self._usual = np.full((2, 3), np.inf)  # the hands' positions [m] before they were replaced

    def moved(self, skill: Skill, state: Record) -> list[ViaPoint]:
        """The via-points by which the task begins where the hands rest in the state; empty if it
        does.
        """
        model = skill.model
        sides = [0, 1] if skill.conductor is None else [skill.conductor] * 2
        tick = int(state["tick"])
        is_still = state["hand_stillness"][sides].min() > 0.5
        self._since = (tick if self._since < 0 else self._since) if is_still else -1
        if not (
            isinstance(model, SegmentedKMP) and is_still and tick - self._since >= self._rest_ticks
        ):
            return []
        hands = np.array(state["hands"][sides, 0])
        segments = model.placed.segments
        begins = segments["begins"]
        ends = segments["begins"] + segments["way"]
        away_m = _away_m(hands, begins[0])
        if _away_m(hands, self._usual) < BESIDE_M < away_m:
            return _at_start(skill, self._usual)
        others_m = min(_away_m(hands, end) for end in (*begins[1:], ends[-1]))
        if state["task_clock"][PROGRESS] != NOT_BEGUN or not BESIDE_M < away_m < min(
            FARTHEST_M, others_m
        ):
            return []
        self._usual = begins[0].copy()
        return _at_start(skill, hands)


def _away_m(hands: Vector, place: Vector) -> float:
    """The distance [m] of the hands (2, 3) from their places (2, 3), the larger one."""
    return float(np.linalg.norm(hands - place, axis=1).max())


def _at_start(skill: Skill, hands: Vector) -> list[ViaPoint]:
    """The via-points of the skill's task at which a hand is where it begins, with that hand at its
    position in `hands` (2, 3) [m].
    """
    model = skill.model
    assert isinstance(model, SegmentedKMP)
    in_force = {point.name: point for point in skill.via_points}
    out = []
    for name, corners, nominal in zip(
        model.task.names, model.task.corners, model.nominal.at.reshape(-1, 3, 3), strict=True
    ):
        left, right, tool = map(_point, nominal)
        point = in_force.get(name) or ViaPoint(name, left, right, tool)
        for side, key in enumerate(("left", "right")):
            if corners[side] == model.task.corners[0, side]:
                point = msgspec.structs.replace(point, **{key: _point(hands[side])})
        if (corners == model.task.corners[0]).any():
            out.append(point)
    return out


def _point(position: Sequence[float] | Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in position)
    return x, y, z
