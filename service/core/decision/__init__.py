"""Stage 3, decision: the mode of this tick and the reason for it."""

from __future__ import annotations

from service.contract.records import PER_JOINT, Field

WAY = 24  # postures of a way out, at most
STATE = (
    Field("slow_tick", "int64"),  # the last one at which the tool was not too fast
    Field("stuck_tick", "int64"),  # the last one at which the tool was there, or came nearer
    Field("way_next", "int64"),  # the posture of the way out that is gone to
    Field("way_count", "int64"),  # postures of the way out; 0: there is none
    Field("stuck_gap", "float64"),  # how far from the target it was then [m]
    Field("stuck_target", "float64", (3,)),  # the target then [m]
    Field("way", "float64", (WAY, PER_JOINT)),  # postures that lead to where the target is reached [rad]
    Field("mode", "uint8"),
    Field("reason", "uint8"),
    Field("operator_hold", "uint8"),
    Field("arm_ready", "uint8"),  # 1: yes; 2: on its way into its limits, or out of a thing
    Field("stuck", "uint8"),  # 1: the tool comes no nearer to its target; 2: it holds for that
    Field("leaves", "uint8"),  # somebody confirmed that the arm is to leave the thing that it stands in
)
FRAME = (
    Field("mode", "uint8"),
    Field("reason", "uint8"),
)
