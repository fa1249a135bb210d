"""Mode of a tick and the reason for it, from the state of the arm, the visibility of the hands and
the skill's confidence.
"""

from __future__ import annotations

import numpy as np

from thirdhand.contract.records import Reason
from thirdhand.core.codes import (
    AMBIGUOUS,
    BLOCKED,
    FAR,
    FAULT,
    HOLD,
    NOT_READY,
    RETURNING,
    STALE_HAND,
    STALE_WISH,
)
from thirdhand.core.decision.leave import WayOut, speeds_of_ways
from thirdhand.core.decision.step import step
from thirdhand.core.frame import Event, Record, Records, Vector, as_array, parameters
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings

BRIEF = (STALE_HAND, STALE_WISH, FAR, AMBIGUOUS)


class Decision:
    """Mode and reason of each tick, kept in the state.

    `measured`: the largest difference between measured and commanded joints [rad], and the measured
    speed of the tool [m/s]; during a fault, the values that caused it.
    """

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        limits = settings.joints
        self._lower = np.array(limits.lower, np.float64)
        self._upper = np.array(limits.upper, np.float64)
        self._parameters = parameters(
            lower=self._lower,
            upper=self._upper,
            period_s=settings.period_s,
            is_assumed=int(settings.arm.source == "assumed"),
            max_error_rad=float(settings.arm.fault_error_rad),
            fault_speed=float(settings.tool.fault_speed),
            max_speed=float(settings.tool.max_speed),
            engaging_speed=float(settings.tool.engaging_speed),
            per_rad=np.array(limits.per_rad),
            # The time that a joint needs for 100 times the distance at which a way may begin.
            way_timeout_s=100.0 * tuning.intake.joint_jump_rad / speeds_of_ways(settings)[1],
            end_share=tuning.intake.end_share,
            # a hand that comes to rest after a jump does so within this time
            jumpy_s=tuning.intake.hand_still_s,
            too_fast_s=0.6 * tuning.intake.confirmed_s,  # one late command is shorter
            **tuning.decision._asdict(),
            freed_share=3.0 * tuning.decision.progress_share,  # more than chance
            another_target_m=4.0 * tuning.decision.stuck_gap_m,
        )
        self._brief_ticks = round(tuning.intake.tracker_memory_s / settings.period_s)
        # A joint outside its limits is back within 2 s.
        self._return_speed = 0.5 * tuning.intake.max_outside_rad * np.array(limits.per_rad)
        self._way_out = WayOut(settings, tuning=tuning)
        self.measured = (0.0, 0.0)

    def step(
        self,
        state: Record,
        frame: Record,
        here: Records,
        conditions: int,
        *,
        gate_m: float,
        threshold: float,
    ) -> int:
        """Determine mode and reason of this tick from the arm's kinematics `here` (1,) and the
        `conditions`, flags of `codes.Condition`. Returns 0, or STARTS_ASSUMED or STARTS_MEASURED if
        the arm starts.

        `gate_m` [m] is compared with the skill's `threshold` [m]; it is NaN if the skill predicts
        nothing.
        """
        starts, error, speed = step(
            as_array(state), as_array(frame), here, self._parameters, conditions, gate_m, threshold
        )
        if error >= 0.0:
            self.measured = error, speed
        return int(starts)

    def own_motion(self, state: Record, tasks: Vector) -> Vector | None:
        """Joint velocities (J,) [rad/s] of a holding arm that moves back into its limits or along a
        way out; None for any other. `tasks` is that of `Kinematics`.
        """
        if (
            state["arm_ready"] == RETURNING
            and state["reason"] == NOT_READY
            and not state["operator_hold"]
        ):
            q = state["joints"][0]
            inward: Vector = (q < self._lower).astype(np.float64) - (q > self._upper)
            return self._return_speed * inward
        return self._way_out.velocity(state, tasks) if state["reason"] == BLOCKED else None

    def is_brief(self, state: Record) -> bool:
        """True in the first tracker_memory_s of a hold that hands or wishes have caused. The arm
        then resumes its motion without engaging anew.
        """
        held = int(state["tick"] - state["followed_tick"])
        return int(state["reason"]) in BRIEF and held <= self._brief_ticks

    def take(self, state: Record, event: Event) -> None:
        """Apply an event of the kind hold, resume, reset, fault or way (a way out). Raises
        ValueError for other kinds.
        """
        match event.kind:
            case "hold" | "resume":
                state["operator_hold"] = event.kind == "hold"
                if event.kind == "resume":
                    state["stuck"] = state["way_count"] = 0
            case "reset":
                state["leaves"] = not state["arm_ready"]
                if state["mode"] == FAULT:
                    state["mode"] = HOLD
                    state["arm_ready"] = 0
            case "way":
                if state["mode"] != FAULT:
                    self._way_out.take(state, event)
            case "fault":
                if state["mode"] != FAULT:
                    state["mode"] = FAULT
                    state["reason"] = Reason.SERVICE
            case _:
                raise ValueError(
                    f"tick {state['tick']}: nothing is done with an event of kind {event.kind!r}"
                )

    def fail(
        self, state: Record, frame: Record, reason: Reason, *, speed: float | None = None
    ) -> None:
        """Set the mode to fault from this tick on. `speed` [m/s] is that of the tool, for a fault
        that it caused.
        """
        state["mode"], state["reason"] = frame["mode"], frame["reason"] = FAULT, reason
        if speed is not None:
            self.measured = self.measured[0], speed
