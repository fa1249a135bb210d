"""Tuned numbers of the decision.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

from service.core.intake.tuning import ARM_STILL_RAD, CONFIRMED_S, JOINT_JUMP_RAD, MAX_OUTSIDE_RAD, TRACKER_MEMORY_S

# The arm.
RETURN_RADPS = 0.5 * MAX_OUTSIDE_RAD  # a joint outside its limits moves back at this speed, within 2 s
TOO_FAST_S = 1.5 * CONFIRMED_S  # a tool above fault_speed for this time is a fault; one late command is shorter

# Engaging.
BRIEF_HOLD_S = TRACKER_MEMORY_S  # after a hold this short, caused only by the hands, the tool does not engage anew

# A tool that is stuck: it comes no nearer to its target.
# 5e-3 to 0.05. More: fewer tools are stuck. Less: a lag looks stuck.
STUCK_GAP_M = 0.02  # a tool nearer than this has reached its target; a target that moves farther is a new one
# 0.3 to 3. More: a stuck tool is noticed later. Less: slow progress looks stuck.
STUCK_S = 0.8  # time within which progress is expected, toward a target or out of a thing
# 0.02 to 0.3. More: slow progress looks stuck. Less: a stuck tool is missed.
PROGRESS_SHARE = 0.08  # expected progress, as share of the distance
FREED_SHARE = 3.0 * PROGRESS_SHARE  # progress that ends being stuck, as share of the distance: more than chance
PROGRESS_SPEED_SHARE = FREED_SHARE  # upper limit of expected progress, as share of max_speed times STUCK_S
ANOTHER_TARGET_M = 2.0 * STUCK_GAP_M  # a target this far from the one that could not be reached is tried

# A way out. Its speed follows from the settings (`leave.speeds_of_ways`).
WAY_START_RAD = JOINT_JUMP_RAD  # a way that begins farther from the arm than this is not taken
WAY_SLOW_RAD = WAY_START_RAD  # a joint nearer to its posture than this slows down
LONGEST_WAY_RAD = 100.0 * WAY_START_RAD  # a way out is given up after the time that a joint needs for this
WAY_NEAR_RAD = ARM_STILL_RAD  # a posture this near is reached; an arm at rest may be as far off
