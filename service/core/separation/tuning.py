"""Tuned numbers of separation.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

import numpy as np

from service.core.intake.tuning import START_SPEED_STD_MPS

# Planning keeps more distance than the rule requires, so that the rule is not reached.
# 0 to 0.05. More: the arm stays farther away. Less: the rule itself limits the arm.
PLANNED_MARGIN_M = 0.01  # distance kept beyond the clearance
# 0.4 to 1. More: the arm comes faster. Less: ramps are never too short.
PLANNED_BRAKE_SHARE = 0.8  # share of braking and of contact speed that is planned with; ramps need the rest
# 0.2 to 1. More: the arm comes faster. Less: braking is gentle.
PLANNED_BRAKE_LIMITS = np.array([1.0, 0.5, 0.5])  # largest braking / tool's deceleration: people, things, own parts
# 5e-3 to 0.1. More: the arm slows down early. Less: joints oscillate.
PLANNED_REACTION_S = 0.02  # smallest reaction time that is planned with; joints oscillate with a shorter one

# Inside of a clearance.
# 1 to 20. More: the arm returns faster. Less: the arm returns softly.
CLEARANCE_GAIN_PER_S = 5.0  # [1/s] planned speed / distance left to the clearance; negative inside
# 2e-3 to 0.05. More: the rule is exceeded more. Less: the arm stops for rounding.
SLIP_SPEED_MPS = 0.01  # excess that is tolerated, as joints do not all reach their velocities at the same time
RETREAT_SPEED_MPS = 2.0 * SLIP_SPEED_MPS  # largest speed of the return to the clearance
RETREAT_AUTHORITY_MPS = 5.0 * RETREAT_SPEED_MPS  # a part returns only if the joints, unstrained, can move it at this
# Inside a clearance the tolerated excess falls linearly, to a tenth at 0.9 of this depth: the arm
# slips by as much in a reaction time.
SLIP_DEPTH_M = SLIP_SPEED_MPS * PLANNED_REACTION_S

# Hands: what may happen until the arm reacts.
# 0.03 to 0.2. More: the arm slows down earlier. Less: ramps are too short.
BRAKE_RAMP_S = 0.08  # time until a deceleration has built up, and until a hand's new velocity is measured
HAND_ACCELERATION_FADE_S = BRAKE_RAMP_S  # time constant with which a hand's acceleration fades
LOOKAHEAD_S = 0.5 * BRAKE_RAMP_S * np.arange(5.0)  # times ahead at which the rule is evaluated
# A hand is assumed to approach at `unknown_speed` until its velocity is better known than after its
# first sample.
UNKNOWN_VELOCITY_STD_MPS = 2.0 * START_SPEED_STD_MPS / 3.0  # on each axis
# 1 to 20. More: the arm retreats sooner. Less: hands may appear closer than planned.
UNSEEN_ACCELERATION_MPS2 = 5.0  # [m/s²] a hand out of sight is assumed to accelerate toward the arm at this
# 5e-3 to 0.1. More: contact is allowed wider. Less: a reached via-point blocks the tool.
CONTACT_MARGIN_M = 0.02  # a hand may be touched up to this distance beyond a via-point's radius, on each axis

# The body.
OWN_CLEARANCE_M = PLANNED_MARGIN_M  # largest clearance between own parts; more would keep the arm from folding
CAPSULE_EXCESS_M = OWN_CLEARANCE_M  # capsules around meshes exceed them by about as much

# Speeds of hands.
# 0.5 to 3. More: the arm keeps farther away from a hand that appears. Less: it reacts later.
UNKNOWN_SPEED_MPS = 1.6  # assumed speed of a hand that was only just seen
# 0.02 to 0.3. More: slow approaches are ignored. Less: the arm gives way to a tremor.
TREMOR_SPEED_MPS = 0.1  # a slower hand's motion is ignored as tremor; from twice that it counts in full
