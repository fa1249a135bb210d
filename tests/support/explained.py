"""The bound of docs/bounds.md that the targets' last motion explains the setpoint, asserted in
every step.
"""

from __future__ import annotations

import numpy as np
import pytest

from thirdhand.core.controller import Controller
from thirdhand.core.frame import Record, Vector
from thirdhand.core.setpoint import HULL_SPANS
from thirdhand.core.setpoint.bounds import farthest, speed_to_come
from thirdhand.core.setpoint.stage import SetpointGenerator
from thirdhand.core.skill.model import Target
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings, ToolSettings

HULL_MARGIN_M = TUNING.setpoint.hull_margin_m
HULL_TIME_S = TUNING.setpoint.hull_time_s
RETURN_SHARE = 0.75 * TUNING.decision.progress_share


def margin(tool: ToolSettings) -> float:
    """Distance [m] by which a setpoint may exceed the positions that the targets explain."""
    back = RETURN_SHARE * tool.max_speed
    stop_s = (tool.max_speed + back) / tool.stop_acceleration
    stop_s += (tool.acceleration + tool.stop_acceleration) / tool.stop_jerk
    return HULL_MARGIN_M + back * stop_s


class Explained(SetpointGenerator):
    """A setpoint generator that asserts its bound.

    On each side of each axis the setpoint stays below the greatest of the last targets plus
    `margin`. Earlier targets count too, less the distance that the setpoint could return since
    then.
    """

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        super().__init__(settings, tuning=tuning)
        self._tool = settings.tool
        self._period = settings.period_s
        self._margin = margin(settings.tool)
        self._last = np.empty(
            (HULL_SPANS * max(1, round(HULL_TIME_S / (HULL_SPANS - 1) / settings.period_s)), 2, 3)
        )
        self._steps = -1
        self.closest = np.inf  # [m] smallest distance of a setpoint from its bound

    def begin(self, state: Record, setpoint: Vector, *, engages: bool = True) -> None:
        super().begin(state, setpoint, engages=engages)
        self._steps = -1

    def step(self, state: Record, target: Target, box: Vector, costs: Vector, slow: float) -> int:
        before = state["setpoint"].copy()
        tool = self._tool
        max_speed = float(self.limits(state)["max_speed"][0])
        if self._steps < 0:
            ends = [
                [
                    farthest(before, i, side, tool.stop_acceleration, tool.stop_jerk, 0.0)
                    for i in range(3)
                ]
                for side in (1.0, -1.0)
            ]
            self._most = np.array(ends)
            self._steps = 0
            self._last[:] = [before[0], -before[0]]
        result = super().step(state, target, box, costs, slow)
        self._last[self._steps % len(self._last)] = [target.position, -target.position]
        self._steps += 1
        back = RETURN_SHARE * max_speed
        too_fast = speed_to_come(before[1], before[2], tool.stop_jerk, back) > max_speed
        share = 0.0 if too_fast else slow / max(1.0, max_speed * np.abs(costs[0]).max())
        self._most = np.maximum(self._last.max(axis=0), self._most - back * share * self._period)
        left = self._most + self._margin - [state["setpoint"][0], -state["setpoint"][0]]
        assert left.min() >= -1e-6, (left, result)
        self.closest = min(self.closest, left.min())
        return result


def explained_controller(settings: Settings, skill: Skill, *, urdf: str) -> Controller:
    """A controller whose setpoint generator asserts its bound."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("thirdhand.core.setpoint.stage.SetpointGenerator", Explained)
        return Controller(settings, skill, urdf=urdf)
