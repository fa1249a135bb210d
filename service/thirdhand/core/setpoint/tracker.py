"""Gains of the setpoint's tracker, and the target of a setpoint that waits for its tool."""

from __future__ import annotations

import math

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.core.intake.motion_model import REACH
from thirdhand.core.intake.tuning import IntakeTuning
from thirdhand.core.joint_limits import acceleration_rate
from thirdhand.core.numerics import GAIN_DECIMALS, SLOWEST_PER_S
from thirdhand.core.skill.model import Target
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.vectors import dot, norm
from thirdhand.settings.config import Settings


def gains_for(settings: Settings, tuning: Tuning = TUNING) -> Vector:
    """Gains (5,) of `tracker_gains` for the settings, slow enough for tool, joints and loop.

    With jerk_weight w the tracker's rate is w^(-1/6) [1/s]. The weight is jerk_weight, or the
    weight of the largest rate that all can follow, if that is larger:

        rate = min(tracker_rate_share * min over joints of (jerk / acceleration),
                   max(tracker_rate_share * tool jerk / tool acceleration,
                       cbrt(stiffest_per_m * tool jerk)),
                   rate_hz / 2)
        jerk_weight = max(jerk_weight, max(rate, SLOWEST_PER_S)^-6)

    The tracker acts once a tick: it would oscillate at the rate of the loop.
    """
    tool = settings.tool
    numbers = tuning.setpoint
    # [1/m] jerk gain / max_jerk of a tool with little jerk
    stiffest_per_m = 3.0 / numbers.hull_margin_m
    tool_rate = max(
        numbers.tracker_rate_share * tool.jerk / tool.acceleration,
        math.cbrt(stiffest_per_m * tool.jerk),
    )
    quickest = min(
        numbers.tracker_rate_share * acceleration_rate(settings.joints),
        tool_rate,
        0.5 * settings.rate_hz,
    )
    return tracker_gains(
        max(numbers.jerk_weight, max(quickest, SLOWEST_PER_S) ** -6), tuning.intake
    )


def tracker_gains(jerk_weight: float, hands: IntakeTuning = TUNING.intake) -> Vector:
    """Gains k (5,) of the linear-quadratic tracker, rounded to GAIN_DECIMALS.

    On each axis, with x the setpoint, p the target, and z = (p - x, p', p'', x', x''):

        jerk = k · z    minimises    integral of (p - x)² + jerk_weight jerk² dt

    jerk_weight is in s⁶. The target is assumed to move as a hand that reaches, p''' = -k_v p' - k_a
    p'' with the reversions of `motion_model`. With the rate r = jerk_weight^(-1/6) [1/s] and
    F = [[0, 1], [-k_v, -k_a]] for the motion of the target:

        gains on (p - x, x', x'')  =  r³, -2 r², -2 r
        gains on (p', p'')         =  r³ [1 0] (F² - 2 r F + 2 r²) (r³ - 2 r² F + 2 r F² - F³)^-1

    The second line solves the Sylvester equation that couples the target to the setpoint in the
    algebraic Riccati equation. By F² = -k_a F - k_v its inverted factor is m_0 + m_1 F.
    """
    rate = jerk_weight ** (-1.0 / 6.0)
    k_v = hands.mode_velocity_reversions_per_s2[REACH]
    k_a = hands.mode_acceleration_reversions_per_s[REACH]
    m_0 = rate**3 - 2.0 * rate * k_v - k_a * k_v
    m_1 = k_v - 2.0 * rate**2 - 2.0 * rate * k_a - k_a**2
    determinant = m_0 * (m_0 - k_a * m_1) + k_v * m_1**2
    row = 2.0 * rate**2 - k_v, -2.0 * rate - k_a  # [1 0] (F² - 2 r F + 2 r²)
    on_velocity = (row[0] * (m_0 - k_a * m_1) + row[1] * k_v * m_1) / determinant
    on_acceleration = (row[1] * m_0 - row[0] * m_1) / determinant
    gains = rate**3, rate**3 * on_velocity, rate**3 * on_acceleration, -2.0 * rate**2, -2.0 * rate
    return np.round(gains, GAIN_DECIMALS)


def waiting(target: Target, setpoint: Vector, tool: Vector, gaps_m: tuple[float, float]) -> Target:
    """Target of a setpoint (3, 3) that is far ahead of its tool (3,) [m], at rest and moved closer.

        share = (gap_stopped_m - gap) / (gap_stopped_m - gap_waiting_m), limited to 0 ... 1
        waiting target = setpoint + share (target - setpoint)

    `gaps_m` are gap_waiting_m and gap_stopped_m. A target in whose direction the setpoint would
    approach its tool is returned unchanged.
    """
    gap_waiting_m, gap_stopped_m = gaps_m
    ahead = setpoint[0] - tool
    to_target = target.position - setpoint[0]
    gap = norm(ahead)
    if dot(ahead, to_target) <= 0.0:
        return target
    share = min(max((gap_stopped_m - gap) / (gap_stopped_m - gap_waiting_m), 0.0), 1.0)
    still = np.zeros(3)
    return Target(setpoint[0] + share * to_target, still, still, clamped=target.clamped)
