"""Tolerances, roundings, caps, steps and iteration counts of the core's arithmetic. They follow
from 64-bit floating point and from the algorithms, or are so fine that half and twice of them
change nothing that is measured: none is tuned.
"""

from __future__ import annotations

ROUNDING = 1e-12  # smaller velocities, distances, pivots and multipliers are rounding
TOLERANCE = 1e-9  # a bound that is exceeded by less than this is kept
# limits are planned with this share, so that rounding does not break them
INSIDE_LIMIT_SHARE = 1.0 - TOLERANCE
LEAST_SLOPE = 1e-10  # a constraint with a smaller slope in the free directions cannot be approached
TICK_ROUNDING = 1e-6  # [ticks] rounding of a duration, as sums of periods are not exact
# probabilities of errors are rounded: covariances may differ between processors
PROBABILITY_ROUND_TO = 1e9
# Constants that the C library or LAPACK computes are rounded, so that all kinds of CPU agree.
GAIN_DECIMALS = 6
ROTATION_DECIMALS = 12  # rotations in an arm's description, from its angles
PULL_DECIMALS = 6  # weights of pulls [m], solved with an error of 1e-9
SLOWEST_PER_S = 0.2  # [1/s] lowest rate of the setpoint's tracker

LEAST_PULL_VARIANCE_SHARE = 1e-6  # added variance, so that exact via-points remain solvable
# Steps that are fine enough: half and twice of them change nothing that is measured.
MOTION_STEP_S = 0.02  # step of the differences along the hands' motion
MEMORY_STEP_S = 0.004  # step of the memory's filters along a demonstration

LEAST_SPEED_MPS = 1e-3  # below this speed a motion has no direction
# the search for a jerk ends when the stop leaves less than this distance unused
STOP_SECANT_TOLERANCE_M = 1e-3

# Larger inputs come from errors elsewhere: joints, targets and errors are clipped, a state is
# rejected.
LARGEST_USABLE = 1e6  # a state of the joints with a larger number is rejected
MAX_JOINT_RAD = 1e4  # [rad, m] positions of joints
MAX_TARGET_M = 1e3  # coordinates of a target
MAX_ERROR_M = 10.0  # [m, m/s] errors and velocities of the tool
MAX_STAMP_DIFFERENCE_NS = 2.0**62  # larger differences of stamps would overflow as integers

# Iterations.
# terms of the exponential series up to 1/2: the next one is below 2^-19 / 19! = 1.6e-23
SERIES_TERMS = 18
BOUND_ROUNDS = 12  # largest number of rounds in which a joint is held at its bound or released
CONSTRAINT_ROUNDS = 40  # largest number of rounds in which an inequality is added or removed
BELIEF_PERIODS = 20  # number of updates after which the belief of hands at rest has converged
# largest number of secant steps; in long periods the stopping distance is not linear in jerk
STOP_SECANTS = 8
STOP_SAMPLES = 16  # the tool's speed is checked at 15 times, which divide the stop into 16 parts
CAPSULE_FITS = 101  # number of lengths that are tried for a capsule
# replaces the first probability in `segments.elsewhere` once evidence has shown the segment
UNPRIMED_DECIDED = -1.0
