"""Tuned and numerical constants of the setpoint."""

from __future__ import annotations

# The tracker: a linear-quadratic one, whose input is jerk.
TRACKER_RATE_SHARE = 1.1  # largest tracker rate / (jerk / acceleration); joints oscillate with a larger one
TRACKER_LOOP_SHARE = 0.6  # largest tracker rate / loop rate; the tracker acts once a tick, and oscillates from 1 on
STIFFEST_PER_M = 100.0  # [1/m] jerk gain / max_jerk; an error below 1 / 100 m does not saturate the jerk
SLOWEST_PER_S = 0.2  # [1/s] lower limit of the tracker rate; the Riccati equation is not solved reliably below
ACCELERATION_REVERSION_PER_S = 5.0  # [1/s] expected decay of a target's acceleration
VELOCITY_REVERSION_PER_S2 = 150.0  # [1/s²] expected pull of a target's velocity to 0
GAIN_DECIMALS = 6  # the gains are rounded, so that a replay on another kind of CPU agrees

# Stopping where the hands would stop at the soonest.
STOP_OVERSHOOT_M = 0.0012  # the setpoint may stop this far beyond the hand's earliest stop
STOP_REACTION_S = 0.0115  # a hand needs at least this time before it brakes
HAND_BRAKE_MPS2 = 16.0  # [m/s²] largest deceleration of a hand
DECELERATION_LOOKAHEAD_S = 0.11  # predicted speed = v + 0.11 s * min(a, 0)
# A slow tracker shows a stop late: delay = 4 * (response time - 28.5 ms), at most 8 mm of travel.
PROMPT_RESPONSE_S = 0.0285  # response time of the hand filter with a good tracker at 30 Hz
LATE_STOP_SHARE = 4.0
LATE_STOP_MAX_M = 0.008
STOP_JERK_ERROR_M = 0.03  # a planned stop uses at most the tracker's jerk for this error; with more it oscillates

# Meeting a target that moves.
MEETING_OVERSHOOT_M = 0.004  # the setpoint may pass its target by this while it slows to the target's speed
MEETING_BRAKE_SHARE = 0.5  # planned braking = 0.5 * largest braking + min(acceleration of the target, 0)
MEETING_BRAKE_LEAST_SHARE = 0.15  # smallest planned braking / largest braking

# The barriers: the distance left shrinks in a period dt by at most this share of itself:
# min(BARRIER_RATE_PER_S * dt, BARRIER_TIME_S / dt).
BARRIER_RATE_PER_S = 100.0  # [1/s] largest rate at which the distance left shrinks
BARRIER_TIME_S = 0.0035  # limits the share in long periods, where the prediction over one period is less accurate
PLANNED_BRAKE_SHARE = 0.95  # share of acceleration and jerk that is planned with; the rest corrects errors
PLANNED_SPEED_SHARE = 0.97  # share of max_speed that is planned with
LEAST_SPEED_MPS = 1e-3  # below this speed a motion has no direction
STOP_SECANT_TOLERANCE_M = 1e-3  # the search for a jerk ends when the stop leaves less than this distance unused
STOP_SECANTS = 8  # largest number of secant steps; in long periods the stopping distance is not linear in jerk

# A tool that falls behind.
GAP_FREE_M = 0.003  # a tool this far behind its setpoint does not slow it
GAP_SLOW_M = 0.012  # share of the speed = 1 / (1 + (gap - free) / 12 mm)
GAP_WAITING_M = 0.12  # the setpoint begins to wait for its tool at this distance
GAP_STOPPED_M = 0.2  # the setpoint stops at this distance from its tool

# Bounds around the last targets: docs/bounds.md has the proof.
HULL_TIME_S = 0.35  # the setpoint stays near the targets of this last time
HULL_MARGIN_M = 0.03  # the setpoint may be this far outside of the box around those targets
RETURN_SHARE = 1 / 16  # share of max_speed at which a setpoint beyond its bounds returns, on each axis
ON_BOUND_M = 1e-9  # a setpoint this far beyond a bound is on it
BOUND_ROUNDING_M = 1e-12  # a return that falls short by less than this is rounding

# Orientation.
ORIENTATION_GAIN_PER_S = 12.0  # [1/s] decay of a small error
ORIENTATION_BRAKE_SHARE = 0.7  # share of the angular acceleration with which a large turn is planned to end
ORIENTATION_SPEED_SHARE = 0.9  # share of max_turn_speed for the setpoint; the arm needs the rest to catch up
