"""Tuned and numerical constants of the intake and of the hand filter."""

from __future__ import annotations

import math

import numpy as np

# The hand filter's modes: rest, reach, change.
MODE_PRIOR = np.array([0.3, 0.5, 0.2])  # probabilities before anything is known
MODE_SWITCH_RATES_PER_S = np.array([0.03, 3.0, 3.0])  # [1/s] rates at which modes are left; noise must not end rest
MODE_INTENSITIES = np.array([1e-6, 1.0, 30.0])  # [m²/s⁵] of the white jerk
MODE_ACCELERATION_REVERSIONS_PER_S = np.array([10.0, 14.0, 14.0])  # [1/s]
MODE_VELOCITY_REVERSIONS_PER_S2 = np.array([0.3, 95.0, 95.0])  # [1/s²] slow hands keep their velocity, reaches end
TREMOR_STDS_M = np.array([5e-4, 3e-4, 0.0])  # on each axis; a larger tremor is recognised by its rhythm
TREMOR_RATE_PER_S = 2.0 * math.pi * 10.0  # angular frequency; physiological tremor has 8 to 12 Hz
TREMOR_DAMPING = 0.18  # damping ratio of the tremor's oscillator
MAX_TREMOR_M = 6e-3  # upper limit of the amplitude, which only pathological tremor exceeds
START_SPEED_STD_MPS = 0.3  # of a hand with one sample
START_ACCELERATION_STD_MPS2 = 1.0  # [m/s²] of a hand with one sample
REST_SPEED_STD_MPS = 0.01  # of a resting hand, each axis: hands that hold something drift
REST_ACCELERATION_STD_MPS2 = 0.01  # [m/s²] it takes a second to change its drift
REST_MAX_SPEED_MPS = 0.03  # a resting hand is no faster, so that beginnings and ends of reaches are seen at once
LEAST_MODE_PROBABILITY = 1e-4
MAX_INNOVATION = 60.0  # normalised and squared; beyond it all modes are equally unlikely
PROBABILITY_ROUND_TO = 1e12  # probabilities are rounded, so that a replay on another kind of CPU agrees
VELOCITY_KEPT_S = 0.06  # after the newest sample, the velocity is extrapolated for this time
ACCELERATION_FADE_PER_S = 5.0  # [1/s] decay of the extrapolated acceleration
REAPPEARED_VARIANCE_SHARE = 16.0  # squared distance / variance within which a hand that reappears continues its filter

# Measurement noise, estimated from third differences of the samples.
LEAST_NOISE_M = 7e-4  # lower limit of the standard deviation; below it, samples differ by the hand's tremor
MAX_NOISE_M = 5e-2  # upper limit
NOISE_SAMPLES = 60  # samples over which it is averaged
NOISE_OUTLIER_SHARE = 9.0  # upper limit of one squared difference / variance
LONE_SAMPLE_S = 1.0  # interval that is assumed before the first sample of a filter

# Stillness, which distinguishes a hand that waits from one on its way.
STILLNESS_LOWPASS_S = 0.1  # time constant of the velocity's lowpass, which removes a tremor of 8 to 12 Hz
STILLNESS_FALL_S = 0.03  # time constant with which stillness ends

# Late samples.
MAX_LATE_S = 0.1  # a sample may be this much older than the newest one, and later than the minimum delay
DELAY_WINDOW_S = 1.0  # window of the minimum delay; the smallest of 30 delays from 0 to 60 ms is 2 ms on average
DELAY_TOLERANCE_S = 0.01  # minimum delays of two windows agree within this; clocks 1 % apart do not
MAX_STAMP_DIFFERENCE_NS = 2.0**62  # larger differences of stamps would overflow as integers, and are computed as floats
TICK_ROUNDING = 1e-6  # [ticks] rounding of a lateness, as sums of periods are not exact
LEAST_INTERVAL_S = 1e-3  # lower limit of the time between two samples, also within a tick

# Jumps, and two sources that contradict each other.
MAX_HAND_DISTANCE_M = 5.0  # samples farther from the base plate are rejected; their unit is probably wrong
PLAUSIBLE_DISTANCES_M = (0.05, 2.5)  # distances of hands and tool from the base plate, in the unit that was meant
JUMP_NOISE_STDS = 6.0  # a deviation of at most this number of the noise's standard deviations is no jump
CONFIRMED_SAMPLES = 3  # a jump is accepted after this number of successive samples that agree
CONFIRMED_S = 0.02  # successive samples that confirm a jump span at least this time
AGREE_M = 0.03  # samples that jumped agree within AGREE_M + AGREE_MPS * elapsed time
AGREE_MPS = 2.0  # speed at which a hand that has jumped may move on
SWAPPED_M = 0.05  # a hand may be the other one within SWAPPED_M + SWAPPED_MPS * elapsed time of it
SWAPPED_MPS = 0.2  # speed at which the other hand may have moved since it was seen
SOURCES_APART_M = 0.012  # smallest distance between the positions that two sources report
SOURCE_SPREAD_SHARE = 0.4  # largest scatter of one source's samples / distance between the sources
OFFSET_TOLERANCE_M = 0.03  # offsets of a source agree within OFFSET_TOLERANCE_M + OFFSET_CHANGE_MPS * elapsed time
OFFSET_CHANGE_MPS = 0.5  # speed at which the offset may change
RETURN_SAMPLES = 12  # a source three times as slow as the other returns twice within this number of samples
TO_AND_FRO_S = 0.08  # a hand with two sources alternates between them within this time
TO_AND_FRO_MPS2 = 50.0  # [m/s²] below this acceleration, a single hand could have moved like that
TO_AND_FRO_MAX_SHARE = 0.5  # alternating samples raise the contested share up to this limit
CONTESTED_ON_SHARE = 0.25  # a source is contested above this share of contradicting samples
CONTESTED_OFF_SHARE = 0.1  # a contested source remains so until its share is below this
CONTESTED_MEMORY_S = 1.0  # time over which the share is averaged
SAMPLE_MAX_S = 1 / 30  # a sample counts for at most this time, however long the pause before it
SCATTER_ON_M = 0.012  # a hand is contested above this standard deviation of its samples on each axis
SCATTER_OFF_M = 0.010  # a contested hand remains so until the standard deviation is below this
SCATTER_LEAST_SAMPLES = 30  # fewer samples do not show scatter, because one outlier affects four of them

# Joint states. Radians hold for revolute joints; a prismatic joint has them times `per_rad`.
MAX_JOINT_RADPS = 100.0  # samples of a faster joint are rejected
JOINT_JUMP_RAD = 0.2  # a joint may differ from its newest sample by JOINT_JUMP_RAD + jump speed * elapsed time
JOINT_JUMP_RADPS = 5.0  # smallest jump speed, because an arm can be moved by hand
JOINT_JUMP_SPEEDS = 2.0  # smallest ratio of the jump speed to the fastest joint's speed limit
MAX_OUTSIDE_RAD = 0.2  # samples of a joint farther outside its limits are rejected; it must be moved back by hand
ARM_STILL_RAD = 0.02  # an arm is at rest if no joint moves by more than this within ARM_STILL_S
ARM_STILL_S = 0.1  # time for which an arm must be at rest before it is ready
