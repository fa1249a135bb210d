"""Compiled damped least squares with bounds and linear inequalities, by active-set methods.

The variable is x (J,). With tasks (N, J), wanted (N,), posture (J,) and damping > 0, the cost is

    |tasks x - wanted|² + damping |x - posture|²

subject to bounds[0] <= x <= bounds[1] and rows (K, J) x <= limits (K,). The problem is strictly
convex. The number of rounds is bounded; the result keeps bounds and non-negative limits even if a
method ends early.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Vector
from thirdhand.core.numerics import (
    BOUND_ROUNDS,
    CONSTRAINT_ROUNDS,
    LEAST_SLOPE,
    ROUNDING,
    TOLERANCE,
)


@compiled
def factorise(tasks: Vector, damping: float, root: Vector) -> None:
    """Write the lower Cholesky factor (N, N) of tasks tasks^T + damping I, for tasks (N, J)."""
    for i in range(tasks.shape[0]):
        for j in range(i + 1):
            total = damping if i == j else 0.0
            for k in range(tasks.shape[1]):
                total += tasks[i, k] * tasks[j, k]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(max(total, ROUNDING)) if i == j else total / root[j, j]


@compiled
def substitute(root: Vector, right: Vector) -> None:
    """Solve root root^T y = right, with y in place of `right`."""
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
    """Write into x (J,) the solution under bounds and rows (K, J) x <= limits (K,).

    Returns True if a row changed the solution of `least_squares`.
    """
    least_squares(tasks, wanted, posture, damping, bounds, x)
    return keep_under(tasks, wanted, posture, damping, bounds, rows, limits, x)


@compiled
def least_squares(
    tasks: Vector, wanted: Vector, posture: Vector, damping: float, bounds: Vector, result: Vector
) -> None:
    """Write into `result` (J,) the minimum of the cost within bounds (2, J), without rows.

    A primal active-set method: joints that would leave their bounds are held there; a held joint is
    released if the cost falls toward the inside.
    """
    joints = len(posture)
    free = np.ones(joints)
    best = np.empty(joints)
    _solve(tasks, wanted, posture, damping, free, posture, result)
    is_inside = True
    for j in range(joints):
        if not bounds[0, j] <= result[j] <= bounds[1, j]:
            is_inside = False
            free[j] = 0.0
            result[j] = min(max(result[j], bounds[0, j]), bounds[1, j])
    if is_inside:
        return
    for _ in range(BOUND_ROUNDS):
        _solve(tasks, wanted, posture, damping, free, result, best)
        blocked = _move_within(bounds, best, result)
        if blocked >= 0:
            free[blocked] = 0.0
            continue
        released = _steepest(tasks, wanted, posture, damping, bounds, free, result)
        if released < 0:
            return
        free[released] = 1.0


@compiled
def _move_within(bounds: Vector, best: Vector, result: Vector) -> int:
    """Move `result` (J,) toward `best` (J,), as far as the bounds (2, J) allow. Returns the joint
    that meets its bound first, or -1 if `best` is reached.
    """
    blocked = -1
    share = 1.0
    for j in range(len(result)):
        step = best[j] - result[j]
        if step != 0.0:
            fraction = ((bounds[1, j] if step > 0.0 else bounds[0, j]) - result[j]) / step
            if fraction < share:
                blocked = j
                share = fraction
    if blocked < 0:
        result[:] = best
        return blocked
    for j in range(len(result)):
        moved = result[j] + share * (best[j] - result[j])
        result[j] = min(max(moved, bounds[0, j]), bounds[1, j])
    return blocked


@compiled
def _steepest(
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    bounds: Vector,
    free: Vector,
    result: Vector,
) -> int:
    """The held joint from whose bound the cost falls most steeply inward; -1 if none does."""
    count = len(wanted)
    residual = np.empty(count)
    for i in range(count):
        residual[i] = -wanted[i]
        for j in range(len(result)):
            residual[i] += tasks[i, j] * result[j]
    steepest = -1
    descent = ROUNDING
    for j in range(len(result)):
        if free[j] > 0.0 or bounds[1, j] <= bounds[0, j]:
            continue
        slope = damping * (result[j] - posture[j])
        for i in range(count):
            slope += tasks[i, j] * residual[i]
        gained = slope if result[j] >= bounds[1, j] else -slope
        if gained > descent:
            steepest = j
            descent = gained
    return steepest


@compiled
def _solve(
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    free: Vector,
    held: Vector,
    out: Vector,
) -> None:
    """Write into out (J,) the minimum of the cost with some joints held, without bounds.

    Joints with free = 0 keep the value in `held`. With F = diag(free) and x0 the posture of the
    free joints and the values of the held ones, the dual has as many equations as there are tasks:

        x = x0 + F tasks^T (tasks F tasks^T + damping I)^-1 (wanted - tasks x0)
    """
    joints = len(posture)
    count = len(wanted)
    part = np.empty((count, joints))
    root = np.empty((count, count))
    right = np.empty(count)
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
    """Change the solution x (J,) of `least_squares` so that rows (K, J) x <= limits (K,) hold.

    The bounds contain 0. Negative limits demand motion away from something. If not all limits can
    be kept, negative ones are replaced by 0, so that x = 0 is feasible. If the method still ends
    early, because its rounds are bounded, x is scaled down until bounds and non-negative limits
    hold.

    Returns True if x had to be changed.
    """
    if _farthest(bounds, rows, limits, x, TOLERANCE) < 0:
        return False
    _solve_with_rows(tasks, wanted, posture, damping, bounds, rows, limits, x)
    if len(limits) and limits.min() < 0.0 and _farthest(bounds, rows, limits, x, TOLERANCE) >= 0:
        least = np.maximum(limits, 0.0)
        _solve_with_rows(tasks, wanted, posture, damping, bounds, rows, least, x)
    share = _share_within(bounds, rows, limits, x)
    for j in range(len(x)):
        x[j] = min(max(share * x[j], bounds[0, j]), bounds[1, j])
    return True


@compiled
def _solve_with_rows(  # noqa: C901, PLR0912, PLR0915 - one algorithm
    tasks: Vector,
    wanted: Vector,
    posture: Vector,
    damping: float,
    bounds: Vector,
    rows: Vector,
    limits: Vector,
    x: Vector,
) -> None:
    """Solve the problem of the module, bounds as further rows, by a dual active-set method.

    The method is that of Goldfarb and Idnani (Mathematical Programming 27, 1983). It starts from
    the minimum without constraints. In each round, the most violated constraint `entering` gets a
    growing multiplier, which moves x along -direction and changes the multipliers of the active
    constraints by -decrease. The step ends

    * where the entering constraint is met (a full step): it becomes active; or
    * where an active multiplier falls to 0 (a partial step): that constraint, `leaving`, is
      dropped, and the entering one continues in the next round.

    If neither is possible, not all constraints can be kept, and x remains where it is.
    """
    joints = len(x)
    transposed = np.empty((joints, len(wanted)))
    root = np.empty((joints, joints))

    # the minimum without constraints:
    # (tasks^T tasks + damping I) x = tasks^T wanted + damping posture
    for j in range(joints):
        x[j] = damping * posture[j]
        for i in range(len(wanted)):
            transposed[j, i] = tasks[i, j]
            x[j] += tasks[i, j] * wanted[i]
    factorise(transposed, damping, root)
    substitute(root, x)

    # active constraints: multipliers, normals, and images, the normals times the inverse Hessian
    active = 0
    multiplier = np.zeros(joints)
    normals = np.zeros((joints, joints))
    images = np.zeros((joints, joints))
    normal = np.empty(joints)
    direction = np.empty(joints)
    decrease = np.empty(joints)
    entering = -1
    entering_multiplier = 0.0

    for _ in range(CONSTRAINT_ROUNDS):
        if entering < 0:
            entering = _farthest(bounds, rows, limits, x, 0.1 * TOLERANCE)
            entering_multiplier = 0.0
            if entering < 0:
                break

        # which way x moves, and how far until the entering constraint is met
        limit = _constraint(entering, bounds, rows, limits, normal)
        direction[:] = normal
        substitute(root, direction)
        _multiplier_decrease(direction, normals, images, active, decrease)
        excess = -limit
        slope = 0.0
        leaving = -1
        step = math.inf
        for j in range(joints):
            for k in range(active):
                direction[j] -= decrease[k] * images[k, j]
            excess += normal[j] * x[j]
            slope += normal[j] * direction[j]

        # which active multiplier falls to 0 first, and is that a shorter step
        for k in range(active):
            if decrease[k] > ROUNDING and multiplier[k] < step * decrease[k]:
                leaving = k
                step = multiplier[k] / decrease[k]
        if slope > LEAST_SLOPE and active < joints and excess <= step * slope:
            leaving = -1
            step = excess / slope
        elif leaving < 0:
            break  # not all constraints can be kept, or the rest is rounding

        if slope > LEAST_SLOPE:
            for j in range(joints):
                x[j] -= step * direction[j]
        entering_multiplier += step
        for k in range(active):
            multiplier[k] -= step * decrease[k]

        if leaving < 0:
            normals[active] = normal
            multiplier[active] = entering_multiplier
            images[active] = normal
            substitute(root, images[active])
            active = active + 1
            entering = -1
        else:
            active -= 1
            for k in range(leaving, active):
                multiplier[k] = multiplier[k + 1]
                normals[k] = normals[k + 1]
                images[k] = images[k + 1]


@compiled
def _share_within(bounds: Vector, rows: Vector, limits: Vector, x: Vector) -> float:
    """Largest share, at most 1, of x (J,) that keeps bounds and limits; limits are at least 0."""
    share = 1.0
    for j in range(len(x)):
        bound = bounds[1, j] if x[j] > 0.0 else bounds[0, j]
        if abs(x[j]) > abs(bound) + TOLERANCE:
            share = min(share, bound / x[j])
    for k in range(len(limits)):
        along = 0.0
        for j in range(len(x)):
            along += rows[k, j] * x[j]
        limit = max(limits[k], 0.0)
        if along > limit + TOLERANCE:
            share = min(share, limit / along)
    return share


@compiled
def _farthest(bounds: Vector, rows: Vector, limits: Vector, x: Vector, least: float) -> int:
    """Number of the constraint that x (J,) exceeds most; -1 if no excess is above `least`.

    Upper bounds have the numbers 0 ... J - 1, lower bounds J ... 2 J - 1, rows the numbers from 2
    J.
    """
    joints = len(x)
    farthest = -1
    most = least
    for j in range(joints):
        if x[j] - bounds[1, j] > most:
            farthest = j
            most = x[j] - bounds[1, j]
        if bounds[0, j] - x[j] > most:
            farthest = joints + j
            most = bounds[0, j] - x[j]
    for k in range(len(limits)):
        beyond = -limits[k]
        for j in range(joints):
            beyond += rows[k, j] * x[j]
        if beyond > most:
            farthest = 2 * joints + k
            most = beyond
    return farthest


@compiled
def _constraint(number: int, bounds: Vector, rows: Vector, limits: Vector, normal: Vector) -> float:
    """Limit of the constraint with this number of `_farthest`; write its normal (J,).

    The constraint is normal · x <= limit.
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
def _multiplier_decrease(
    direction: Vector, normals: Vector, images: Vector, active: int, out: Vector
) -> None:
    """Write into out (active,) the change of the active multipliers per unit of the entering one.

    With the active normals A (active, J), their images M = A H^-1, the direction H^-1 n of the
    entering normal n, and H = tasks^T tasks + damping I:

        out = (A M^T)^-1 A direction
    """
    root = np.empty((active, active))
    right = np.empty(active)
    for a in range(active):
        right[a] = 0.0
        for j in range(len(direction)):
            right[a] += normals[a, j] * direction[j]
        for b in range(a + 1):
            total = 0.0
            for j in range(len(direction)):
                total += normals[a, j] * images[b, j]
            for k in range(b):
                total -= root[a, k] * root[b, k]
            root[a, b] = math.sqrt(max(total, ROUNDING)) if a == b else total / root[b, b]
    substitute(root, right)
    for a in range(active):
        out[a] = right[a]
