"""What leads the setpoint: its tracker's gains, and the target of one that waits for the tool."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_continuous_are

from service.config import Settings
from service.core.arm.arm import acceleration_rate
from service.core.frame import Vector
from service.core.skill.model import Target

TRACKER_SHARE = 1.1  # of the rate at which joints change their acceleration: a quicker tracker swings with them
TRACKER_STEP = 0.6  # of the loop's rate, likewise: it acts once a tick (swings from 1)
STIFFEST = 100.0  # [1/m] of the tool's jerk for an error: it swings only where farther off than the hull lets it be
SLOWEST = 0.2  # [1/s] of a tracker, however little jerk there is: slower gains are not found
GAP_WIDE, GAP_MOST = 0.12, 0.2  # [m] ahead of its tool, where a setpoint begins to wait for it, and where it waits
REVERT_A = 5.0  # [1/s] with which the tracker expects a target's acceleration to end
REVERT_V = 150.0  # [1/s²] with which it expects a target's velocity to end
DECIMALS = 6  # of the gains: rounded so that a replay on another kind of CPU agrees


def gains_for(settings: Settings) -> Vector:
    """`tracker_gains` for the jerk that the settings weigh, but no quicker than tool, joints and
    the loop can follow.
    """
    tool = settings.tool
    own = max(TRACKER_SHARE * tool.jerk / tool.acceleration, math.cbrt(STIFFEST * tool.jerk))
    quickest = min(TRACKER_SHARE * acceleration_rate(settings.joints), own, TRACKER_STEP * settings.rate_hz)
    return tracker_gains(max(tool.jerk_weight, max(quickest, SLOWEST) ** -6))


def tracker_gains(jerk_weight: float) -> Vector:
    """Gains (5,) of the error, of target velocity and acceleration, and of the setpoint's.

    For the jerk that minimises the integral of error² + jerk_weight [s⁶] jerk² while the target's
    acceleration reverts to 0 as REVERT_A and REVERT_V say.
    """
    a = np.zeros((5, 5))  # error, target velocity and acceleration, setpoint velocity and acceleration
    a[0, 1], a[0, 3], a[1, 2], a[2, 1], a[2, 2], a[3, 4] = 1.0, -1.0, 1.0, -REVERT_V, -REVERT_A, 1.0
    b = np.zeros((5, 1))
    b[4, 0] = 1.0
    cost = np.zeros((5, 5))
    cost[0, 0] = 1.0
    riccati = solve_continuous_are(a - 1e-6 * np.eye(5), b, cost, np.array([[jerk_weight]]))
    return np.ascontiguousarray(np.round(-(b.T @ riccati / jerk_weight)[0], DECIMALS))


def waiting(target: Target, setpoint: Vector, tool: Vector) -> Target:
    """The target for a setpoint (3, 3) that is far ahead of the tool (3,) [m]: so much nearer to
    where it is as it is to wait, unless that brings it back.
    """
    ahead, way = setpoint[0] - tool, target.position - setpoint[0]
    gap = float(np.linalg.norm(ahead))
    if ahead @ way <= 0.0:
        return target
    share = min(max((GAP_MOST - gap) / (GAP_MOST - GAP_WIDE), 0.0), 1.0)
    still = np.zeros(3)
    return Target(setpoint[0] + share * way, still, still, clamped=target.clamped)
