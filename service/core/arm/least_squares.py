"""Damped least squares within bounds and under linear inequalities, compiled: active-set methods of
bounded length, whose answer keeps bounds and limits whatever happens.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.arm.tuning import (
    BOUND_ROUNDS,
    CONSTRAINT_ROUNDS,
    LEAST_BOUND_GAIN,
    LEAST_EXCESS,
    LEAST_FORCE,
    LEAST_PIVOT,
    LEAST_SLOPE,
)
from service.core.frame import Vector


@compiled
def factorise(tasks: Vector, damping: float, root: Vector) -> None:
    """The lower Cholesky factor of tasks tasks^T + damping I, (N, N) for tasks (N, J)."""
    for i in range(tasks.shape[0]):
        for j in range(i + 1):
            total = damping if i == j else 0.0
            for k in range(tasks.shape[1]):
                total += tasks[i, k] * tasks[j, k]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(max(total, LEAST_PIVOT)) if i == j else total / root[j, j]


@compiled
def substitute(root: Vector, right: Vector) -> None:
    """Solves the equations of a Cholesky factor, in place."""
    size = len(right)
    for i in range(size):
        for k in range(i):
            right[i] -= root[i, k] * right[k]
        right[i] /= root[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= root[k, i] * right[k]
        right[i] /= root[i, i]


@compiled
def solve(
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    bounds: Vector,
    rows: Vector,
    limits: Vector,
    x: Vector,
) -> bool:
    """Into x (J,) the solution of `least_squares`, brought under rows (K, J) x <= limits (K,);
    whether it was not there.
    """
    least_squares(tasks, wanted, posture, damping, bounds, x)
    return keep_under(tasks, wanted, posture, damping, bounds, rows, limits, x)


@compiled
def least_squares(
    tasks: Vector, wanted: Vector, posture: Vector, damping: float, bounds: Vector, result: Vector
) -> None:
    """Into result the x (J,) in bounds (2, J) with least |tasks x - wanted|² + damping |x -
    posture|², by an active-set method.
    """
    joints, count = len(posture), len(wanted)
    free, best = np.ones(joints), np.empty(joints)
    _solve(tasks, wanted, posture, damping, free, posture, result)
    inside = True
    for j in range(joints):
        if not bounds[0, j] <= result[j] <= bounds[1, j]:
            inside, free[j] = False, 0.0
            result[j] = min(max(result[j], bounds[0, j]), bounds[1, j])
    if inside:
        return
    rest = np.empty(count)
    for _ in range(BOUND_ROUNDS):
        _solve(tasks, wanted, posture, damping, free, result, best)
        blocked, least = -1, 1.0
        for j in range(joints):
            step = best[j] - result[j]
            if step != 0.0:
                fraction = ((bounds[1, j] if step > 0.0 else bounds[0, j]) - result[j]) / step
                if fraction < least:
                    blocked, least = j, fraction
        for j in range(joints):
            result[j] += least * (best[j] - result[j])
        if blocked >= 0:
            for j in range(joints):
                result[j] = min(max(result[j], bounds[0, j]), bounds[1, j])
            free[blocked] = 0.0
            continue
        result[:] = best
        for i in range(count):
            rest[i] = -wanted[i]
            for j in range(joints):
                rest[i] += tasks[i, j] * result[j]
        leaving, most = -1, LEAST_BOUND_GAIN  # the bound whose inside is better by most
        for j in range(joints):
            if free[j] > 0.0 or bounds[1, j] <= bounds[0, j]:
                continue
            slope = damping * (result[j] - posture[j])
            for i in range(count):
                slope += tasks[i, j] * rest[i]
            gained = slope if result[j] >= bounds[1, j] else -slope
            if gained > most:
                leaving, most = j, gained
        if leaving < 0:
            return
        free[leaving] = 1.0


@compiled
def _solve(
    tasks: Vector, wanted: Vector, posture: Vector, damping: float, free: Vector, held: Vector, out: Vector
) -> None:
    """The best x (J,) whose joints that are not free (0) stay as held, by the dual of as
    many equations as there are tasks.
    """
    joints, count = len(posture), len(wanted)
    part, root, right = np.empty((count, joints)), np.empty((count, count)), np.empty(count)
    for i in range(count):
        right[i] = wanted[i]
        for j in range(joints):
            part[i, j] = tasks[i, j] * free[j]
            right[i] -= tasks[i, j] * (posture[j] if free[j] > 0.0 else held[j])
    factorise(part, damping, root)
    substitute(root, right)
    for j in range(joints):
        out[j] = posture[j] if free[j] > 0.0 else held[j]
        for i in range(count):
            out[j] += part[i, j] * right[i]


@compiled
def keep_under(
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    bounds: Vector,
    rows: Vector,
    limits: Vector,
    x: Vector,
) -> bool:
    """Brings the solution x (J,) of `least_squares` under rows (K, J) x <= limits (K,); whether it
    was not there.

    Bounds hold 0. Limits below 0, of what is to be left, are for where all can be kept: else they
    are taken to be 0. Were the method to end early even so, as its rounds are bounded, the joints
    are slowed down together until they keep them all.
    """
    if _farthest(bounds, rows, limits, x, LEAST_EXCESS) < 0:
        return False
    _solve_under(tasks, wanted, posture, damping, bounds, rows, limits, x)
    if len(limits) and limits.min() < 0.0 and _farthest(bounds, rows, limits, x, LEAST_EXCESS) >= 0:
        least = np.maximum(limits, 0.0)
        _solve_under(tasks, wanted, posture, damping, bounds, rows, least, x)
    share = _share_within(bounds, rows, limits, x)
    for j in range(len(x)):
        x[j] = min(max(share * x[j], bounds[0, j]), bounds[1, j])
    return True


@compiled
def _solve_under(
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    bounds: Vector,
    rows: Vector,
    limits: Vector,
    x: Vector,
) -> None:
    """`keep_under` by the dual active-set method of Goldfarb and Idnani (Mathematical Programming
    27, 1983), with the bounds as further rows; as far as it comes where not all can be kept.
    """
    joints = len(x)
    turned, root = np.empty((joints, len(wanted))), np.empty((joints, joints))
    for j in range(joints):
        x[j] = damping * posture[j]
        for i in range(len(wanted)):
            turned[j, i] = tasks[i, j]
            x[j] += tasks[i, j] * wanted[i]
    factorise(turned, damping, root)
    substitute(root, x)
    # of those that are met: which, their normals, these by the inverse of the squares, their forces
    met, size, force = np.empty(joints, np.int64), 0, np.zeros(joints)
    normals, moved = np.zeros((joints, joints)), np.zeros((joints, joints))
    normal, way, yielding = np.empty(joints), np.empty(joints), np.empty(joints)
    entering, pushed = -1, 0.0
    for _ in range(CONSTRAINT_ROUNDS):
        if entering < 0:
            entering, pushed = _farthest(bounds, rows, limits, x, 0.1 * LEAST_EXCESS), 0.0
            if entering < 0:
                break
        limit = _constraint(entering, bounds, rows, limits, normal)
        way[:] = normal
        substitute(root, way)
        _yield_to(way, normals, moved, size, yielding)
        beyond, slope, leaving, step = -limit, 0.0, -1, math.inf
        for j in range(joints):
            for k in range(size):
                way[j] -= yielding[k] * moved[k, j]
            beyond += normal[j] * x[j]
            slope += normal[j] * way[j]
        for k in range(size):
            if yielding[k] > LEAST_FORCE and force[k] < step * yielding[k]:
                leaving, step = k, force[k] / yielding[k]
        if slope > LEAST_SLOPE and size < joints and beyond <= step * slope:
            leaving, step = -1, beyond / slope
        elif leaving < 0:
            break  # by rounding, or as not all can be kept
        if slope > LEAST_SLOPE:
            for j in range(joints):
                x[j] -= step * way[j]
        pushed += step
        for k in range(size):
            force[k] -= step * yielding[k]
        if leaving < 0:
            met[size], normals[size], force[size] = entering, normal, pushed
            moved[size] = normal
            substitute(root, moved[size])
            size, entering = size + 1, -1
        else:
            size -= 1
            for k in range(leaving, size):
                met[k], force[k], normals[k], moved[k] = met[k + 1], force[k + 1], normals[k + 1], moved[k + 1]


@compiled
def _share_within(bounds: Vector, rows: Vector, limits: Vector, x: Vector) -> float:
    """How much of x (J,) keeps bounds and limits, those below 0 taken to be 0."""
    share = 1.0
    for j in range(len(x)):
        bound = bounds[1, j] if x[j] > 0.0 else bounds[0, j]
        if abs(x[j]) > abs(bound) + LEAST_EXCESS:
            share = min(share, bound / x[j])
    for k in range(len(limits)):
        along = 0.0
        for j in range(len(x)):
            along += rows[k, j] * x[j]
        limit = max(limits[k], 0.0)
        if along > limit + LEAST_EXCESS:
            share = min(share, limit / along)
    return share


@compiled
def _farthest(bounds: Vector, rows: Vector, limits: Vector, x: Vector, least: float) -> int:
    """The number of the constraint that x (J,) passes by most, -1 if none by more than `least`:
    upper bounds first, then lower ones, then rows.
    """
    joints, found, most = len(x), -1, least
    for j in range(joints):
        if x[j] - bounds[1, j] > most:
            found, most = j, x[j] - bounds[1, j]
        if bounds[0, j] - x[j] > most:
            found, most = joints + j, bounds[0, j] - x[j]
    for k in range(len(limits)):
        beyond = -limits[k]
        for j in range(joints):
            beyond += rows[k, j] * x[j]
        if beyond > most:
            found, most = 2 * joints + k, beyond
    return found


@compiled
def _constraint(number: int, bounds: Vector, rows: Vector, limits: Vector, normal: Vector) -> float:
    """The limit of a constraint, by the number that `_farthest` gives it; into normal (J,) what of
    x stays under it.
    """
    joints = len(normal)
    if number >= 2 * joints:
        normal[:] = rows[number - 2 * joints]
        return float(limits[number - 2 * joints])
    normal[:] = 0.0
    if number >= joints:
        normal[number - joints] = -1.0
        return -float(bounds[0, number - joints])
    normal[number] = 1.0
    return float(bounds[1, number])


@compiled
def _yield_to(way: Vector, normals: Vector, moved: Vector, size: int, out: Vector) -> None:
    """Into out how the forces of those that are met change along a way (J,) that they hold back."""
    root = np.empty((size, size))
    right = np.empty(size)
    for a in range(size):
        right[a] = 0.0
        for j in range(len(way)):
            right[a] += normals[a, j] * way[j]
        for b in range(a + 1):
            total = 0.0
            for j in range(len(way)):
                total += normals[a, j] * moved[b, j]
            for k in range(b):
                total -= root[a, k] * root[b, k]
            root[a, b] = math.sqrt(max(total, LEAST_PIVOT)) if a == b else total / root[b, b]
    substitute(root, right)
    for a in range(size):
        out[a] = right[a]
