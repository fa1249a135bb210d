"""Tuned constants of the decision."""

from __future__ import annotations

# The arm.
RETURN_RADPS = 0.1  # speed at which a joint outside its limits moves back
TOO_FAST_S = 0.03  # a tool above fault_speed for this time is a fault; one late command is shorter
INSIDE_M = 0.01  # capsules may overlap by this: they are larger than the links
FREED_TIMEOUT_S = 1.0  # an arm that does not get out of a thing within this time stays where it is

# A tool that is stuck: it comes no nearer to its target.
STUCK_GAP_M = 0.02  # a tool nearer than this has reached its target
STUCK_S = 0.8  # time within which progress is expected
PROGRESS_SHARE = 0.08  # expected progress, as share of the distance
PROGRESS_SPEED_SHARE = 0.3  # upper limit of it, as share of max_speed times STUCK_S
FREED_SHARE = 0.25  # progress that ends being stuck
STUCK_TARGET_M = 0.02  # a target that moves farther within STUCK_S is a new one
ANOTHER_TARGET_M = 0.04  # a target this far from the one that could not be reached is tried

# A way out.
WAY_TIMEOUT_S = 20.0  # a way out that takes longer is given up
WAY_RADPS = 1.2  # largest speed of the busiest joint
WAY_SPEED_SHARE = 0.5  # largest share of a joint's own speed limit
WAY_MPS = 0.4  # largest speed of the tool, low because the person does not command this motion
WAY_GAIN_PER_S = 4.0  # [1/s] approach to each posture
WAY_START_RAD = 0.3  # a way that begins farther from the arm than this is not taken
WAY_NEAR_RAD = 0.02  # a posture this near is reached

GATE_RETURN_SHARE = 0.9  # hands that were too far must come below this share of the threshold
