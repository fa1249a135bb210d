"""Bounds of the setpoint: the box around the last targets, the accepted step, and the fall-back.

docs/bounds.md proves what these bounds guarantee. Its symbols are used here, on each axis:

    x, v, a   position [m], velocity [m/s] and acceleration [m/s²] of the setpoint
    V         limit of the norm of the velocity: max_speed, or engaging_speed while it engages
    Â, Ĵ      max_acceleration and max_jerk, limits of the norms of acceleration and jerk
    A, J      stop_acceleration and stop_jerk, limits of a stop on each axis
    ρ         0.06 V, speed at which a setpoint beyond a bound returns (return_share)
    π(v, a)   largest displacement [m] along the fastest stop from v, a within A and J
    top       x + π(v, a), the farthest position of the fastest stop
    P         x + π(v + ρ, a), the same for the fastest change to -ρ, in a frame that moves at -ρ
    c         max(|v|, |v + a|a| / 2J|), the largest speed if the acceleration is ended at once
    N         sqrt(sum over the axes of max(c, ρ)²)

For a lower bound, -x, -v and -a replace x, v and a. The module also holds the stopping distance
along the motion and the discrete barrier that limits the tracker's jerk.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.codes import (
    ACCELERATION_BOUND,
    JERK_BOUND,
    NO_BOUND,
    NOT_FINITE_BOUND,
    POSITION_BOUND,
    SPEED_BOUND,
)
from thirdhand.core.frame import Struct, Vector
from thirdhand.core.numerics import ROUNDING, STOP_SECANT_TOLERANCE_M, STOP_SECANTS, TOLERANCE
from thirdhand.core.setpoint import HULL_SPANS
from thirdhand.core.stops import fastest_stop
from thirdhand.core.vectors import distance, norm, square, squared_distance

Pair: TypeAlias = tuple[float, float]


@compiled
def remember(hull: Vector, ticks: int, position: Vector, span_ticks: int) -> int:
    """Add a target (3,) [m] to the smallest and largest targets, `hull` (HULL_SPANS, 2, 3).

    A span holds `span_ticks` targets. When the newest span is full, all spans move on by one, the
    oldest is dropped, and a new one begins. With `ticks` = 0 only the newest span is set.

    Returns the number of targets in the newest span.
    """
    if 0 < ticks < span_ticks:
        for axis in range(3):
            hull[0, 0, axis] = min(hull[0, 0, axis], position[axis])
            hull[0, 1, axis] = max(hull[0, 1, axis], position[axis])
        return ticks + 1
    if ticks > 0:
        for span in range(HULL_SPANS - 1, 0, -1):
            hull[span] = hull[span - 1]
    hull[0, 0] = position
    hull[0, 1] = position
    return 1


@compiled
def bounds(hull: Vector, box: Vector, config: Struct, low: Vector, high: Vector) -> None:
    """Write the setpoint's bounds low and high (3,) [m], from the last targets and the workspace.

        low  = max(box[0], lowest, smallest target - hull_margin_m)
        high = min(box[1],         largest target  + hull_margin_m)

    `hull` (HULL_SPANS, 2, 3): smallest and largest target of each span. `box` (2, 3): lower and
    upper corner of the workspace. `lowest` (3,): planes of the reach, -inf for none.
    """
    for axis in range(3):
        least = hull[0, 0, axis]
        greatest = hull[0, 1, axis]
        for span in range(1, HULL_SPANS):
            least = min(least, hull[span, 0, axis])
            greatest = max(greatest, hull[span, 1, axis])
        low[axis] = max(box[0, axis], config.lowest[axis], least - config.hull_margin_m)
        high[axis] = min(box[1, axis], greatest + config.hull_margin_m)


@compiled
def broken_bound(
    setpoint: Vector, before: Vector, hull: Vector, box: Vector, config: Struct
) -> int:
    """The first SetpointBound that a step from `before` breaks; NO_BOUND if it breaks none.

    The setpoint and `before` are (3, 3): position, velocity, acceleration; by axis. Norms are over
    the axes, and allow for rounding:

        NOT_FINITE    a number is not finite
        SPEED         |v| > max(V, speed_to_come(before))
        ACCELERATION  |a| > max(Â, |a before|)
        JERK          |a - a before| > Ĵ period
        POSITION      the position is beyond `bounds`, and beyond the position before, by more than
                      `longest_stop`, which is more than any stop from outside takes
    """
    max_speed = config.max_speed
    longest_stop = config.longest_stop
    if not np.isfinite(setpoint).all():
        return NOT_FINITE_BOUND
    if (
        norm(setpoint[1])
        > max(max_speed, speed_to_come(before[1], before[2], config.stop_jerk, 0.0)) + 1e-9
    ):
        return SPEED_BOUND
    if norm(setpoint[2]) > max(config.max_acceleration, norm(before[2])) + 1e-9:
        return ACCELERATION_BOUND
    if distance(setpoint[2], before[2]) > (config.max_jerk + 1e-6) * config.period_s:
        return JERK_BOUND
    low = np.empty(3)
    high = np.empty(3)
    bounds(hull, box, config, low, high)
    for i in range(3):
        if setpoint[0, i] < min(low[i], before[0, i]) - longest_stop:
            return POSITION_BOUND
        if setpoint[0, i] > max(high[i], before[0, i]) + longest_stop:
            return POSITION_BOUND
    return NO_BOUND


@compiled
def take_safe(  # noqa: C901, PLR0912 - a case for each bound
    setpoint: Vector,
    ahead: Vector,
    config: Struct,
    costs: Vector,
    slow: float,
    hull: Vector,
    box: Vector,
) -> bool:
    """Move a setpoint (3, 3) to `ahead` (3, 3) if a stop from there keeps every bound.

    The step is accepted if N(ahead) <= V and, on each side of each axis with the bound H of
    `bounds`,

        top(ahead) <= H,    or    top(setpoint) > H  and  P(ahead) <= P(setpoint) - σ ρ dt,

        σ = slow / max(1, max |costs[0]| V)

    where costs (3, 3, J) are those of `joint_costs`, and `slow` is the share of V that the lag of
    the tool leaves. If only the second condition fails on an axis, `_fall_back` replaces the step
    of that axis, provided that the norms of all axes then keep Â and Ĵ. Otherwise all axes take
    `_fall_back` for one period; with ρ = 0 if N(setpoint) > V, so that a setpoint that began too
    fast only brakes.

    Returns False if all axes fell back.
    """
    max_speed = config.max_speed
    max_acceleration = config.stop_acceleration
    max_jerk = config.stop_jerk
    return_speed = config.return_share * max_speed
    max_joint_cost = 0.0
    for i in range(3):
        for joint in range(costs.shape[2]):
            max_joint_cost = max(max_joint_cost, abs(costs[0, i, joint]))
    required_return_m = return_speed * slow / max(1.0, max_joint_cost * max_speed) * config.period_s
    low = np.empty(3)
    high = np.empty(3)
    bounds(hull, box, config, low, high)

    is_kept = True
    is_mixed = False
    for i in range(3):
        for side, bound in ((1.0, high[i]), (-1.0, low[i])):
            if farthest(ahead, i, side, max_acceleration, max_jerk, 0.0) <= side * bound:
                continue
            if (
                farthest(setpoint, i, side, max_acceleration, max_jerk, 0.0)
                <= side * bound + TOLERANCE
            ):
                is_kept = False
                continue
            farthest_m = farthest(setpoint, i, side, max_acceleration, max_jerk, return_speed)
            if (
                farthest(ahead, i, side, max_acceleration, max_jerk, return_speed)
                > farthest_m - required_return_m + ROUNDING
            ):
                _fall_back(setpoint, ahead, config, i, low[i], high[i], return_speed)
                is_mixed = True

    if is_mixed:  # an axis was replaced, so the norms over all axes are checked again
        is_kept = is_kept and square(ahead[2]) <= config.max_acceleration**2
        is_kept = (
            is_kept
            and squared_distance(ahead[2], setpoint[2]) <= (config.max_jerk * config.period_s) ** 2
        )
    if is_kept and speed_to_come(ahead[1], ahead[2], max_jerk, return_speed) <= max_speed:
        setpoint[:] = ahead
        return True

    if speed_to_come(setpoint[1], setpoint[2], max_jerk, return_speed) > max_speed:
        return_speed = 0.0  # following began too fast: all axes brake first
    for i in range(3):
        _fall_back(setpoint, setpoint, config, i, low[i], high[i], return_speed)
    return False


@compiled
def _fall_back(
    setpoint: Vector,
    out: Vector,
    config: Struct,
    axis: int,
    low: float,
    high: float,
    return_speed: float,
) -> None:
    """Write into out (3, 3) one axis one period further along its fastest stop.

    If that stop would end beyond a bound, the axis follows the fastest change to the speed
    `return_speed` [m/s] toward the inside instead. Beyond both bounds, the sign of v decides which
    one counts.
    """
    max_acceleration = config.stop_acceleration
    max_jerk = config.stop_jerk
    dt = config.period_s
    over = farthest(setpoint, axis, 1.0, max_acceleration, max_jerk, 0.0) > high + TOLERANCE
    under = farthest(setpoint, axis, -1.0, max_acceleration, max_jerk, 0.0) > TOLERANCE - low
    if over and under:  # the stop ends beyond both bounds
        over = setpoint[1, axis] > 0.0
        under = not over
    frame = return_speed * (int(under) - int(over))
    stop = np.empty(6)
    fastest_stop(setpoint[1, axis] - frame, setpoint[2, axis], max_acceleration, max_jerk, dt, stop)
    out[0, axis] = setpoint[0, axis] + (stop[2] + frame * dt)
    out[1, axis] = stop[0] + frame
    out[2, axis] = stop[1]


@compiled
def farthest(
    setpoint: Vector,
    axis: int,
    side: float,
    max_acceleration: float,
    max_jerk: float,
    return_speed: float,
) -> float:
    """Farthest position [m] of an axis, toward `side` (1 or -1), along its fastest change of speed.

        side x + π(side v + return_speed, side a)

    With return_speed = 0 this is top, the end of the fastest stop. Otherwise it is P, for the
    fastest change to the velocity -side `return_speed` [m/s], in the frame that moves at it.
    """
    stop = np.empty(6)
    fastest_stop(
        side * setpoint[1, axis] + return_speed,
        side * setpoint[2, axis],
        max_acceleration,
        max_jerk,
        0.0,
        stop,
    )
    return float(side * setpoint[0, axis] + stop[4])


@compiled
def speed_to_come(velocity: Vector, acceleration: Vector, max_jerk: float, least: float) -> float:
    """Largest speed N [m/s] of a setpoint whose accelerations (3,) are brought to 0 at once.

    N = sqrt(sum over the axes of max(|v|, |v + a |a| / (2 max_jerk)|, least)²)
    """
    total = 0.0
    for i in range(3):
        crest = velocity[i] + acceleration[i] * abs(acceleration[i]) / (2.0 * max_jerk)
        total += max(abs(velocity[i]), abs(crest), least) ** 2
    return math.sqrt(total)


@compiled
def stop_distance(speed: float, acceleration: float, brake: float, change: float) -> float:
    """Distance [m] to rest along the motion, with deceleration B = `brake` and jerk C = `change`.

    From speed v and acceleration a >= 0, the acceleration is brought to 0 in t = a / C, at the
    speed v1; then the brake is ramped up and down:

        distance = d1 + d2
        v1 = v + a² / 2C
        d1 = t (v + a t / 3)
        d2 = v1² / 2B + v1 B / 2C                if v1 >= B² / C, so that B is reached
        d2 = v1 sqrt(v1 / C)                     otherwise

    If a < 0, the braking has begun already: it continues as if it had started with acceleration 0,
    a time t = min(-a, B) / C ago. Then v1 = v + C t² / 2, and d1 = -(v1 t - C t³ / 6) is minus the
    distance covered since.
    """
    if acceleration >= 0.0:
        t = acceleration / change
        speed_then = speed + 0.5 * acceleration * t
        length = t * (speed + acceleration * t / 3.0)
    else:  # the braking is treated as begun at acceleration 0
        t = min(-acceleration, brake) / change
        speed_then = speed + 0.5 * change * t * t
        length = -(speed_then * t - change * t * t * t / 6.0)
    if speed_then >= brake * brake / change:
        return (
            length + speed_then * speed_then / (2.0 * brake) + speed_then * brake / (2.0 * change)
        )
    return length + speed_then * math.sqrt(speed_then / change)


@compiled
def _stop_after(v: float, a: float, jerk: float, brakes: Pair, dt: float) -> float:
    """Distance [m] of one period dt at a constant jerk and of the stop after it.

    v dt + stop_distance(max(v + dt (a + dt jerk / 2), 0), a + dt jerk, *brakes)
    """
    return stop_distance(max(v + dt * (a + 0.5 * dt * jerk), 0.0), a + jerk * dt, *brakes) + v * dt


@compiled
def between(
    wanted: float, lowest: float, at_wanted: float, at_lowest: float, limit: float
) -> float:
    """Largest jerk in [lowest, wanted] at which a quantity that is linear in jerk keeps its limit.

    The quantity is `at_wanted` at the jerk `wanted` and `at_lowest` at `lowest`, and grows with
    jerk. Returns `wanted` if the limit holds there, and `lowest` if it holds at neither.
    """
    if at_wanted <= limit:
        return wanted
    if at_lowest >= limit or at_wanted - at_lowest < 1e-15:
        return lowest
    return lowest + (wanted - lowest) * (limit - at_lowest) / (at_wanted - at_lowest)


@compiled
def stopping(
    length: float,
    growth: float,
    v: float,
    a: float,
    brakes: Pair,
    jerks: Pair,
    retained: float,
    dt: float,
) -> float:
    """Largest jerk [m/s³] in [lowest, wanted] at which a discrete barrier keeps a distance h.

    `jerks` are (wanted, lowest). With d the `stop_distance` by `brakes` (m/s², m/s³) before and d'
    after one period at this jerk:

        h  = length - d                        left at the end of a stop [m]
        h' = length + growth - v dt - d'       the same, one period later
        h' >= retained h

    `growth` [m] is how much the length grows by itself in a period. A secant method finds the
    jerk, to STOP_SECANT_TOLERANCE_M of h'.
    """
    brake, change = brakes
    top_jerk, chosen = jerks
    limit = length + growth - retained * (length - stop_distance(v, a, brake, change))
    most = _stop_after(v, a, top_jerk, brakes, dt)
    passed = _stop_after(v, a, chosen, brakes, dt)
    for _ in range(STOP_SECANTS):
        chosen = between(top_jerk, chosen, most, passed, limit)
        if chosen >= top_jerk:
            break
        passed = _stop_after(v, a, chosen, brakes, dt)
        if limit - passed < STOP_SECANT_TOLERANCE_M:
            break
    return chosen
