"""Tuned numbers of the arm's inverse kinematics.

docs/tuning.md has them as a table, with their measured sensitivity. The line above a number has the
range of sensible values, and what more and less of it are expected to do. A number without that
line follows from others.
"""

from __future__ import annotations

import numpy as np

from service.core.separation.tuning import SLIP_SPEED_MPS

# Costs of the least-squares problem. Lever and dampings in m² are for the WAM's reach, and scale
# with that of the arm.
# 3e-3 to 0.1. More: orientation is kept better. Less: position is kept better.
TURN_LEVER_M = 0.0115  # an error of 1 rad/s in the tool's turn costs as much as one of 0.0115 m/s in its velocity
# 1e-6 to 1e-3. More: joints move less. Less: the tool is more exact.
DAMPING_M2 = 1e-5  # [m²] cost of joint velocity, (m/s)² of the tool for each (rad/s)²
# 1e-4 to 0.02. More: joints are calm when stretched. Less: the stretched tool is exact.
SINGULAR_DAMPING_M2 = 2e-3  # [m²] additional damping at a singular posture; it begins where it weighs as much
# 0 to 20. More: unreachable targets are calm. Less: far targets close faster.
FAR_DAMPING_S2 = 4.0  # [s²] damping at unreachable targets / (closing speed - half of the largest one)²
# Speed of the tool that constraints take away, at which half of SINGULAR_DAMPING_M2 is added. Where
# several constraints leave few directions free, the least motion would change the solution much.
CONSTRAINED_SPEED_MPS = 2.0 * SLIP_SPEED_MPS  # speed lost to constraints at which half of SINGULAR_DAMPING_M2 is added
# 0 to 2. More: weak joints move less. Less: all joints move alike.
SPARING_POWER = 0.8  # weight of a joint's speed = acceleration limit ^ -power: joints with low limits move less

# Closing in on the setpoint.
# 10 to 200. More: the tool lags less. Less: the joints are calm.
POSITION_GAIN_PER_S = 50.0  # [1/s] decay of a small position error
# 0.5 to 5. More: slow joints lag less. Less: slow joints are calm.
POSITION_GAIN_RATE_SHARE = 2.0  # upper limit of the position gain / (jerk / acceleration) of the slowest joint
# 0.04 to 1. More: turns lag less. Less: the joints are calm.
TURN_GAIN_SHARE = 0.2  # decay of a small orientation error / position gain; with more, the joints oscillate
# 0.1 to 1. More: large errors close faster. Less: large errors close calmly.
CLOSING_SPEED_MPS = 0.3  # largest speed at which an error is closed
# 0.03 to 0.5. More: large errors close faster. Less: the joints are calm.
CLOSING_BRAKE_SHARE = 0.1  # share of the tool's deceleration for closing in; with more, the joints oscillate
# 2e-3 to 0.05. More: turns go on. Less: position is kept in turns.
TURN_HORIZON_S = 0.008  # a turn is scaled down unless its joint velocities can be reached within this time
# 0.5 to 1. More: the setpoint is faster. Less: joints can correct more.
PLANNED_LIMIT_SHARES = np.array([0.97, 0.95, 0.85])  # shares of joint speed, acceleration, jerk for the setpoint
TOOL_SPEED_SHARE = 0.5 * (1.0 + float(PLANNED_LIMIT_SHARES[0]))  # speed of setpoint and closing in / max_speed

# The posture, in what is left free.
POSTURE_GAIN_PER_S = TURN_GAIN_SHARE * POSITION_GAIN_PER_S / 10.0  # [1/s] pull to the configured posture, after turns
POSTURE_SPEED_RADPS = CLOSING_SPEED_MPS  # [rad/s] largest speed of this pull, for each joint, on a lever of 1 m
# Idle motion may end faster than the tool closes in: the tool does not show it.
IDLE_BRAKE_SHARE = 2.5 * CLOSING_BRAKE_SHARE  # share of the joints' acceleration for braking it
