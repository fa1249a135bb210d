"""Stage 6, arm: where the tool is, and the joint velocities that bring it to the setpoint."""

from __future__ import annotations

from service.contract.records import Layout

STATE: Layout = ()
FRAME: Layout = ()
