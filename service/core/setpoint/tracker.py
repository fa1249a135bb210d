"""Gains of the setpoint's tracker, and the target of a setpoint that waits for its tool."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_continuous_are

from service.core.frame import Vector
from service.core.intake.motion_model import REACH
from service.core.intake.tuning import MODE_ACCELERATION_REVERSIONS_PER_S, MODE_VELOCITY_REVERSIONS_PER_S2
from service.core.joint_limits import acceleration_rate
from service.core.numerics import GAIN_DECIMALS, SLOWEST_PER_S
from service.core.setpoint.tuning import GAP_STOPPED_M, GAP_WAITING_M, STIFFEST_PER_M, TRACKER_RATE_SHARE
from service.core.skill.model import Target
from service.settings.config import Settings


def gains_for(settings: Settings) -> Vector:
    """Gains (5,) of `tracker_gains` for the settings, slow enough for tool, joints and loop.

    With jerk_weight w the tracker's rate is w^(-1/6) [1/s]. The weight is the configured one, or
    the weight of the largest rate that all can follow, if that is larger:

        rate = min(TRACKER_RATE_SHARE * min over joints of (jerk / acceleration),
                   max(TRACKER_RATE_SHARE * tool jerk / tool acceleration,
                       cbrt(STIFFEST_PER_M * tool jerk)),
                   rate_hz / 2)
        jerk_weight = max(configured weight, max(rate, SLOWEST_PER_S)^-6)

    The tracker acts once a tick: it would oscillate at the rate of the loop.
    """
    tool = settings.tool
    own = max(TRACKER_RATE_SHARE * tool.jerk / tool.acceleration, math.cbrt(STIFFEST_PER_M * tool.jerk))
    quickest = min(TRACKER_RATE_SHARE * acceleration_rate(settings.joints), own, 0.5 * settings.rate_hz)
    return tracker_gains(max(tool.jerk_weight, max(quickest, SLOWEST_PER_S) ** -6))


def tracker_gains(jerk_weight: float) -> Vector:
    """Gains k (5,) of the linear-quadratic tracker, rounded to GAIN_DECIMALS.

    On each axis, with x the setpoint, r the target, and z = (r - x, r', r'', x', x''):

        jerk = k · z    minimises    integral of (r - x)² + jerk_weight jerk² dt

    jerk_weight is in s⁶. The target is assumed to move as a hand that reaches, r''' = -k_v r' - k_a
    r'' with the reversions of `motion_model`. The gains solve the continuous algebraic Riccati
    equation, whose dynamics are shifted by -1e-6 /s: the target's motion is not controllable.
    """
    a = np.zeros((5, 5))  # dz/dt = a z + b jerk
    a[0, 1], a[0, 3], a[1, 2], a[2, 1], a[2, 2], a[3, 4] = (
        1.0,
        -1.0,
        1.0,
        -MODE_VELOCITY_REVERSIONS_PER_S2[REACH],
        -MODE_ACCELERATION_REVERSIONS_PER_S[REACH],
        1.0,
    )
    b = np.zeros((5, 1))
    b[4, 0] = 1.0
    cost = np.zeros((5, 5))
    cost[0, 0] = 1.0
    riccati = solve_continuous_are(a - 1e-6 * np.eye(5), b, cost, np.array([[jerk_weight]]))
    return np.ascontiguousarray(np.round(-(b.T @ riccati / jerk_weight)[0], GAIN_DECIMALS))


def waiting(target: Target, setpoint: Vector, tool: Vector) -> Target:
    """Target of a setpoint (3, 3) that is far ahead of its tool (3,) [m], at rest and moved closer.

        share = (GAP_STOPPED_M - gap) / (GAP_STOPPED_M - GAP_WAITING_M), limited to 0 ... 1
        waiting target = setpoint + share (target - setpoint)

    A target in whose direction the setpoint would approach its tool is returned unchanged.
    """
    ahead, to_target = setpoint[0] - tool, target.position - setpoint[0]
    gap = float(np.linalg.norm(ahead))
    if ahead @ to_target <= 0.0:
        return target
    share = min(max((GAP_STOPPED_M - gap) / (GAP_STOPPED_M - GAP_WAITING_M), 0.0), 1.0)
    still = np.zeros(3)
    return Target(setpoint[0] + share * to_target, still, still, clamped=target.clamped)
