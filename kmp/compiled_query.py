"""One query at a time, compiled by Numba where that is installed: loops over what the query touches
and nothing else.

For the Gaussian kernel, whose inputs are scaled once; the covariance for the dense solution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from kmp.checks import Array
from kmp.compiled import AVAILABLE, compiled
from kmp.dense import Dense
from kmp.immutable import Immutable, frozen
from kmp.kernel import GaussianKernel
from kmp.kernel_row import kernel_value
from kmp.linear_algebra import nearest_positive_semidefinite
from kmp.query import MotionPrediction, Query

MEANS = 4  # rows of a motion's output before its Jacobian: mean, velocity, acceleration, curvature


@dataclass(frozen=True, eq=False, repr=False)
class CompiledQuery(Immutable):
    """A query's arrays for compiled loops. R centres, O outputs."""

    query: Query
    rows: Array
    """(R, I + O) of each centre, in the kernel's coordinates, and its weights."""
    along: Array
    """(R, I) the directions of the derivatives, in the kernel's coordinates, zero for a value; or
    (0, I), where all are values."""
    columns: Array | None
    """The columns of L^-1 from the diagonal block on, one after the other, with K + lambda_c Sigma
    = L L^T (R A, R A); None: the covariance is the solution's own."""
    apart: int
    """A, the outputs that the factor holds each for itself: all, or 1 for all."""

    @classmethod
    def of(cls, query: Query) -> CompiledQuery | None:
        """The query for compiled loops; None where there are none for it."""
        if not AVAILABLE or not isinstance(query.kernel, GaussianKernel):
            return None
        solution = query.solution
        along = solution.functionals.along * query.stretch if query.derivatives else np.empty((0, len(query.stretch)))
        rows = frozen(np.hstack([query.centres, query.weights]))
        if not isinstance(solution, Dense):
            return cls(query, rows, frozen(along), None, 0)
        return cls(query, rows, frozen(along), _packed(solution), solution.apart)

    def motion(
        self, query: Array, velocity: Array, acceleration: Array, *, covariance: bool
    ) -> MotionPrediction | None:
        """As `Query.motion`, but for rounding; None where what was given, or comes of it, is not
        finite.
        """
        q = self.query
        moving, values = np.empty((3, len(query))), np.empty(len(self.rows))
        moving[0], moving[1], moving[2] = query, velocity, acceleration
        out = np.empty((MEANS + len(query), len(q.prior_mean)))
        if not _motion(moving, self.rows, self.along, q.stretch, q.scale, q.prior_mean, values, out):
            return None
        found = self.covariance(values) if covariance else None
        return MotionPrediction(out[0], out[1], out[2], found, out[MEANS:].reshape(-1, len(query)), out[3])

    def covariance(self, values: Array) -> Array:
        """As `Query.covariance`, but for rounding."""
        q = self.query
        if self.columns is None:
            return q.covariance(values)
        found = np.empty((self.apart, self.apart))
        if not _posterior(values, self.columns, np.zeros((self.apart, len(values) * self.apart)), found):
            found = nearest_positive_semidefinite(found[None])[0]
        found *= q.covariance_scale
        return found if self.apart > 1 else found[0, 0] * np.eye(len(q.prior_mean))


def _packed(solution: Dense) -> Array:
    inverse, _ = lapack.dtrtri(solution.covariance_factor, lower=1)
    a = solution.apart
    return frozen(np.concatenate([inverse[i - i % a :, i] for i in range(len(inverse))]))


@compiled
def _motion(
    moving: Array, rows: Array, along: Array, stretch: Array, scale: float, prior: Array, values: Array, out: Array
) -> bool:
    """Equation (8), and its first and second derivatives along the motion, from one pass over the
    centres, of which some may stand for derivatives; whether all is finite.

    `moving` (3, I) is the query, its velocity and its acceleration; `prior` (O, 1), or (O, 1 + I)
    where the prior mean goes with the input, is its offset and matrix; the kernel row goes into
    `values` (R,); mean, velocity, acceleration, curvature and Jacobian into `out` (4 + I, O).
    """
    inputs, outputs, derivatives, affine = len(stretch), len(prior), len(along) > 0, prior.shape[1] > 1
    query, offset, direction = np.empty(inputs), np.empty(inputs), np.empty(inputs)
    mean, moved, pushed, curvature = out[0], out[1], out[2], out[3]
    jacobian = out[MEANS:].reshape(outputs, inputs)
    square = 0.0
    for i in range(inputs):
        query[i] = moving[0, i] * stretch[i]
        direction[i] = moving[1, i] * stretch[i]
        square += direction[i] * direction[i]
    for o in range(outputs):
        mean[o] = prior[o, 0]
    jacobian[:] = 0.0
    curvature[:] = 0.0
    for r in range(len(rows)):
        value = kernel_value(query, rows[r], scale, offset)
        to_it = 0.0
        for i in range(inputs):
            to_it += offset[i] * direction[i]
        slope = 2.0 * scale * to_it
        bend = value * (slope * slope - 2.0 * scale * square)
        if derivatives:
            away = turn = length = 0.0
            for i in range(inputs):
                away += offset[i] * along[r, i]
                turn += direction[i] * along[r, i]
                length += abs(along[r, i])
            if length > 0.0:
                pull = 2.0 * scale * value
                for o in range(outputs):
                    for i in range(inputs):
                        jacobian[o, i] += pull * rows[r, inputs + o] * along[r, i]
                bend = 2.0 * scale * (away * bend - 2.0 * turn * slope * value)
                value *= 2.0 * scale * away
        values[r] = value
        for o in range(outputs):
            weight = rows[r, inputs + o]
            mean[o] += value * weight
            curvature[o] += bend * weight
            pull = -2.0 * scale * value * weight
            for i in range(inputs):
                jacobian[o, i] += pull * offset[i]
    total = 0.0
    for o in range(outputs):
        moved[o], pushed[o] = 0.0, curvature[o]
        for i in range(inputs):
            jacobian[o, i] *= stretch[i]
            if affine:
                jacobian[o, i] += prior[o, 1 + i]
                mean[o] += prior[o, 1 + i] * moving[0, i]
            moved[o] += jacobian[o, i] * moving[1, i]
            pushed[o] += jacobian[o, i] * moving[2, i]
        total += mean[o] + moved[o] + pushed[o]
    return math.isfinite(total)


@compiled
def _posterior(values: Array, columns: Array, roots: Array, out: Array) -> bool:
    """I - k (K + lambda_c Sigma)^-1 k^T into out (O, O), by roots (O, R O) = (L^-1 (k (x) I))^T;
    whether it is positive definite.
    """
    outputs, size = roots.shape
    at = 0
    for r in range(len(values)):
        value, first = values[r], r * outputs
        length = size - first
        for o in range(outputs):
            root, column = roots[o, first:], columns[at : at + length]
            for i in range(length):
                root[i] += value * column[i]
            at += length
    for a in range(outputs):
        for b in range(a + 1):
            total = 1.0 if a == b else 0.0
            for i in range(size):
                total -= roots[a, i] * roots[b, i]
            out[a, b] = out[b, a] = total
    factor = np.zeros((outputs, outputs))
    for a in range(outputs):
        for b in range(a + 1):
            total = out[a, b]
            for i in range(b):
                total -= factor[a, i] * factor[b, i]
            if a != b:
                factor[a, b] = total / factor[b, b]
            elif total > 0.0:
                factor[a, a] = math.sqrt(total)
            else:
                return False
    return True
