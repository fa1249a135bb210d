"""Tuned numbers of the limiter.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

from service.core.arm.tuning import TOOL_SPEED_SHARE

# The joints stop when the tool's speed in a stop would exceed this share of max_speed.
STOP_SPEED_SHARE = 0.5 * (1.0 + TOOL_SPEED_SHARE)  # midway between that of motion to the setpoint and 1
