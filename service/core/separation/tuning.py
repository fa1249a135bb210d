"""Tuned and numerical constants of separation."""

from __future__ import annotations

import numpy as np

# Planning keeps more distance than the rule requires, so that the rule is not reached.
PEOPLE_PLANNED_MARGIN_M = 0.01  # distance kept from people beyond the clearance
THINGS_PLANNED_MARGIN_M = 0.01  # distance kept from things and own parts beyond the clearance
PLANNED_BRAKE_SHARE = 0.8  # share of the braking that is planned with; its ramps need the rest
PLANNED_BRAKE_LIMITS = np.array([1.0, 0.5, 0.5])  # largest braking / tool's deceleration: people, things, own parts
PLANNED_REACTION_S = 0.02  # smallest reaction time that is planned with; joints oscillate with a shorter one

# Inside of a clearance.
CLEARANCE_GAIN_PER_S = 5.0  # [1/s] planned speed = 5 /s * distance left to the clearance; negative inside
RETREAT_SPEED_MPS = 0.02  # largest speed of the return to the clearance; twice SLIP_SPEED_MPS
RETREAT_AUTHORITY_MPS = 0.1  # a part returns only if the joints can move it at this speed
SLIP_SPEED_MPS = 0.01  # excess that is tolerated, as joints do not all reach their velocities at the same time
SLIP_DEPTH_M = 0.0005  # inside a clearance the tolerated excess falls, to a tenth near this depth

# Hands: what may happen until the arm reacts.
LOOKAHEAD_S = np.array([0.0, 0.04, 0.08, 0.12, 0.16])  # times ahead at which the rule is evaluated
HAND_ACCELERATION_FADE_S = 0.07  # time constant with which a hand's acceleration fades
BRAKE_RAMP_S = 0.08  # time until a deceleration has built up, and until a hand's new velocity is measured
UNKNOWN_VELOCITY_STD_MPS = 0.2  # a hand with a larger standard deviation is assumed to approach at `unknown_speed`
UNSEEN_ACCELERATION_MPS2 = 5.0  # [m/s²] a hand out of sight is assumed to accelerate toward the arm at this
CONTACT_MARGIN_M = 0.02  # a hand may be touched up to this distance beyond a via-point's radius, on each axis

# The body.
TABLE_DEPTH_M = 1.0  # the table is this thick
OWN_CLEARANCE_M = 0.01  # largest clearance between own parts; more would keep the arm from folding
CAPSULE_EXCESS_M = 0.01  # capsules around meshes exceed them by about this
CAPSULE_FITS = 101  # number of lengths that are tried for a capsule
LEAST_TOOL_M = 0.01  # a tool point nearer to the plate than this needs no capsule
UNMOVED_M = 1e-9  # a distance that varies by less between postures is constant
FARTHEST_REPORTED_M = 3.0  # larger distances are reported as this one
