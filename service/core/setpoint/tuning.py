"""Tuned numbers of the setpoint.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

from service.core.arm.tuning import PLANNED_LIMIT_SHARES, POSITION_GAIN_PER_S, TURN_GAIN_SHARE
from service.core.decision.tuning import PROGRESS_SHARE, STUCK_GAP_M
from service.core.intake.tuning import LEAST_NOISE_M

# The tracker: a linear-quadratic one, whose input is jerk.
# 1e-9 to 1e-7. More: the setpoint follows calmly. Less: it follows faster, as far as joints can.
JERK_WEIGHT = 2.8e-9  # [s⁶] weight of a squared jerk beside that of a squared distance
# 0.5 to 2. More: the setpoint follows faster. Less: the joints follow calmly.
TRACKER_RATE_SHARE = 1.1  # largest tracker rate / (jerk / acceleration); joints oscillate with a larger one

# Stopping where the hands would stop at the soonest.
# 2 to 20. More: more lag, less overshoot. Less: less lag, more overshoot and jerk.
HAND_BRAKE_MPS2 = 5.0  # [m/s²] largest mean deceleration of a hand, from when it begins to brake
STOP_OVERSHOOT_M = 2.0 * LEAST_NOISE_M  # the setpoint may stop this far beyond that: targets at rest differ by noise
# 0.03 to 0.3. More: ends of reaches are braked early. Less: stops are passed.
DECELERATION_LOOKAHEAD_S = 0.12  # predicted speed = speed + this * min(acceleration, 0)

# Smallest planned braking / largest braking, to meet a target that brakes too: the share of the
# jerk that planning leaves.
MEETING_BRAKE_LEAST_SHARE = float(1.0 - PLANNED_LIMIT_SHARES[2])

# The barriers: the distance left shrinks in a period dt by at most this share of itself:
# min(BARRIER_RATE_PER_S * dt, BARRIER_TIME_S / dt).
BARRIER_RATE_PER_S = POSITION_GAIN_PER_S  # [1/s] rate at which the tool closes in on its setpoint
# It limits the share in long periods, where the prediction over one period is less accurate.
BARRIER_TIME_S = 1.0 / (6.0 * BARRIER_RATE_PER_S)
# Of the tool's limits, and again of the joints', which `joint_costs` has reduced already:
PLANNED_BRAKE_SHARE = float(PLANNED_LIMIT_SHARES[1])  # planned share of acceleration and jerk; the rest corrects errors
PLANNED_SPEED_SHARE = float(PLANNED_LIMIT_SHARES[0])  # planned share of max_speed

# A tool that falls behind.
# 3e-3 to 0.05. More: a late tool is waited for less. Less: lags slow the setpoint.
GAP_SLOW_M = 0.012  # share of the speed = 1 / (1 + (gap - GAP_FREE_M) / GAP_SLOW_M)
GAP_FREE_M = GAP_SLOW_M / 4.0  # a tool this far behind its setpoint does not slow it
GAP_WAITING_M = GAP_FREE_M + 8.0 * GAP_SLOW_M  # from here on its target is moved closer: a ninth of its speed is left
GAP_STOPPED_M = 2.0 * GAP_WAITING_M  # the setpoint stops at this distance from its tool

ENGAGED_GAP_M = STUCK_GAP_M  # a setpoint nearer to its target than this has engaged

# Bounds around the last targets: docs/bounds.md has the proof.
# 0.1 to 2. More: old targets stay in bounds. Less: the bounds follow closely.
HULL_TIME_S = 0.35  # the setpoint stays near the targets of this last time
# 5e-3 to 0.1. More: more overshoot is possible. Less: the bounds brake the setpoint.
HULL_MARGIN_M = 0.03  # the setpoint may be this far outside of the box around those targets
STIFFEST_PER_M = 3.0 / HULL_MARGIN_M  # [1/m] jerk gain / max_jerk of a tool with little jerk
STOP_JERK_ERROR_M = HULL_MARGIN_M  # a planned stop uses at most the tracker's jerk for this error, or it oscillates
# Share of max_speed at which a setpoint beyond its bounds returns, on each axis: the progress that
# is expected of a tool, from up to 0.75 STUCK_S of max_speed away.
RETURN_SHARE = 0.75 * PROGRESS_SHARE

# Orientation.
ORIENTATION_GAIN_PER_S = TURN_GAIN_SHARE * POSITION_GAIN_PER_S  # [1/s] decay of a small error, as of quick joints
