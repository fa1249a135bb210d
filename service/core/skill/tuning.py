"""Tuned and numerical constants of the skill."""

from __future__ import annotations

# Via-points and stages of a task. Between two via-points, a hand moves along a segment.
STAGE_DISTANCE = 0.12  # distance between stages as an input of the primitive: most of what one shows holds in all
STAGE_DISTANCE_BESIDE = 0.5  # the same for orientation and gripper, which belong to one stage
REST_SHARPNESS = 4.0  # exponent of the share of a segment of a resting hand
SEGMENT_END_M = 0.05  # on a full segment, a hand that rests this near to an end is at that end
SEGMENT_MIDDLE_M = 0.10  # one that rests this far from both ends waits on its way
FULL_SEGMENT_M = 0.3  # on a shorter segment, SEGMENT_END_M and SEGMENT_MIDDLE_M shrink in proportion
LEAST_SEGMENT_SHARE = 0.1  # smallest factor by which distances shrink on a short segment
LEAST_SEGMENT_M = 0.01  # a hand whose via-points are nearer to each other than this rests
WITH_HAND_POWER = 4  # exponent of the share with which the tool moves with a hand to or from a via-point
STAGE_END_M = 0.08  # a stage ends, and the next begins, within this distance of a via-point
STAGE_FORWARD_PER_S = 1.5  # [1/s] rate of transitions to the next stage while the hands are there
STAGE_BACK_PER_S = 1.0  # [1/s] rate of transitions to the stage before
STAGE_ASTRAY_PER_S = 1e-4  # [1/s] rate of transitions to any other stage, so that a wrong belief recovers
STAGE_CYCLE_PER_S = 0.2  # [1/s] rate of transitions from the last stage to the first, while hands are at its begin
FIRST_STAGE_ODDS = 10.0  # probability of the first stage / probability of any other, at the start
SAMPLE_CORRELATION_S = 0.2  # samples within this time carry the same evidence
FIRST_SAMPLE_WEIGHT = 3.0  # weight of the first sample, before which nothing is known
MAX_SQUARED_DEVIATION = 9.0  # larger deviations from a segment carry no more evidence
DIRECTION_WEIGHT = 1.0  # weight of a hand's direction along the segment
DIRECTION_SPEED_MPS = 0.15  # speed at which it has half of that weight
RESTLESS_WEIGHT = 0.7  # weight of the speed of a hand that rests in a stage, against that stage
LEAST_STAGE_PROBABILITY = 0.01  # a less probable stage is left out of the prediction
BELIEF_PERIODS = 20  # number of updates after which the belief of hands at rest has converged
AMBIGUOUS_M = 0.05  # tools of two stages farther apart than this are different via-points
AMBIGUOUS_PROBABILITY = 0.3  # the skill is ambiguous if the tool belongs elsewhere with this probability
AMBIGUOUS_OFF_SHARE = 0.5  # it is no longer ambiguous below this share of it
AMBIGUOUS_S = 0.3  # shorter ambiguity is a transition between stages

# Errors of the prediction.
ERROR_WIDTH = 0.2  # width, in the inputs, of the neighbourhood in which errors are averaged
OTHER_STAGE_ERROR_WEIGHT = 0.05  # weight of an error in another stage
LEAST_STD_M = 0.003  # lower limit of the standard deviation on each axis
UNSURE_M = 0.10  # the skill is unsure if the 95 % region reaches farther: the tool may belong to another thing
UNSURE_OFF_SHARE = 0.8  # it is no longer unsure below this share of it
TRAIL_S = 0.2  # the tool's motion over this time counts as error: a late tool is still off when hands rest

# Motion of the target.
MOTION_STEP_S = 0.02  # step of the differences along the hands' motion
CALM_MPS = 0.2  # a slower hand trembles: its velocity does not predict its motion
MAX_TARGET_MPS2 = 3.0  # [m/s²] upper limit of the target's acceleration
MAX_TARGET_M = 1e3  # targets are clipped to this distance
PULL_SHARPNESS_PER_M2 = 50.0  # [1/m²] k: a via-point moves the tool with the weight exp(-k |hands - its hands|²)
LEAST_PULL_VARIANCE_SHARE = 1e-6  # added variance, so that exact via-points remain solvable

# Memory of the hands.
MEMORY_LAG_S = 0.5  # time constant of each filter; half or twice as much predicts recorded partners no better
TURN_LAG_S = 0.03  # time constant of the filters of a hand's turn; trackers have noise of some 0.01 rad
TURN_WEIGHT_M = 0.1  # entries of a rotation matrix count as distances of a tool fixed to the hand this far away
MEMORY_STEP_S = 0.004  # step of the filters along a demonstration, as fine as the service's own period
MEMORY_LONGEST_STEP_S = 0.1  # upper limit of a step: a hand that is not seen does not fade from memory

# The gripper.
GRIPPER_OPEN_BELOW = 0.1  # the gripper opens below this closure
GRIPPER_CLOSE_ABOVE = 0.9  # the gripper closes above this closure; between both, it does not move
GRIPPER_MOVES_S = 0.5  # it is left alone for this time after a command
GRIPPER_THERE_M = 0.01  # it moves only if the tool is this near to its target
