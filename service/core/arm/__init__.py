"""Stage 6, arm: where the tool is, and the joint velocities that bring it to the setpoint."""

from __future__ import annotations

from service.contract.records import Field, Layout

STATE: Layout = ()
FRAME = (
    Field("tool", "float64", (3,)),  # where the commanded joints put the tool [m]
    Field("tool_orientation", "float64", (4,)),  # how the commanded joints turn the tool
)
