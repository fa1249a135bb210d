"""Tuned numbers of the decision.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

from service.core.intake.tuning import ARM_STILL_RAD, JOINT_JUMP_RAD

# The arm.
# 0.03 to 0.5. More: a return is fast. Less: a return takes long.
RETURN_RADPS = 0.1  # speed at which a joint outside its limits moves back
# 0.01 to 0.1. More: faults come later. Less: late commands are faults.
TOO_FAST_S = 0.03  # a tool above fault_speed for this time is a fault; one late command is shorter

# Engaging.
# 0.5 to 2. More: hands lost for long are followed fast. Less: short dropouts cost time.
BRIEF_HOLD_S = 1.0  # after a hold this short, which only the hands have caused, the tool does not engage anew

# A tool that is stuck: it comes no nearer to its target.
# 5e-3 to 0.05. More: fewer tools are stuck. Less: a lag looks stuck.
STUCK_GAP_M = 0.02  # a tool nearer than this has reached its target; a target that moves farther is a new one
# 0.3 to 3. More: a stuck tool is noticed later. Less: slow progress looks stuck.
STUCK_S = 0.8  # time within which progress is expected, toward a target or out of a thing
# 0.02 to 0.3. More: slow progress looks stuck. Less: a stuck tool is missed.
PROGRESS_SHARE = 0.08  # expected progress, as share of the distance
# 0.1 to 0.8. More: it stays stuck longer. Less: it is freed by chance.
FREED_SHARE = 0.25  # progress that ends being stuck, as share of the distance
PROGRESS_SPEED_SHARE = FREED_SHARE  # upper limit of expected progress, as share of max_speed times STUCK_S
ANOTHER_TARGET_M = 2.0 * STUCK_GAP_M  # a target this far from the one that could not be reached is tried

# A way out.
# 5 to 60. More: long paths end. Less: long paths are given up.
WAY_TIMEOUT_S = 20.0  # a way out that takes longer is given up
# 0.3 to 3. More: paths are fast. Less: paths take long.
WAY_RADPS = 1.2  # largest speed of the busiest joint
# 0.1 to 1. More: paths are fast. Less: paths take long.
WAY_MPS = 0.4  # largest speed of the tool, low because the person does not command this motion
# 1 to 20. More: postures are approached fast. Less: postures are approached softly.
WAY_GAIN_PER_S = 4.0  # [1/s] approach to each posture
WAY_START_RAD = JOINT_JUMP_RAD  # a way that begins farther from the arm than this is not taken
WAY_NEAR_RAD = ARM_STILL_RAD  # a posture this near is reached; an arm at rest may be as far off
