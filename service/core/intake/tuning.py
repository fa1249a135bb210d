"""Tuned numbers of the intake and of the hand filter.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

import math

import numpy as np

from service.core.intake import STATES

# 2 to 5. More: noise and outliers are trusted. Less: ordinary noise counts as an outlier.
OUTLIER_STDS = 3.0  # what differs by more than this number of standard deviations is an outlier

# 0.4 to 0.95. More: holds end sooner. Less: holds last longer, but do not flicker.
END_SHARE = 0.8  # a hold for a measured reason lasts until its measure is below this share of the threshold

# The hand filter's modes: rest, reach, change.
# 0.05 to 0.8. More: a mode is entered more often. Less: a mode is entered less often.
MODE_PRIOR = np.array([0.3, 0.5, 0.2])  # probabilities before anything is known, and after a switch
# 0.01 to 10. More: changes are seen sooner. Less: estimates are smoother.
MODE_SWITCH_RATES_PER_S = np.array([0.03, 3.0, 3.0])  # [1/s] rates at which the mode is drawn anew; low in rest
# 1e-7 to 100. More: the estimate follows faster. Less: noise is reduced more.
MODE_INTENSITIES_M2PS5 = np.array([1e-6, 1.0, 30.0])  # [m²/s⁵] intensity of the white jerk
# 3 to 40. More: accelerations end sooner. Less: accelerations last longer.
MODE_ACCELERATION_REVERSIONS_PER_S = np.array([10.0, 14.0, 14.0])  # [1/s] decay of the acceleration
# 0.1 to 300. More: motions are expected to end sooner. Less: motions are expected to go on.
MODE_VELOCITY_REVERSIONS_PER_S2 = np.array([0.3, 95.0, 95.0])  # [1/s²] low in rest, where drift goes on; reaches end
# 0 to 2e-3. More: more motion counts as tremor. Less: more tremor reaches the estimate.
TREMOR_STDS_M = np.array([5e-4, 3e-4, 0.0])  # standard deviation on each axis; larger tremor has the same frequency
# 40 to 90. More: faster tremor is removed. Less: slower tremor is removed.
TREMOR_RATE_PER_S = 2.0 * math.pi * 10.0  # [1/s] usual angular frequency; physiological tremor has 8 to 12 Hz
# 0.05 to 0.5. More: irregular tremor is removed. Less: only regular tremor is removed.
TREMOR_DAMPING = 0.1  # damping ratio of the tremor's oscillator
# [1/s] possible rates, 2.3 to 12 Hz; neighbours differ by the width of the resonance
TREMOR_RATES_PER_S = np.round(TREMOR_RATE_PER_S * (1.0 + 2.0 * TREMOR_DAMPING) ** np.arange(-8.0, 2.0), 9)
# 2e-3 to 0.02. More: rest is left later. Less: strong tremor counts as motion.
MAX_TREMOR_M = 6e-3  # upper limit of the amplitude, which only pathological tremor exceeds
# [m/s] after a hand's first sample: OUTLIER_STDS times the stationary one of the mode CHANGE
START_SPEED_STD_MPS = OUTLIER_STDS * math.sqrt(
    MODE_INTENSITIES_M2PS5[-1] / (2.0 * MODE_VELOCITY_REVERSIONS_PER_S2[-1] * MODE_ACCELERATION_REVERSIONS_PER_S[-1])
)
# 3e-3 to 0.03. More: faster drift counts as rest. Less: rest is left sooner.
REST_SPEED_STD_MPS = 0.01  # standard deviation of a resting hand, each axis: hands that hold something drift
REST_ACCELERATION_STD_MPS2 = REST_SPEED_STD_MPS  # [m/s²] it changes its drift by as much in a second
REST_MAX_SPEED_MPS = OUTLIER_STDS * REST_SPEED_STD_MPS  # a faster hand does not rest: reaches are seen at once
# no mode becomes less probable than an outlier on two axes, so that each can return
LEAST_MODE_PROBABILITY = round(math.exp(-(OUTLIER_STDS**2)), 9)
REAPPEARED_VARIANCE_SHARE = OUTLIER_STDS**2  # squared distance / variance of a hand that continues its filter

# Measurement noise, estimated from third differences of the samples.
# 1e-4 to 2e-3. More: estimates are smoother. Less: good trackers are followed faster.
LEAST_NOISE_M = 7e-4  # lower limit of the standard deviation; below it, samples differ by the hand's tremor
# 20 to 300. More: the noise is steadier. Less: the noise adapts faster.
NOISE_SAMPLES = 60  # number of samples over which the noise is averaged
NOISE_OUTLIER_SHARE = OUTLIER_STDS**2  # upper limit of one squared difference / variance

# Stillness, which distinguishes a hand that waits from one on its way.
STILLNESS_LOWPASS_S = 2.0 * math.pi / TREMOR_RATE_PER_S  # time constant of the velocity's lowpass: a period of tremor
# 0.01 to 0.1. More: stillness ends later. Less: stillness ends sooner.
STILLNESS_FALL_S = 0.03  # time constant with which stillness ends

# Late samples.
# 0.03 to 0.3. More: later samples are used. Less: late samples are rejected sooner.
MAX_LATE_S = 0.1  # samples that are older than the newest one by more are rejected; longer delays count as this
VELOCITY_KEPT_S = MAX_LATE_S  # after the newest sample, the velocity is extrapolated for this time
# 0.3 to 5. More: judgements are steadier. Less: drifting clocks and second sources are seen sooner.
TRACKER_MEMORY_S = 1.0  # time over which a tracker's minimum delay and its contradictions are judged
# 2e-3 to 0.05. More: worse clocks are trusted. Less: good clocks are doubted.
DELAY_TOLERANCE_S = 0.01  # minimum delays of two windows agree within this: 1 % of drift between two clocks

# Jumps, and two sources that contradict each other.
# 2 to 10. More: wrong units pass. Less: far trackers are rejected.
MAX_HAND_DISTANCE_M = 5.0  # samples farther from the base plate are rejected; their unit is probably wrong
JUMP_NOISE_STDS = 2.0 * OUTLIER_STDS  # a smaller deviation is no jump; twice, as the prediction is uncertain too
CONFIRMED_SAMPLES = STATES - 2  # agreeing samples that confirm a jump: they show all states but tremor
SETTLED_SAMPLES = CONFIRMED_SAMPLES + 1  # a sample is settled with this number of newer ones: a jump is confirmed
# 0.005 to 0.1. More: jumps are followed later. Less: outliers are followed.
CONFIRMED_S = 0.02  # successive samples that confirm a jump span at least this time
SOURCES_APART_M = 2.0 * MAX_TREMOR_M  # smallest distance between the positions of two sources; tremor spans as much
# 0.1 to 0.8. More: noise looks like two sources. Less: noisy sources are mixed.
SOURCE_SPREAD_SHARE = 0.4  # largest scatter of one source's samples / distance between the sources
# [m/s²] below twice the acceleration of the strongest tremor, a single hand may move to and fro
TO_AND_FRO_MPS2 = 2.0 * MAX_TREMOR_M * TREMOR_RATE_PER_S**2
# 0.1 to 0.5. More: two sources are tolerated longer. Less: outliers hold the arm.
CONTESTED_ON_SHARE = 0.25  # a source is contested above this share of contradicting samples
TO_AND_FRO_MAX_SHARE = 2.0 * CONTESTED_ON_SHARE  # alternating samples raise the contested share up to this limit
CONTESTED_OFF_SHARE = END_SHARE * CONTESTED_ON_SHARE  # a contested source remains so until its share is below this
SCATTER_ON_M = SOURCES_APART_M  # a hand is contested above this standard deviation of its samples on each axis
SCATTER_OFF_M = END_SHARE * SCATTER_ON_M  # a contested hand remains so until the standard deviation is below this
SCATTER_LEAST_SAMPLES = NOISE_SAMPLES // 2  # with fewer, one outlier in four differences looks like scatter

# Joint states. Radians hold for revolute joints; a prismatic joint has them times `per_rad`.
# 0.05 to 1. More: jumps of the arm pass. Less: coarse joint states are rejected.
JOINT_JUMP_RAD = 0.2  # a joint may differ from its newest sample by JOINT_JUMP_RAD + jump speed * elapsed time
# 1 to 20. More: jumps of the arm pass. Less: an arm moved by hand is rejected.
JOINT_JUMP_RADPS = 5.0  # smallest jump speed, because an arm can be moved by hand; else the fastest joint's limit
MAX_JOINT_RADPS = JOINT_JUMP_RAD / 2e-3  # [rad/s] samples of a joint are rejected that would jump within 2 ms
MAX_OUTSIDE_RAD = JOINT_JUMP_RAD  # samples of a joint farther outside its limits are rejected; it is moved back by hand
# 2e-3 to 0.1. More: a moving arm counts as still. Less: a noisy arm never starts.
ARM_STILL_RAD = 0.02  # an arm is at rest if no joint moves by more than this within ARM_STILL_S
ARM_STILL_S = MAX_LATE_S  # an arm must be at rest for this time before it is ready; a late state counts

# Hands without an estimate yet, and hands that move.
# 1e-4 to 0.01. More: the first second is filtered more. Less: the first second is noisier.
NOISE_STD_M = 0.002  # noise of each axis before it is estimated
# 0.01 to 0.5. More: slow reaches count as rest. Less: trembling hands are in motion.
HAND_STILL_MPS = 0.05  # a faster hand is in motion
# 0.02 to 2. More: rest is recognised later. Less: turning points look like rest.
HAND_STILL_S = 0.2  # a slow hand counts as still after this time
# 0.005 to 0.3. More: outliers are followed. Less: quick reaches are rejected.
JUMP_M = 0.04  # a sample farther from its prediction is a jump
# 0 to 5. More: outliers after a pause are followed. Less: hands that reappear are rejected.
JUMP_SPEED_MPS = 1.5  # after a pause the limit of a jump grows at this speed
# 0.1 to 10. More: a true exchange is rejected longer. Less: swapped hands are followed.
SWAPPED_S = 2.0  # exchanged hands are accepted after this time
