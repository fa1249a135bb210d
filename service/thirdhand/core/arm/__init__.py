"""Stage 6, arm: the pose of the tool, and the joint velocities that move it to the setpoint."""

from __future__ import annotations

from thirdhand.contract.records import Layout

STATE: Layout = ()
FRAME: Layout = ()
