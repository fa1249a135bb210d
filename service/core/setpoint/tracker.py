"""What leads the setpoint: its tracker's gains, and the target of one that waits for the tool."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_continuous_are

from service.config import Settings
from service.core.frame import Vector
from service.core.joint_limits import acceleration_rate
from service.core.setpoint.tuning import (
    ACCELERATION_REVERSION_PER_S,
    GAIN_DECIMALS,
    GAP_STOPPED_M,
    GAP_WAITING_M,
    SLOWEST_PER_S,
    STIFFEST_PER_M,
    TRACKER_LOOP_SHARE,
    TRACKER_RATE_SHARE,
    VELOCITY_REVERSION_PER_S2,
)
from service.core.skill.model import Target


def gains_for(settings: Settings) -> Vector:
    """`tracker_gains` for the jerk that the settings weigh, but no quicker than tool, joints and
    the loop can follow.
    """
    tool = settings.tool
    own = max(TRACKER_RATE_SHARE * tool.jerk / tool.acceleration, math.cbrt(STIFFEST_PER_M * tool.jerk))
    quickest = min(TRACKER_RATE_SHARE * acceleration_rate(settings.joints), own, TRACKER_LOOP_SHARE * settings.rate_hz)
    return tracker_gains(max(tool.jerk_weight, max(quickest, SLOWEST_PER_S) ** -6))


def tracker_gains(jerk_weight: float) -> Vector:
    """Gains (5,) of the error, of target velocity and acceleration, and of the setpoint's.

    For the jerk that minimises the integral of error² + jerk_weight [s⁶] jerk² while the target's
    acceleration reverts to 0 as ACCELERATION_REVERSION_PER_S and VELOCITY_REVERSION_PER_S2 say.
    """
    a = np.zeros((5, 5))  # error, target velocity and acceleration, setpoint velocity and acceleration
    a[0, 1], a[0, 3], a[1, 2], a[2, 1], a[2, 2], a[3, 4] = (
        1.0,
        -1.0,
        1.0,
        -VELOCITY_REVERSION_PER_S2,
        -ACCELERATION_REVERSION_PER_S,
        1.0,
    )
    b = np.zeros((5, 1))
    b[4, 0] = 1.0
    cost = np.zeros((5, 5))
    cost[0, 0] = 1.0
    riccati = solve_continuous_are(a - 1e-6 * np.eye(5), b, cost, np.array([[jerk_weight]]))
    return np.ascontiguousarray(np.round(-(b.T @ riccati / jerk_weight)[0], GAIN_DECIMALS))


def waiting(target: Target, setpoint: Vector, tool: Vector) -> Target:
    """The target for a setpoint (3, 3) that is far ahead of the tool (3,) [m]: so much nearer to
    where it is as it is to wait, unless that brings it back.
    """
    ahead, way = setpoint[0] - tool, target.position - setpoint[0]
    gap = float(np.linalg.norm(ahead))
    if ahead @ way <= 0.0:
        return target
    share = min(max((GAP_STOPPED_M - gap) / (GAP_STOPPED_M - GAP_WAITING_M), 0.0), 1.0)
    still = np.zeros(3)
    return Target(setpoint[0] + share * way, still, still, clamped=target.clamped)
