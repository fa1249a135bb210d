"""Compiled arithmetic on numbers and vectors (3,). Each sum starts from 0 and adds the axes in
order, which fixes its last bit, which that of BLAS is not: it differs between processors.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from thirdhand.core.frame import Vector

# parts of a unit; values are rounded so that machines that differ in the last bits agree
ROUND_TO = 1e9


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Inner product a · b."""
    total = 0.0
    for i in range(3):
        total += a[i] * b[i]
    return total


@compiled
def square(a: Vector) -> float:
    """Squared norm |a|²."""
    return dot(a, a)


@compiled
def norm(a: Vector) -> float:
    """Euclidean norm |a|."""
    return math.sqrt(dot(a, a))


@compiled
def times(matrix: Vector, vector: Vector) -> Vector:
    """Product (N,) of a matrix (N, M) and a vector (M,)."""
    product = np.zeros(len(matrix))
    for row in range(len(matrix)):
        for column in range(len(vector)):
            product[row] += matrix[row, column] * vector[column]
    return product


@compiled
def add_product(left: Vector, right: Vector, out: Vector) -> None:
    """Add to `out` (N, M) the product of two matrices (N, K) and (K, M)."""
    for row in range(len(left)):
        for column in range(right.shape[1]):
            total = out[row, column]
            for k in range(len(right)):
                total += left[row, k] * right[k, column]
            out[row, column] = total


@compiled
def transform(
    matrix: Vector, origin: Vector, point: Vector | tuple[float, float, float], out: Vector
) -> None:
    """Write origin + matrix point, all (3,) with a matrix (3, 3), into the first three of `out`."""
    for row in range(3):
        out[row] = origin[row]
        for k in range(3):
            out[row] += matrix[row, k] * point[k]


@compiled
def cross(a: Vector, b: Vector, out: Vector) -> None:
    """Write into out (3,) the cross product a × b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def squared_distance(a: Vector, b: Vector) -> float:
    """|a - b|²."""
    total = 0.0
    for i in range(3):
        total += (a[i] - b[i]) ** 2
    return total


@compiled
def distance(a: Vector, b: Vector) -> float:
    """|a - b|."""
    return math.sqrt(squared_distance(a, b))


@compiled
def rounded(value: float, parts: float = ROUND_TO) -> float:
    """A number, rounded to `parts` parts of a unit."""
    return float(np.rint(value * parts) / parts)


@compiled
def round_to(values: Vector, parts: float) -> None:
    """Round values (3, 3) to `parts` parts of a unit, in place.

    Results that follow are then equal on machines that differ in the last bits.
    """
    for i in range(3):
        for j in range(3):
            values[i, j] = rounded(values[i, j], parts)


@compiled
def squared_amplitude(displacement: Vector, velocity: Vector, rate: float) -> float:
    """Squared amplitude |y|² + |w|² / ω² of an oscillation y (3,) with the velocity w (3,)."""
    total = 0.0
    for i in range(3):
        total += displacement[i] ** 2 + (velocity[i] / rate) ** 2
    return total
