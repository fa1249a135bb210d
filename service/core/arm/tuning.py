"""Tuned and numerical constants of the arm's inverse kinematics."""

from __future__ import annotations

import numpy as np

# Costs of the least-squares problem, for an arm of the WAM's reach; they scale with the arm's own.
REFERENCE_REACH_M = 0.88  # reach of the WAM
TURN_LEVER_M = 0.0115  # cost of 1 rad/s of the tool's turn, as m/s of its position
DAMPING_M2 = 1e-5  # [m²] cost of 1 rad/s of a joint, as the square of m/s of the tool
SINGULAR_DAMPING_M2 = 2e-3  # [m²] cost that is added at a singular posture
SINGULAR_VOLUME_M3 = 0.04  # [m³] manipulability below which it is added; 0.06 to 0.13 over the WAM's table
FAR_DAMPING_S2 = 4.0  # [s²] cost that is added, times (closing speed - FAR_SPEED_MPS)²: calm at unreachable targets
FAR_SPEED_MPS = 0.15  # closing speed from which that is added
# Speed of the tool that constraints take away, at which half of SINGULAR_DAMPING_M2 is added. Where
# several constraints leave few directions free, the least motion would change the solution much.
CONSTRAINED_SPEED_MPS = 0.02
SPARING_POWER = 0.8  # cost of a joint's speed ~ its acceleration limit^-0.8, so that slow joints are spared

# Closing in on the setpoint.
POSITION_GAIN_PER_S = 50.0  # [1/s] decay of a small position error
TURN_GAIN_PER_S = 10.0  # [1/s] decay of a small orientation error
POSITION_GAIN_RATE_SHARE = 2.0  # upper limit of the gain / rate at which joints change their acceleration
TURN_GAIN_RATE_SHARE = 0.4  # the same for orientation; with larger gains joints swing about the target
CLOSING_SPEED_MPS = 0.3  # largest speed at which an error is closed
CLOSING_BRAKE_SHARE = (
    0.1  # share of the tool's deceleration for closing in; with more, joints swing at their jerk limit
)
TURN_HORIZON_S = 0.008  # a turn is scaled down unless its joint velocities can be reached within this time
TOOL_SPEED_SHARE = 0.985  # share of max_speed for closing in and forward speed together
PLANNED_LIMIT_SHARES = np.array([0.97, 0.95, 0.85])  # of joint speed, acceleration, jerk for plans; the rest corrects
MAX_ERROR_M = 10.0  # [m, m/s] errors and velocities are clipped to this
SPEED_ROUNDING_MPS = 1e-12  # a smaller speed is rounding

# The posture, in what is left free.
POSTURE_GAIN_PER_S = 1.0  # [1/s] pull to the configured posture
POSTURE_SPEED_RADPS = 0.3  # largest speed of it, each joint
IDLE_BRAKE_SHARE = 0.25  # share of the joints' acceleration for ending motion that does not move the tool
NEAR_LIMIT_RAD = 0.1  # a joint this near to its limit is reported
MAX_JOINT_RAD = 1e4  # joints are clipped to this before anything is calculated

# The solver.
LEAST_PIVOT = 1e-12  # a smaller pivot is rounding
LEAST_BOUND_GAIN = 1e-12  # a joint leaves its bound for at least this gain
BOUND_ROUNDS = 12  # joints that may enter or leave their bounds in one step
CONSTRAINT_ROUNDS = 40  # inequalities that may be met or left in one step
LEAST_EXCESS = 1e-9  # a smaller excess of a constraint is rounding
LEAST_SLOPE = 1e-10  # a constraint with a smaller slope cannot be met along it
LEAST_FORCE = 1e-12  # a constraint with a smaller multiplier may be left
