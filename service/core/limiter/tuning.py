"""Tuned and numerical constants of the limiter."""

from __future__ import annotations

LARGEST_USABLE = 1e6  # a state with a larger number is rejected
STOP_SAMPLES = 16  # the tool's speed is checked at 15 times, which divide the stop into 16 parts
STOP_SPEED_SHARE = 0.99  # the joints stop when the tool's speed in a stop would exceed this share of max_speed
# Joints end their accelerations at different times in a stop, so their motions cancel less of each
# other: the tool gains at most this share of the sum of what they contribute (0.16 seen).
CANCELLED_MOTION_SHARE = 0.3
LEAST_CHANGE_RADPS = 1e-12  # a smaller change of a velocity is rounding
INSIDE_LIMIT_SHARE = 1.0 - 1e-9  # limits are planned with this share, so that rounding does not break them
