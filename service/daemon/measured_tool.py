"""Where the arm's own joints put the tool, for a status."""

from __future__ import annotations

from service.config import Settings
from service.contract.messages import Vector3
from service.core.arm.arm import Arm
from service.core.record import Record

HEARD_S = 0.2  # so old the joints that the arm told may be


class MeasuredTool:
    """The tool by the state behind a frame."""

    def __init__(self, settings: Settings, urdf: str) -> None:
        self._period_s = settings.period_s
        self._arm = Arm(settings, urdf)  # with memory of its own: the loop's works at the same time

    def told(self, state: Record) -> Vector3 | None:
        """Its position [m] in frame `base`; None where the arm told no joints lately."""
        if state["arm_tick"] < 0 or (state["tick"] - state["arm_tick"]) * self._period_s >= HEARD_S:
            return None
        x, y, z = (round(v, 4) for v in self._arm.at(state["measured"].copy()).position.tolist())
        return x, y, z
