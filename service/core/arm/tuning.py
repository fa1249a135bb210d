"""Tuned and numerical constants of the arm's inverse kinematics."""

from __future__ import annotations

import numpy as np

# Costs of the least-squares problem, for an arm of the WAM's reach; they scale with the arm's own.
REFERENCE_REACH_M = 0.88  # reach of the WAM
TURN_LEVER_M = 0.0115  # an error of 1 rad/s in the tool's turn costs as much as one of 0.0115 m/s in its velocity
DAMPING_M2 = 1e-5  # [m²] cost of joint velocity, (m/s)² of the tool for each (rad/s)²
SINGULAR_DAMPING_M2 = 2e-3  # [m²] additional damping at a singular posture
SINGULAR_VOLUME_M3 = 0.04  # [m³] manipulability below which damping is added; 0.06 to 0.13 over the WAM's table
FAR_DAMPING_S2 = 4.0  # [s²] damping at unreachable targets = 4 s² * (closing speed - FAR_SPEED_MPS)²
FAR_SPEED_MPS = 0.15  # closing speed above which the damping for unreachable targets begins
# Speed of the tool that constraints take away, at which half of SINGULAR_DAMPING_M2 is added. Where
# several constraints leave few directions free, the least motion would change the solution much.
CONSTRAINED_SPEED_MPS = 0.02
SPARING_POWER = 0.8  # weight of a joint's speed = acceleration limit^-0.8, so that joints with low limits move less

# Closing in on the setpoint.
POSITION_GAIN_PER_S = 50.0  # [1/s] decay of a small position error
TURN_GAIN_PER_S = 10.0  # [1/s] decay of a small orientation error
POSITION_GAIN_RATE_SHARE = 2.0  # upper limit of the position gain / (jerk / acceleration) of the slowest joint
TURN_GAIN_RATE_SHARE = 0.4  # upper limit of the turn gain / that rate; with larger gains the joints oscillate
CLOSING_SPEED_MPS = 0.3  # largest speed at which an error is closed
CLOSING_BRAKE_SHARE = 0.1  # share of the tool's deceleration for closing in; with more, the joints oscillate
TURN_HORIZON_S = 0.008  # a turn is scaled down unless its joint velocities can be reached within this time
TOOL_SPEED_SHARE = 0.985  # share of max_speed for closing in and forward speed together
PLANNED_LIMIT_SHARES = np.array([0.97, 0.95, 0.85])  # shares of joint speed, acceleration, jerk for the setpoint
MAX_ERROR_M = 10.0  # [m, m/s] errors and velocities are clipped to this
SPEED_ROUNDING_MPS = 1e-12  # a smaller speed is rounding

# The posture, in what is left free.
POSTURE_GAIN_PER_S = 1.0  # [1/s] pull to the configured posture
POSTURE_SPEED_RADPS = 0.3  # largest speed of this pull, for each joint
IDLE_BRAKE_SHARE = 0.25  # share of the joints' acceleration for braking motion that does not move the tool
NEAR_LIMIT_RAD = 0.1  # a joint nearer to its limit than this is reported
MAX_JOINT_RAD = 1e4  # joints are clipped to this before anything is calculated

# The solver.
LEAST_PIVOT = 1e-12  # smaller pivots of a Cholesky factor are replaced by this one
LEAST_BOUND_GAIN = 1e-12  # a joint leaves its bound if the cost falls with a steeper slope than this
BOUND_ROUNDS = 12  # largest number of rounds in which a joint is held at its bound or released
CONSTRAINT_ROUNDS = 40  # largest number of rounds in which an inequality is added or removed
LEAST_EXCESS = 1e-9  # a smaller excess of a constraint is rounding
LEAST_SLOPE = 1e-10  # x cannot move toward a constraint if its slope in the free directions is smaller
LEAST_FORCE = 1e-12  # a multiplier that falls by less than this, per unit of the entering one, is constant
