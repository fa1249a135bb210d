"""Tuned and numerical constants of separation."""

from __future__ import annotations

import numpy as np

# Planning keeps more distance than the rule requires, so that the rule is not reached.
PEOPLE_PLANNED_MARGIN_M = 0.01  # distance kept from people beyond the clearance
THINGS_PLANNED_MARGIN_M = 0.01  # distance kept from things and own parts beyond the clearance
PLANNED_BRAKE_SHARE = 0.8  # share of the braking that is planned with; its ramps need the rest
PLANNED_BRAKE_LIMITS = np.array([1.0, 0.5, 0.5])  # upper limit of it / tool's deceleration: people, things, own parts
PLANNED_REACTION_S = 0.02  # lower limit of the reaction time; joints that may approach more quickly swing

# Inside of a clearance.
CLEARANCE_GAIN_PER_S = 5.0  # [1/s] approach to a clearance, and return to it
RETREAT_SPEED_MPS = 0.02  # largest speed of the return; twice as fast as joints may slip
RETREAT_AUTHORITY_MPS = 0.1  # parts that the joints cannot move at this speed do not return
SLIP_SPEED_MPS = 0.01  # joints that start one after the other may approach at this speed
SLIP_DEPTH_M = 0.0005  # inside a clearance they may slip less, a tenth from this depth on

# Hands: what may happen until the arm reacts.
LOOKAHEAD_S = np.array([0.0, 0.04, 0.08, 0.12, 0.16])  # times at which the rule is evaluated
HAND_ACCELERATION_FADE_S = 0.07  # time constant with which a hand's acceleration fades
BRAKE_RAMP_S = 0.08  # time until a braking has built up, and until a hand's new velocity is known
UNKNOWN_VELOCITY_STD_MPS = 0.2  # a hand whose velocity is less certain has just been seen: `unknown_speed` is used
UNSEEN_ACCELERATION_MPS2 = 5.0  # [m/s²] a hand out of sight is assumed to accelerate toward the arm at this
CONTACT_MARGIN_M = 0.02  # a hand this far outside of a via-point's radius, on each axis, may still be touched

# The body.
TABLE_DEPTH_M = 1.0  # the table is this thick
OWN_CLEARANCE_M = 0.01  # largest clearance between own parts; more would keep the arm from folding
CAPSULE_EXCESS_M = 0.01  # capsules around meshes stand out by about this
CAPSULE_FITS = 101  # lengths tried for a capsule
LEAST_TOOL_M = 0.01  # a tool point nearer to the plate than this needs no capsule
UNMOVED_M = 1e-9  # a joint that moves a point by less does not move it
FARTHEST_REPORTED_M = 3.0  # larger distances are reported as this one
