"""Where a setpoint may go and how fast: the box around the last targets, the step that can still
stop in it, and what comes back to it; docs/bounds.md has the proof. And the stops themselves, of
one axis or of several that come to rest together, and the jerk after which one keeps its room.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Records, Vector
from service.core.setpoint import HULL_SPANS
from service.core.setpoint.tuning import (
    BOUND_ROUNDING_M,
    HULL_MARGIN_M,
    ON_BOUND_M,
    RETURN_SHARE,
    STOP_SECANT_TOLERANCE_M,
    STOP_SECANTS,
)
from service.core.stops import fastest_stop

Pair: TypeAlias = tuple[float, float]
BOUNDS = ("", "not finite", "speed", "acceleration", "jerk", "position")


@compiled
def remember(hull: Vector, ticks: int, position: Vector, span_ticks: int) -> int:
    """Takes a target (3,) into the least and greatest of its span; ticks in the newest span."""
    if ticks >= span_ticks or ticks == 0:
        if ticks > 0:
            for span in range(HULL_SPANS - 1, 0, -1):
                for axis in range(3):
                    hull[span, 0, axis], hull[span, 1, axis] = hull[span - 1, 0, axis], hull[span - 1, 1, axis]
        for axis in range(3):
            hull[0, 0, axis] = hull[0, 1, axis] = position[axis]
        return 1
    for axis in range(3):
        hull[0, 0, axis] = min(hull[0, 0, axis], position[axis])
        hull[0, 1, axis] = max(hull[0, 1, axis], position[axis])
    return ticks + 1


@compiled
def bounds_around(
    hull: Vector, ticks: int, position: Vector, parameters: Records, box: Vector, low: Vector, high: Vector
) -> int:
    """As `bounds`, with one more target (3,), see `remember`; ticks in the newest span."""
    ticks = remember(hull, ticks, position, parameters[0].span_ticks)
    bounds(hull, box, parameters[0].lowest, low, high)
    return ticks


@compiled
def bounds(hull: Vector, box: Vector, lowest: Vector, low: Vector, high: Vector) -> None:
    """Where the setpoint may go: around the last targets, and inside the workspace."""
    for axis in range(3):
        least, greatest = hull[0, 0, axis], hull[0, 1, axis]
        for span in range(1, HULL_SPANS):
            least, greatest = min(least, hull[span, 0, axis]), max(greatest, hull[span, 1, axis])
        low[axis] = max(box[0, axis], lowest[axis], least - HULL_MARGIN_M)
        high[axis] = min(box[1, axis], greatest + HULL_MARGIN_M)


@compiled
def what_is_wrong(setpoint: Vector, before: Vector, hull: Vector, box: Vector, parameters: Records) -> int:
    """Which of BOUNDS a step from `before` (3, 3) breaks."""
    given = parameters[0]
    max_speed = given.max_speed
    if not np.isfinite(setpoint).all():
        return 1
    speed = now = earlier = change = 0.0
    for i in range(3):
        speed += setpoint[1, i] ** 2
        now, earlier = now + setpoint[2, i] ** 2, earlier + before[2, i] ** 2
        change += (setpoint[2, i] - before[2, i]) ** 2
    if math.sqrt(speed) > max(max_speed, speed_to_come(before[1], before[2], given.stop_jerk, 0.0)) + 1e-9:
        return 2
    if math.sqrt(now) > max(given.max_acceleration, math.sqrt(earlier)) + 1e-9:
        return 3
    if math.sqrt(change) > (given.max_jerk + 1e-6) * given.period_s:
        return 4
    low, high = np.empty(3), np.empty(3)
    bounds(hull, box, given.lowest, low, high)
    farthest = 0.5 * max_speed * max_speed / given.stop_acceleration + max_speed  # of a stop from outside, generously
    for i in range(3):
        if setpoint[0, i] < min(low[i], before[0, i]) - farthest:
            return 5
        if setpoint[0, i] > max(high[i], before[0, i]) + farthest:
            return 5
    return 0


@compiled
def take_safe(
    setpoint: Vector, ahead: Vector, parameters: Records, costs: Vector, slow: float, low: Vector, high: Vector
) -> bool:
    """Moves a setpoint (3, 3) to `ahead` if it keeps every bound after that; else one period on its
    fastest stop, and false. An axis that would not come back does so.
    """
    given = parameters[0]
    max_speed, max_acceleration, max_jerk = given.max_speed, given.stop_acceleration, given.stop_jerk
    back = RETURN_SHARE * max_speed
    dearest = 0.0
    for i in range(3):
        for joint in range(costs.shape[2]):
            dearest = max(dearest, abs(costs[0, i, joint]))
    due = back * slow / max(1.0, dearest * max_speed) * given.period_s
    stays, mixed = True, False
    for i in range(3):
        for side, bound in ((1.0, high[i]), (-1.0, low[i])):
            if farthest(ahead, i, side, max_acceleration, max_jerk, 0.0) <= side * bound:
                continue
            if farthest(setpoint, i, side, max_acceleration, max_jerk, 0.0) <= side * bound + ON_BOUND_M:
                stays = False
                continue
            here = farthest(setpoint, i, side, max_acceleration, max_jerk, back)
            if farthest(ahead, i, side, max_acceleration, max_jerk, back) > here - due + BOUND_ROUNDING_M:
                _fall_back(setpoint, ahead, parameters, i, low[i], high[i], back)
                mixed = True
    if mixed:  # the norms of what the others do beside it
        acceleration = change = 0.0
        for i in range(3):
            acceleration += ahead[2, i] ** 2
            change += (ahead[2, i] - setpoint[2, i]) ** 2
        stays = stays and acceleration <= given.max_acceleration**2
        stays = stays and change <= (given.max_jerk * given.period_s) ** 2
    if stays and speed_to_come(ahead[1], ahead[2], max_jerk, back) <= max_speed:
        setpoint[:] = ahead
        return True
    if speed_to_come(setpoint[1], setpoint[2], max_jerk, back) > max_speed:
        back = 0.0  # it began too fast: no axis moves on before that is over
    for i in range(3):
        _fall_back(setpoint, setpoint, parameters, i, low[i], high[i], back)
    return False


@compiled
def _fall_back(
    setpoint: Vector, out: Vector, parameters: Records, axis: int, low: float, high: float, back: float
) -> None:
    """Into out (3, 3) one axis a period on along its fastest stop; or, where that ends beyond a
    bound, along the fastest change to `back` [m/s] inwards.
    """
    max_acceleration, max_jerk, dt = parameters[0].stop_acceleration, parameters[0].stop_jerk, parameters[0].period_s
    over = farthest(setpoint, axis, 1.0, max_acceleration, max_jerk, 0.0) > high + ON_BOUND_M
    under = farthest(setpoint, axis, -1.0, max_acceleration, max_jerk, 0.0) > ON_BOUND_M - low
    if over and under:  # it crosses the box
        over = setpoint[1, axis] > 0.0
        under = not over
    frame, stop = back * (under - over), np.empty(6)
    fastest_stop(setpoint[1, axis] - frame, setpoint[2, axis], max_acceleration, max_jerk, dt, stop)
    out[0, axis] = setpoint[0, axis] + (stop[2] + frame * dt)
    out[1, axis], out[2, axis] = stop[0] + frame, stop[1]


@compiled
def farthest(setpoint: Vector, axis: int, side: float, max_acceleration: float, max_jerk: float, back: float) -> float:
    """How far [m] an axis of a setpoint (3, 3) comes in direction `side` (1 or -1) on its fastest
    change to `back` [m/s] against it, seen from what moves at that; 0: on its fastest stop.
    """
    stop = np.empty(6)
    fastest_stop(side * setpoint[1, axis] + back, side * setpoint[2, axis], max_acceleration, max_jerk, 0.0, stop)
    return float(side * setpoint[0, axis] + stop[4])


@compiled
def speed_to_come(velocity: Vector, acceleration: Vector, max_jerk: float, least: float) -> float:
    """Norm [m/s] of the axes' greatest speeds, each `least` or more, if each acceleration is
    brought to 0 at once.
    """
    total = 0.0
    for i in range(3):
        then = velocity[i] + acceleration[i] * abs(acceleration[i]) / (2.0 * max_jerk)
        total += max(abs(velocity[i]), abs(then), least) ** 2
    return math.sqrt(total)


@compiled
def stop_distance(speed: float, acceleration: float, brake: float, change: float) -> float:
    """Way [m] to rest along the motion, braking by `brake` [m/s²] after ramps of jerk `change`
    [m/s³].
    """
    if acceleration >= 0.0:
        t = acceleration / change
        speed_then = speed + 0.5 * acceleration * t
        way = t * (speed + acceleration * t / 3.0)
    else:  # as if the braking had begun from the crest before
        t = min(-acceleration, brake) / change
        speed_then = speed + 0.5 * change * t * t
        way = -(speed_then * t - change * t * t * t / 6.0)
    if speed_then >= brake * brake / change:
        return way + speed_then * speed_then / (2.0 * brake) + speed_then * brake / (2.0 * change)
    return way + speed_then * math.sqrt(speed_then / change)


@compiled
def _stop_after(v: float, a: float, jerk: float, brakes: Pair, dt: float) -> float:
    """The way [m] of a period at a jerk [m/s³] and of the stop by such brakes after it."""
    return stop_distance(max(v + dt * (a + 0.5 * dt * jerk), 0.0), a + jerk * dt, *brakes) + v * dt


@compiled
def between(wanted: float, lowest: float, at_wanted: float, at_lowest: float, limit: float) -> float:
    """The greatest jerk up to the wanted one at which something, linear in jerk, stays at its
    limit.
    """
    if at_wanted <= limit:
        return wanted
    if at_lowest >= limit or at_wanted - at_lowest < 1e-15:
        return lowest
    return lowest + (wanted - lowest) * (limit - at_lowest) / (at_wanted - at_lowest)


@compiled
def stopping(way: float, comes: float, v: float, a: float, brakes: Pair, jerks: Pair, kept: float, dt: float) -> float:
    """The greatest jerk, from the wanted to the lowest of `jerks`, after which a stop by `brakes`
    [m/s², m/s³] is `kept` this share of its room, on a way [m] that grows by what `comes`.
    """
    (brake, change), (wanted, chosen) = brakes, jerks
    limit = way + comes - kept * (way - stop_distance(v, a, brake, change))
    most, passed = _stop_after(v, a, wanted, brakes, dt), _stop_after(v, a, chosen, brakes, dt)
    for _ in range(STOP_SECANTS):
        chosen = between(wanted, chosen, most, passed, limit)
        if chosen >= wanted:
            break
        passed = _stop_after(v, a, chosen, brakes, dt)
        if limit - passed < STOP_SECANT_TOLERANCE_M:
            break
    return chosen
