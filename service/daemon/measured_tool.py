"""The tool's position by the arm's measured joints, for the status."""

from __future__ import annotations

from service.config import Settings
from service.contract.messages import Vector3
from service.core.arm.arm import Arm
from service.core.frame import Record

OLDEST_S = 0.2  # of the measured joints


class MeasuredTool:
    """Forward kinematics of the joints measured last."""

    def __init__(self, settings: Settings, urdf: str) -> None:
        self._period_s = settings.period_s
        self._arm = Arm(settings, urdf)  # not the loop's, which works at the same time

    def position(self, state: Record) -> Vector3 | None:
        """The tool's position [m] in frame `base`; None where no joints were measured lately."""
        if state["arm_tick"] < 0 or (state["tick"] - state["arm_tick"]) * self._period_s >= OLDEST_S:
            return None
        x, y, z = (round(v, 4) for v in self._arm.at(state["measured"].copy()).position.tolist())
        return x, y, z
