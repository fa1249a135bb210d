"""Stage 3, decision: the mode of this tick and the reason for it."""

from __future__ import annotations

from service.contract.records import Field

STATE = (
    Field("slow_tick", "int64"),  # the last one at which the tool was not too fast
    Field("mode", "uint8"),
    Field("reason", "uint8"),
    Field("operator_hold", "uint8"),
    Field("arm_ready", "uint8"),  # 1: yes; 2: on its way into its limits
)
FRAME = (
    Field("mode", "uint8"),
    Field("reason", "uint8"),
)
