"""Tuned numbers of the intake and of the hand filter.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

import math

import numpy as np

# The hand filter's modes: rest, reach, change.
# 0.05 to 0.8. More: a mode is entered more often. Less: a mode is entered less often.
MODE_PRIOR = np.array([0.3, 0.5, 0.2])  # probabilities before anything is known
# 0.01 to 10. More: changes are seen sooner. Less: estimates are smoother.
MODE_SWITCH_RATES_PER_S = np.array([0.03, 3.0, 3.0])  # [1/s] rates at which modes are left; noise must not end rest
# 1e-7 to 100. More: the estimate follows faster. Less: noise is reduced more.
MODE_INTENSITIES_M2PS5 = np.array([1e-6, 1.0, 30.0])  # [m²/s⁵] intensity of the white jerk
# 3 to 40. More: accelerations end sooner. Less: accelerations last longer.
MODE_ACCELERATION_REVERSIONS_PER_S = np.array([10.0, 14.0, 14.0])  # [1/s] decay of the acceleration
# 0.1 to 300. More: motions are expected to end sooner. Less: motions are expected to go on.
MODE_VELOCITY_REVERSIONS_PER_S2 = np.array([0.3, 95.0, 95.0])  # [1/s²] slow hands keep their velocity, reaches end
# 0 to 2e-3. More: more motion counts as tremor. Less: more tremor reaches the estimate.
TREMOR_STDS_M = np.array(
    [5e-4, 3e-4, 0.0]
)  # standard deviation on each axis; a larger tremor is recognised by its rhythm
# 40 to 90. More: faster tremor is removed. Less: slower tremor is removed.
TREMOR_RATE_PER_S = 2.0 * math.pi * 10.0  # [1/s] angular frequency; physiological tremor has 8 to 12 Hz
# 0.05 to 0.5. More: irregular tremor is removed. Less: only regular tremor is removed.
TREMOR_DAMPING = 0.18  # damping ratio of the tremor's oscillator
# 2e-3 to 0.02. More: rest is left later. Less: strong tremor counts as motion.
MAX_TREMOR_M = 6e-3  # upper limit of the amplitude, which only pathological tremor exceeds
# 0.1 to 1. More: new hands move sooner. Less: new hands rest longer.
START_SPEED_STD_MPS = 0.3  # standard deviation of the speed after a hand's first sample
# 0.3 to 5. More: new hands move sooner. Less: new hands rest longer.
START_ACCELERATION_STD_MPS2 = 1.0  # [m/s²] standard deviation after a hand's first sample
# 3e-3 to 0.03. More: faster drift counts as rest. Less: rest is left sooner.
REST_SPEED_STD_MPS = 0.01  # standard deviation of a resting hand, each axis: hands that hold something drift
# 3e-3 to 0.05. More: changing drift counts as rest. Less: rest is left sooner.
REST_ACCELERATION_STD_MPS2 = 0.01  # [m/s²] standard deviation of a resting hand: it changes its drift within a second
# 0.01 to 0.1. More: ends of reaches are seen later. Less: slow drift counts as a reach.
REST_MAX_SPEED_MPS = 0.03  # a resting hand is no faster, so that beginnings and ends of reaches are seen at once
# 1e-6 to 1e-2. More: modes switch sooner. Less: modes switch later.
LEAST_MODE_PROBABILITY = 1e-4  # no mode becomes less probable, so that each can return
# 10 to 200. More: single outliers switch modes. Less: changes are seen later.
MAX_INNOVATION = 60.0  # limit of the squared, normalised innovation: beyond it all modes are equally unlikely
# 0.02 to 0.2. More: lag is shorter and overshoot larger. Less: estimates stop sooner.
VELOCITY_KEPT_S = 0.06  # after the newest sample, the velocity is extrapolated for this time
# 1 to 20. More: accelerations are trusted less. Less: accelerations are trusted longer.
ACCELERATION_FADE_PER_S = 5.0  # [1/s] decay of the extrapolated acceleration
# 4 to 50. More: more hands keep their filter. Less: more hands start anew.
REAPPEARED_VARIANCE_SHARE = 16.0  # squared distance / variance within which a hand that reappears continues its filter

# Measurement noise, estimated from third differences of the samples.
# 1e-4 to 2e-3. More: estimates are smoother. Less: good trackers are followed faster.
LEAST_NOISE_M = 7e-4  # lower limit of the standard deviation; below it, samples differ by the hand's tremor
# 0.01 to 0.1. More: bad trackers are smoothed more. Less: bad trackers are followed faster.
MAX_NOISE_M = 5e-2  # upper limit of the standard deviation
# 20 to 300. More: the noise is steadier. Less: the noise adapts faster.
NOISE_SAMPLES = 60  # number of samples over which the noise is averaged
# 3 to 30. More: outliers raise the noise. Less: the noise adapts slower.
NOISE_OUTLIER_SHARE = 9.0  # upper limit of one squared difference / variance
# 0.1 to 3. More: a first sample weighs less in noise. Less: a first sample weighs more.
LONE_SAMPLE_S = 1.0  # interval that is assumed before the first sample of a filter

# Stillness, which distinguishes a hand that waits from one on its way.
# 0.03 to 0.3. More: stronger tremor is ignored. Less: stillness follows faster.
STILLNESS_LOWPASS_S = 0.1  # time constant of the velocity's lowpass, which removes a tremor of 8 to 12 Hz
# 0.01 to 0.1. More: stillness ends later. Less: stillness ends sooner.
STILLNESS_FALL_S = 0.03  # time constant with which stillness ends

# Late samples.
# 0.03 to 0.3. More: later samples are used. Less: late samples are rejected sooner.
MAX_LATE_S = 0.1  # a sample may be this much older than the newest one, and later than the minimum delay
# 0.3 to 5. More: the minimum delay is steadier. Less: a drifting clock is followed.
DELAY_WINDOW_S = 1.0  # window of the minimum delay; the smallest of 30 delays from 0 to 60 ms is 2 ms on average
# 2e-3 to 0.05. More: worse clocks are trusted. Less: good clocks are doubted.
DELAY_TOLERANCE_S = 0.01  # minimum delays of two windows agree within this; clocks 1 % apart do not
# 1e-4 to 5e-3. More: fewer turns look hard. Less: more turns look hard.
LEAST_INTERVAL_S = 1e-3  # lower limit of the time between two samples, also within a tick

# Jumps, and two sources that contradict each other.
# 2 to 10. More: wrong units pass. Less: far trackers are rejected.
MAX_HAND_DISTANCE_M = 5.0  # samples farther from the base plate are rejected; their unit is probably wrong
# 3 to 12. More: larger jumps pass. Less: noisy samples are rejected.
JUMP_NOISE_STDS = 6.0  # a deviation of at most this number of the noise's standard deviations is no jump
# 2 to 10. More: jumps are followed later. Less: outliers are followed.
CONFIRMED_SAMPLES = 3  # a jump is accepted after this number of successive samples that agree
# 0.005 to 0.1. More: jumps are followed later. Less: outliers are followed.
CONFIRMED_S = 0.02  # successive samples that confirm a jump span at least this time
# 0.01 to 0.1. More: outliers agree by chance. Less: a moving hand is confirmed later.
AGREE_M = 0.03  # samples that jumped agree within AGREE_M + AGREE_MPS * elapsed time
# 0.5 to 5. More: outliers agree by chance. Less: a moving hand is confirmed later.
AGREE_MPS = 2.0  # speed at which a hand that has jumped may move on
# 0.02 to 0.15. More: close hands count as swapped. Less: swapped hands are followed.
SWAPPED_M = 0.05  # a hand may be the other one within SWAPPED_M + SWAPPED_MPS * elapsed time of it
# 0.05 to 1. More: close hands count as swapped. Less: swapped hands are followed.
SWAPPED_MPS = 0.2  # speed at which the other hand may have moved since it was seen
# 5e-3 to 0.05. More: near sources are mixed. Less: noise looks like two sources.
SOURCES_APART_M = 0.012  # smallest distance between the positions that two sources report
# 0.1 to 0.8. More: noise looks like two sources. Less: noisy sources are mixed.
SOURCE_SPREAD_SHARE = 0.4  # largest scatter of one source's samples / distance between the sources
OFFSET_TOLERANCE_M = AGREE_M  # offsets of a source agree within OFFSET_TOLERANCE_M + OFFSET_CHANGE_MPS * elapsed time
# 0.1 to 2. More: outliers look like a source. Less: a moving source is missed.
OFFSET_CHANGE_MPS = 0.5  # speed at which the offset may change
# 6 to 30. More: slower sources are found. Less: outliers are forgiven.
RETURN_SAMPLES = 12  # a source three times as slow as the other returns twice within this number of samples
# 0.03 to 0.3. More: slower sources are found. Less: slow trackers are not judged.
TO_AND_FRO_S = 0.08  # a hand with two sources alternates between them within this time
# 20 to 200. More: fast hands are spared. Less: fast hands look like two sources.
TO_AND_FRO_MPS2 = 50.0  # [m/s²] below this acceleration, a single hand could have moved like that
# 0.1 to 0.5. More: two sources are tolerated longer. Less: outliers hold the arm.
CONTESTED_ON_SHARE = 0.25  # a source is contested above this share of contradicting samples
TO_AND_FRO_MAX_SHARE = 2.0 * CONTESTED_ON_SHARE  # alternating samples raise the contested share up to this limit
# 0.02 to 0.2. More: a hold ends sooner. Less: a hold lasts longer.
CONTESTED_OFF_SHARE = 0.1  # a contested source remains so until its share is below this
# 0.3 to 5. More: two sources are noticed later. Less: single outliers weigh more.
CONTESTED_MEMORY_S = 1.0  # time over which the share is averaged
# 0.01 to 0.1. More: slow sources weigh more. Less: slow sources weigh less.
SAMPLE_MAX_S = 1 / 30  # a sample counts for at most this time, however long the pause before it
# 5e-3 to 0.03. More: scatter is tolerated. Less: noisy trackers hold the arm.
SCATTER_ON_M = 0.012  # a hand is contested above this standard deviation of its samples on each axis
# 3e-3 to 0.03. More: a hold ends sooner. Less: a hold lasts longer.
SCATTER_OFF_M = 0.010  # a contested hand remains so until the standard deviation is below this
SCATTER_LEAST_SAMPLES = (
    NOISE_SAMPLES // 2
)  # fewer samples do not show scatter, because one outlier affects four of them

# Joint states. Radians hold for revolute joints; a prismatic joint has them times `per_rad`.
# 20 to 1000. More: wrong samples pass. Less: fast arms are rejected.
MAX_JOINT_RADPS = 100.0  # samples of a faster joint are rejected
# 0.05 to 1. More: jumps of the arm pass. Less: coarse joint states are rejected.
JOINT_JUMP_RAD = 0.2  # a joint may differ from its newest sample by JOINT_JUMP_RAD + jump speed * elapsed time
# 1 to 20. More: jumps of the arm pass. Less: an arm moved by hand is rejected.
JOINT_JUMP_RADPS = 5.0  # smallest jump speed, because an arm can be moved by hand
# 1 to 5. More: jumps of the arm pass. Less: fast arms are rejected.
JOINT_JUMP_SPEEDS = 2.0  # smallest ratio of the jump speed to the fastest joint's speed limit
# 0.05 to 0.5. More: the arm returns from farther out. Less: it is moved by hand sooner.
MAX_OUTSIDE_RAD = 0.2  # samples of a joint farther outside its limits are rejected; it must be moved back by hand
# 2e-3 to 0.1. More: a moving arm counts as still. Less: a noisy arm never starts.
ARM_STILL_RAD = 0.02  # an arm is at rest if no joint moves by more than this within ARM_STILL_S
# 0.03 to 1. More: the arm starts later. Less: a moving arm counts as still.
ARM_STILL_S = 0.1  # time for which an arm must be at rest before it is ready
