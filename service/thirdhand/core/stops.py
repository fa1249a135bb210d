"""Fastest stops: of one axis, and of several axes that come to rest at the same time."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Vector

# an axis that waits for the slowest one brakes with at least this share of its limit
LEAST_BRAKE_SHARE = 1e-3
BRAKE_SHARE_HALVINGS = 40  # bisection steps for the share of an axis


@compiled
def fastest_stop(  # noqa: C901, PLR0912, PLR0915 - a case for each phase
    velocity: float,
    acceleration: float,
    max_acceleration: float,
    max_jerk: float,
    dt: float,
    out: Vector,
) -> None:
    """Compute the time-optimal change of one axis to rest: velocity 0 and acceleration 0.

    The limits are A = `max_acceleration` and J = `max_jerk`. If the acceleration a were brought to
    0 at once, the velocity would be v + a |a| / 2J. The stop accelerates against the sign of this
    value. With v and a taken positive in the direction of that acceleration, it has three phases:

        1  jerk J from a to p               p = min(sqrt(a² / 2 - J v), A), at least a
        2  constant acceleration p          for (-v + (a² - 2 A²) / 2J) / A, if p = A; else none
        3  jerk -J from p to 0              for p / J

    If a > A, phase 1 has the jerk -J from a to A, and phase 2 lasts (-v - a² / 2J) / A.

    out (6,): velocity, acceleration and displacement after dt; smallest and largest displacement
    until rest, with 0 among them; duration [s].
    """
    crest = velocity + acceleration * abs(acceleration) / (2.0 * max_jerk)
    sign = -1.0 if crest > 0.0 else 1.0  # in this direction the stop accelerates
    v = sign * velocity
    a = sign * acceleration
    peak = math.sqrt(max(0.5 * a * a - max_jerk * v, 0.0))
    hold = 0.0
    if a > max_acceleration:  # an acceleration beyond the limit is first reduced to it
        peak = max_acceleration
        hold = max(-v - a * a / (2.0 * max_jerk), 0.0) / max_acceleration
    elif peak > max_acceleration:
        peak = max_acceleration
        hold = (
            -v + (a * a - 2.0 * max_acceleration * max_acceleration) / (2.0 * max_jerk)
        ) / max_acceleration
    else:
        peak = max(peak, a)

    # follow the three phases: sample at dt, and note the extreme displacements
    x = t = low = high = 0.0
    is_sampled = False
    after_x = after_v = after_a = 0.0
    for phase in range(3):
        if phase == 0:
            jerk, lasts = (
                (max_jerk, (peak - a) / max_jerk)
                if a <= peak
                else (-max_jerk, (a - peak) / max_jerk)
            )
        elif phase == 1:
            jerk = 0.0
            lasts = hold
        else:
            jerk = -max_jerk
            lasts = peak / max_jerk
        if lasts <= 0.0:
            continue

        if not is_sampled and dt <= t + lasts:
            h = dt - t
            after_x = x + h * (v + h * (a / 2.0 + h * jerk / 6.0))
            after_v = v + h * (a + h * jerk / 2.0)
            after_a = a + h * jerk
            is_sampled = True

        # the displacement is extreme where the velocity is 0, or at an end of the phase
        disc = a * a - 2.0 * jerk * v
        for root in (-1.0, 1.0):
            h = 0.0
            if jerk != 0.0 and disc >= 0.0:
                h = (-a + root * math.sqrt(disc)) / jerk
            elif jerk == 0.0 and a != 0.0:
                h = -v / a
            if 0.0 < h < lasts:
                displacement = x + h * (v + h * (a / 2.0 + h * jerk / 6.0))
                low = min(low, displacement)
                high = max(high, displacement)

        x += lasts * (v + lasts * (a / 2.0 + lasts * jerk / 6.0))
        v += lasts * (a + lasts * jerk / 2.0)
        a += lasts * jerk
        t += lasts
        low = min(low, x)
        high = max(high, x)

    if not is_sampled:
        after_x = x
        after_v = 0.0
        after_a = 0.0
    out[0] = sign * after_v
    out[1] = sign * after_a
    out[2] = sign * after_x
    out[3], out[4] = (low, high) if sign > 0.0 else (-high, -low)
    out[5] = t


@compiled
def stop_together(
    velocities: Vector, accelerations: Vector, max_acceleration: Vector, max_jerk: Vector, dt: float
) -> Vector:
    """One period dt of a stop at whose end all axes (J,) come to rest at the same time.

    Returns (3, J): displacements, velocities, accelerations. The stop lasts as long as the fastest
    stop of the slowest axis. The other axes brake less than they could (`braking_together`), so
    that the tool they move slows down along its path.
    """
    count = len(velocities)
    out = np.zeros((3, count))
    stop = np.zeros(6)
    slower = np.empty(count)
    braking_together(velocities, accelerations, max_acceleration, max_jerk, slower)
    for i in range(count):
        fastest_stop(velocities[i], accelerations[i], slower[i], max_jerk[i], dt, stop)
        out[0, i] = stop[2]
        out[1, i] = stop[0]
        out[2, i] = stop[1]
    return out


@compiled
def braking_together(
    velocities: Vector,
    accelerations: Vector,
    max_acceleration: Vector,
    max_jerk: Vector,
    out: Vector,
) -> None:
    """Write into out (J,) the deceleration limits with which all axes stop at the same time.

        out_j = share_j max_acceleration_j

    share_j is the smallest share, found by bisection, with which the stop of axis j lasts no longer
    than the longest of the fastest stops. Axes at rest keep their full limit.
    """
    stop = np.zeros(6)
    duration = 0.0
    for i in range(len(velocities)):
        fastest_stop(velocities[i], accelerations[i], max_acceleration[i], max_jerk[i], 0.0, stop)
        duration = max(duration, stop[5])
    for i in range(len(velocities)):
        low = LEAST_BRAKE_SHARE
        share = 1.0
        if velocities[i] != 0.0 or accelerations[i] != 0.0:
            for _ in range(BRAKE_SHARE_HALVINGS):
                middle = 0.5 * (low + share)
                fastest_stop(
                    velocities[i],
                    accelerations[i],
                    middle * max_acceleration[i],
                    max_jerk[i],
                    0.0,
                    stop,
                )
                if stop[5] <= duration:
                    share = middle
                else:
                    low = middle
        out[i] = share * max_acceleration[i]
