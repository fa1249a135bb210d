"""How far hands have come between the via-points of a task: barycentric weights of the point of
their triangle that is nearest to a hand.

A hand that rests near a via-point belongs to it; one that moves, or waits far from all, is on its
way.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.record import Record, Records, Vector

# Of a task in compiled loops: where both hands' positions are, and what is of one size in all.
TASK = np.dtype(
    [
        ("corners", np.float64, (2, 3, 3)),  # [m] positions of the left and the right hand
        ("inputs", np.int64, (2, 3)),  # as `Task.inputs`
        ("scale", np.float64),  # of the kernel exp(-scale |difference|²) over inputs
        ("std", np.float64),  # [m] how sure the positions are, of each axis
        ("prior_offset", np.float64, (3,)),  # [m] the tool's offset far from all data
    ]
)
SHARPNESS = 4.0  # power of the weights of a hand that rests
AT_M = 0.12  # a hand that rests as near to a via-point belongs to it
AWAY_M = 0.17  # one that rests as far from all waits on its way
LEAST_WEIGHT = 1e-4  # that every via-point has, so that none is of an undefined power
FLAT = 1e-6  # [m²] what a triangle's edges are taken to be longer by, as it may be none
STEP_S = 0.02  # of differences along the hands' motion


@compiled
def _dot(a: Vector, from_a: Vector, b: Vector, from_b: Vector) -> float:
    """The inner product of the ways to two points (3,), each from another."""
    total = 0.0
    for i in range(3):
        total += (a[i] - from_a[i]) * (b[i] - from_b[i])
    return total


@compiled
def nearest_between(point: Vector, corners: Vector, count: int, out: Vector) -> float:
    """Barycentric coordinates (3,), at least 0 and 1 in sum, of the point between `count` corners
    that is nearest to a point; its distance.
    """
    out[:] = 0.0
    if count == 3:
        a, b, c = corners[0], corners[1], corners[2]
        aa, bb, both = _dot(b, a, b, a) + FLAT, _dot(c, a, c, a) + FLAT, _dot(b, a, c, a)
        one, other = _dot(b, a, point, a), _dot(c, a, point, a)
        determinant = aa * bb - both * both
        second, third = (bb * one - both * other) / determinant, (aa * other - both * one) / determinant
        if second >= 0.0 and third >= 0.0 and second + third <= 1.0:
            out[0], out[1], out[2] = 1.0 - second - third, second, third
            square = 0.0
            for i in range(3):
                off = point[i] - out[0] * a[i] - second * b[i] - third * c[i]
                square += off * off
            return math.sqrt(square)
    least = math.inf
    for i in range(count):
        for j in range(i + 1 if i + 1 < count else i, count):
            a, b, square = corners[i], corners[j], 0.0
            along = min(max(_dot(point, a, b, a) / (_dot(b, a, b, a) + FLAT), 0.0), 1.0)
            for k in range(3):
                off = point[k] - a[k] - along * (b[k] - a[k])
                square += off * off
            if square < least and (count == 1 or i != j):
                least = square
                out[:] = 0.0
                out[i] = 1.0 - along
                out[j] += along
    return math.sqrt(least)


@compiled
def hand_weights(hands: Vector, stillness: Vector, task: Record, out: Vector) -> float:
    """The weights of both hands (6,) [m], which are so still (2,), into `out` (F,); how far the
    farther one is off its via-points [m].
    """
    corners, inputs = task["corners"], task["inputs"]
    out[:] = 0.0
    weight, farther = np.empty(3), 0.0
    for side in range(2):
        count = 0
        while count < 3 and inputs[side, count] >= 0:
            count += 1
        hand, nearest = hands[3 * side : 3 * side + 3], math.inf
        farther = max(farther, nearest_between(hand, corners[side], count, weight))
        for i in range(count):
            nearest = min(nearest, _dot(hand, corners[side, i], hand, corners[side, i]))
        near = min(max((AWAY_M - math.sqrt(nearest)) / (AWAY_M - AT_M), 0.0), 1.0)
        power = 1.0 + (SHARPNESS - 1.0) * near * stillness[side]
        total = 0.0
        for i in range(count):
            weight[i] = (weight[i] + LEAST_WEIGHT) ** power
            total += weight[i]
        for i in range(count):
            out[inputs[side, i]] += weight[i] / total
    return farther


@compiled
def all_hand_weights(hands: Vector, stillness: Vector, tasks: Records, out: Vector, off: Vector) -> None:
    """As `hand_weights`, for hands (T, 6): into `out` (T, F) and `off` (T,)."""
    for t in range(len(hands)):
        off[t] = hand_weights(hands[t], stillness[t], tasks[0], out[t])


@compiled
def moving_weights(hands: Vector, velocities: Vector, stillness: Vector, tasks: Records, out: Vector) -> None:
    """The weights of hands (6,) that move so (6,), and their velocity [1/s], into `out` (2, F)."""
    task, ahead = tasks[0], np.empty(out.shape[1])
    hand_weights(hands - STEP_S * velocities, stillness, task, out[1])
    hand_weights(hands + STEP_S * velocities, stillness, task, ahead)
    for i in range(len(ahead)):
        out[1, i] = (ahead[i] - out[1, i]) / (2.0 * STEP_S)
    hand_weights(hands, stillness, task, out[0])
