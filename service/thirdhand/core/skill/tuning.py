"""Tuned numbers of the skill.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

import math

from thirdhand.core.tuning import TUNING

# Via-points and segments of a task. Between two via-points, a hand moves along a path.
# 0.03 to 0.5. More: segments learn apart. Less: segments share more.
# distance between segments as an input: small, as most of what one shows holds in all
SEGMENT_DISTANCE = 0.12
# the same for orientation and gripper, which belong to one segment
SEGMENT_DISTANCE_BESIDE = 4.0 * SEGMENT_DISTANCE
# 1 to 10. More: resting hands are drawn to ends. Less: rests on the way count.
REST_SHARPNESS = 4.0  # exponent n in λⁿ / (λⁿ + (1 - λ)ⁿ) of a hand that rests at an end
# 0.02 to 0.1. More: resting hands are drawn to ends. Less: rests on the way count.
PATH_END_M = 0.05  # on a full path, a hand that rests this near to an end is at that end
PATH_MIDDLE_M = 2.0 * PATH_END_M  # one that rests this far from both ends waits on its way
FULL_PATH_M = 3.0 * PATH_MIDDLE_M  # a shorter path has thirds instead: begin, middle, end
# 3e-3 to 0.03. More: small motions count as rest. Less: drift counts as a path.
LEAST_PATH_M = 0.01  # a hand whose via-points are nearer to each other than this rests
# exponent of the share with which the tool moves with a hand at a via-point
WITH_HAND_POWER = int(REST_SHARPNESS)
# 0.03 to 0.2. More: segments change sooner. Less: segments change later.
SEGMENT_END_M = 0.08  # width of the Gaussian around a via-point in which segments change
# 0.3 to 5. More: segments change and are repeated sooner. Less: they change later.
# [1/s] rate of transitions to the next segment and back while the hands are there
SEGMENT_CHANGE_PER_S = 1.5
# 1e-6 to 1e-2. More: wrong beliefs recover sooner. Less: the belief is steadier.
# [1/s] rate of transitions to any other segment, so that a wrong belief recovers
SEGMENT_ASTRAY_PER_S = 1e-4
# 0.03 to 2. More: tasks begin again sooner. Less: tasks begin again later.
# [1/s] rate of transitions from the last segment to the first, while hands are at its begin
SEGMENT_CYCLE_PER_S = 0.2
# 1 to 100. More: the first segment is favoured. Less: any segment may be first.
# probability of the first segment / probability of any other, at the start
FIRST_SEGMENT_ODDS = 10.0
SAMPLE_CORRELATION_S = TUNING.intake.hand_still_s  # samples within it carry the same evidence
# larger deviations from a path carry no more evidence
MAX_SQUARED_DEVIATION = TUNING.intake.outlier_stds**2
# 0.05 to 0.5. More: slow motions weigh less. Less: slow motions weigh more.
DIRECTION_SPEED_MPS = 0.15  # evidence of a direction = tanh(speed along the path / 0.15 m/s)
# 1e-3 to 0.015. More: fewer segments are mixed. Less: more segments are mixed.
# a less probable segment is left out; less than 1 / 64, or all of 64 might be
LEAST_SEGMENT_PROBABILITY = 0.01
# 0.1 to 0.5. More: the arm holds less. Less: the arm holds more.
# the skill is ambiguous if the tool belongs elsewhere with this probability
AMBIGUOUS_PROBABILITY = 0.3
AMBIGUOUS_S = 1.5 * SAMPLE_CORRELATION_S  # shorter ambiguity is a transition between segments

# Errors of the prediction.
# 0.05 to 1. More: errors are averaged wider. Less: errors are local.
ERROR_WIDTH = 0.2  # width, in the inputs, of the neighbourhood in which errors are averaged
# 0.01 to 0.5. More: regions grow sooner away from what was shown. Less: they grow later.
SUPPORT_MASS = 0.1  # a place is supported where errors of demonstrations weigh more than this
# an error at the distance d in the inputs weighs exp(-ERROR_SCALE d²)
ERROR_SCALE = 0.5 / ERROR_WIDTH**2
# Between segments as inputs: an error in another segment weighs half of SUPPORT_MASS, so that it
# alone supports no place.
ERROR_SEGMENT_DISTANCE = ERROR_WIDTH * math.sqrt(-math.log(0.5 * SUPPORT_MASS))
# 1 to 16. More: errors are local. Less: errors are averaged wider.
# sharpness of the kernel of errors / of the primitive's kernel, over the hands' inputs
SUPPORT_SHARPNESS = 4.0
# 1e-3 to 0.01. More: the region is larger. Less: the region is smaller.
LEAST_STD_M = 0.003  # lower limit of the standard deviation on each axis
# a tool farther than this from where it belongs is wrong: it may be at another thing
UNSURE_M = PATH_MIDDLE_M
# tools of two segments farther apart than this belong to different things
AMBIGUOUS_M = 0.5 * UNSURE_M
# mean velocity over this time, by the error of timing, adds to the covariance
TRAIL_S = SAMPLE_CORRELATION_S

# Neighbours.
# 0.05 to 0.2. More: wider averages. Less: fewer moments count.
# distance in the inputs of neighbours
NEIGHBOUR_M = 0.1
# 1e-4 to 1e-2. More: averages reach less far. Less: they reach farther.
NEIGHBOUR_MASS = 1e-3  # neighbours count where they weigh more than this
# 0.2 to 1. More: the moment counts. Less: the hands count.
NEIGHBOUR_CLOCK_MPS = 0.5  # largest weight of the clock in the distance of neighbours

# Motion of the target.
# a slower hand may tremble: its velocity does not predict its motion
CALM_MPS = DIRECTION_SPEED_MPS
# 1 to 10. More: targets turn sharply. Less: targets turn softly.
MAX_TARGET_MPS2 = 3.0  # [m/s²] upper limit of the target's acceleration on each axis
# [1/m²] k: a via-point moves the tool with the weight exp(-k |hands - its hands|²), a Gaussian with
# the standard deviation PATH_MIDDLE_M
PULL_SHARPNESS_PER_M2 = 0.5 / PATH_MIDDLE_M**2

# Memory of the hands.
# 0.2 to 1. More: older motion counts. Less: recent motion counts.
# time constant of each filter; half or twice as much predicts recorded partners no better
MEMORY_LAG_S = 0.5
# a hand that is not seen does not fade from memory in longer steps
MEMORY_LONGEST_STEP_S = TUNING.intake.max_late_s
# 0.01 to 0.1. More: orientations are smoother. Less: orientations follow faster.
# time constant of the filters of a hand's turn; trackers have noise of some 0.01 rad
TURN_LAG_S = 0.03
# 0.03 to 0.3. More: orientations weigh more. Less: positions weigh more.
# entries of a rotation matrix become lengths: those of a tool fixed to the hand this far away
TURN_WEIGHT_M = 0.1

# Clock of the task.
# 0.03 to 0.2. More: the clock starts later. Less: a restless hand starts it.
CLOCK_START_MPS = 0.08  # a faster hand has begun the task; tremor and drift are slower
# time constant with which the clock's rate changes, as stillness does
CLOCK_LAG_S = TUNING.intake.stillness_lowpass_s
OWN_NEAR_M = PATH_END_M  # hands this near to where they began the task have returned there

# The gripper.
# 0.02 to 0.3. More: the gripper acts sooner. Less: the gripper acts later.
GRIPPER_OPEN_BELOW = 0.1  # the gripper opens below this closure
# the gripper closes above this closure; between both, it does not move
GRIPPER_CLOSE_ABOVE = 1.0 - GRIPPER_OPEN_BELOW
GRIPPER_MOVES_S = MEMORY_LAG_S  # within this time after a command it gets no other one
# it moves only if the tool is this near to its target, which is one via-point
GRIPPER_THERE_M = LEAST_PATH_M
