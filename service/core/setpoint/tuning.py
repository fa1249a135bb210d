"""Tuned numbers of the setpoint.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

from service.core.arm.tuning import PLANNED_LIMIT_SHARES, POSITION_GAIN_PER_S, TURN_GAIN_SHARE
from service.core.decision.tuning import STUCK_GAP_M
from service.core.intake.tuning import LEAST_NOISE_M, MODE_INTENSITIES_M2PS5

# The tracker: a linear-quadratic one, whose input is jerk.
# 0.5 to 2. More: the setpoint follows faster. Less: the joints follow calmly.
TRACKER_RATE_SHARE = 1.1  # largest tracker rate / (jerk / acceleration); joints oscillate with a larger one

# Stopping where the hands would stop at the soonest.
# 0 to 5e-3. More: less lag, more overshoot. Less: more lag, less overshoot.
STOP_OVERSHOOT_M = 0.0012  # the setpoint may stop this far beyond the hand's earliest stop
# 3 to 50. More: more lag, less overshoot. Less: less lag, more overshoot.
HAND_BRAKE_MPS2 = 7.0  # [m/s²] largest mean deceleration of a hand, from when it begins to brake
# 0.03 to 0.3. More: ends of reaches are braked early. Less: stops are passed.
DECELERATION_LOOKAHEAD_S = 0.11  # predicted speed = speed + this * min(acceleration, 0)
# A slow tracker shows a stop late: by LATE_STOP_SHARE * (response time - PROMPT_RESPONSE_S).
PROMPT_RESPONSE_S = float((LEAST_NOISE_M**2 / 30.0 / MODE_INTENSITIES_M2PS5[2]) ** (1 / 6))  # good tracker, 30 Hz
# 0 to 10. More: slow trackers overshoot less. Less: slow trackers lag less.
LATE_STOP_SHARE = 4.0  # delay of a stop / excess of the response time
# 0 to 0.02. More: slow trackers overshoot less. Less: slow trackers lag less.
LATE_STOP_MAX_M = 0.008  # largest travel that is allowed for such a delay

# Smallest planned braking / largest braking, to meet a target that brakes too: the share of the
# jerk that planning leaves.
MEETING_BRAKE_LEAST_SHARE = float(1.0 - PLANNED_LIMIT_SHARES[2])

# The barriers: the distance left shrinks in a period dt by at most this share of itself:
# min(BARRIER_RATE_PER_S * dt, BARRIER_TIME_S / dt).
# 20 to 400. More: braking begins late and hard. Less: braking begins early.
BARRIER_RATE_PER_S = 100.0  # [1/s] largest rate at which the distance left shrinks
# It limits the share in long periods, where the prediction over one period is less accurate.
BARRIER_TIME_S = 1.0 / (3.0 * BARRIER_RATE_PER_S)
# Of the tool's limits, and again of the joints', which `joint_costs` has reduced already:
PLANNED_BRAKE_SHARE = float(PLANNED_LIMIT_SHARES[1])  # planned share of acceleration and jerk; the rest corrects errors
PLANNED_SPEED_SHARE = float(PLANNED_LIMIT_SHARES[0])  # planned share of max_speed

# A tool that falls behind.
# 3e-3 to 0.05. More: a late tool is waited for less. Less: lags slow the setpoint.
GAP_SLOW_M = 0.012  # share of the speed = 1 / (1 + (gap - GAP_FREE_M) / GAP_SLOW_M)
GAP_FREE_M = GAP_SLOW_M / 4.0  # a tool this far behind its setpoint does not slow it
# 0.05 to 1. More: the setpoint runs ahead. Less: the setpoint waits sooner.
GAP_STOPPED_M = 0.2  # the setpoint stops at this distance from its tool
GAP_WAITING_M = 0.5 * GAP_STOPPED_M  # from here on its target is moved closer: a tenth of its speed is left

ENGAGED_GAP_M = STUCK_GAP_M  # a setpoint nearer to its target than this has engaged

# Bounds around the last targets: docs/bounds.md has the proof.
# 0.1 to 2. More: old targets stay in bounds. Less: the bounds follow closely.
HULL_TIME_S = 0.35  # the setpoint stays near the targets of this last time
# 5e-3 to 0.1. More: more overshoot is possible. Less: the bounds brake the setpoint.
HULL_MARGIN_M = 0.03  # the setpoint may be this far outside of the box around those targets
STIFFEST_PER_M = 3.0 / HULL_MARGIN_M  # [1/m] jerk gain / max_jerk of a tool with little jerk
STOP_JERK_ERROR_M = HULL_MARGIN_M  # a planned stop uses at most the tracker's jerk for this error, or it oscillates
# 0.01 to 0.3. More: returns are fast. Less: returns take long.
RETURN_SHARE = 1 / 16  # share of max_speed at which a setpoint beyond its bounds returns, on each axis

# Orientation.
ORIENTATION_GAIN_PER_S = TURN_GAIN_SHARE * POSITION_GAIN_PER_S  # [1/s] decay of a small error, as of quick joints
