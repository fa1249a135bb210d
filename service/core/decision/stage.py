"""The mode of a tick and the reason for it: whether the arm is ready and does what it is told,
whether hands are known and where the skill is sure.
"""

from __future__ import annotations

import numpy as np

from service.config import Settings
from service.contract.records import Reason
from service.core.codes import BLOCKED, FAULT, HOLD, NOT_READY, RETURNING
from service.core.decision.leave import WayOut
from service.core.decision.step import step
from service.core.decision.tuning import RETURN_RADPS
from service.core.frame import Event, Record, Records, Vector, as_array, parameters


class Decision:
    """Mode and reason, in the state. `measured`: how far the arm is off its command [rad], and the
    tool's speed [m/s], measured; at a fault what it was found by.
    """

    def __init__(self, settings: Settings) -> None:
        limits = settings.joints
        self._lower, self._upper = np.array(limits.lower, np.float64), np.array(limits.upper, np.float64)
        self._parameters = parameters(
            lower=self._lower,
            upper=self._upper,
            period_s=settings.period_s,
            is_assumed=int(settings.arm.source == "assumed"),
            max_error_rad=float(settings.arm.fault_error_rad),
            fault_speed=float(settings.tool.fault_speed),
            max_speed=float(settings.tool.max_speed),
            per_rad=np.array(limits.per_rad),
        )
        self._return_speed = RETURN_RADPS * np.array(limits.per_rad)
        self._way_out = WayOut(settings)
        self.measured = (0.0, 0.0)

    def step(self, state: Record, frame: Record, here: Records, known: int, *, gate_m: float, threshold: float) -> int:
        """Mode and reason of this tick, with the arm's kinematics `here` (1,); 0, STARTS_ASSUMED or
        STARTS_MEASURED.

        known: flags of `codes.Known`. gate_m: what the skill compares with its threshold, NaN where
        it predicts nothing.
        """
        gates = gate_m, threshold
        starts, error, speed = step(as_array(state), as_array(frame), here, self._parameters, known, *gates)
        frame["mode"], frame["reason"] = state["mode"], state["reason"]
        if error >= 0.0:
            self.measured = error, speed
        return int(starts)

    def own_motion(self, state: Record, tasks: Vector) -> Vector | None:
        """Velocities (J,) [rad/s] of an arm in a hold on its way into its limits, or on a way out
        of where it is stuck; None of any other. The arm's tasks are as in `Kinematics`.
        """
        if state["arm_ready"] == RETURNING and state["reason"] == NOT_READY and not state["operator_hold"]:
            q = state["joints"][0]
            inward: Vector = (q < self._lower).astype(np.float64) - (q > self._upper)
            return self._return_speed * inward
        return self._way_out.velocity(state, tasks) if state["reason"] == BLOCKED else None

    def take(self, state: Record, event: Event) -> None:
        """A hold, resume, reset or fault that somebody asks for, or a way out that was found.
        Raises ValueError for others.
        """
        match event.kind:
            case "hold" | "resume":
                state["operator_hold"] = event.kind == "hold"
                if event.kind == "resume":
                    state["stuck"] = state["way_count"] = 0
            case "reset":
                state["leaves"] = not state["arm_ready"]
                if state["mode"] == FAULT:
                    state["mode"], state["arm_ready"] = HOLD, 0
            case "way":
                if state["mode"] != FAULT:
                    self._way_out.take(state, event)
            case "fault":
                if state["mode"] != FAULT:
                    state["mode"], state["reason"] = FAULT, Reason.SERVICE
            case _:
                raise ValueError(f"tick {state['tick']}: nothing is done with an event of kind {event.kind!r}")

    def fail(self, state: Record, frame: Record, reason: Reason, *, speed: float | None = None) -> None:
        """At fault from this tick on, for a `speed` [m/s] of the tool where that is why."""
        state["mode"], state["reason"] = frame["mode"], frame["reason"] = FAULT, reason
        if speed is not None:
            self.measured = self.measured[0], speed
