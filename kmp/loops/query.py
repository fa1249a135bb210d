"""One query at a time, compiled by Numba where that is installed: loops over what the query touches
and nothing else.

For the Gaussian kernel, whose inputs are scaled once; the covariance for the dense solution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import nearest_positive_semidefinite
from kmp.compiled import AVAILABLE, compiled
from kmp.dense import Dense
from kmp.functionals import Derivatives
from kmp.kernel import GaussianKernel
from kmp.loops.kernel_row import kernel_value
from kmp.loops.mean import means, slopes, table_of
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
    table: Array
    """(I + O, P) the rows beside one another, as `means` takes them."""
    derivatives: Derivatives
    """Which of the centres are derivatives, if any."""

    @classmethod
    def of(cls, query: Query) -> CompiledQuery | None:
        """The query for compiled loops; None where there are none for it."""
        if not AVAILABLE or not isinstance(query.kernel, GaussianKernel):
            return None
        inputs = len(query.stretch)
        nothing = frozen(np.empty((0, inputs)))
        none: NDArray[np.intp] = frozen(np.empty(0, dtype=np.intp))
        along = frozen(query.solution.functionals.along * query.stretch) if query.derivatives else nothing
        rows, table = np.hstack([query.centres, query.weights]), table_of(query.centres, query.weights)
        return cls(query, frozen(rows), along, frozen(table), query.derivatives or Derivatives(none, nothing))

    @cached_property
    def columns(self) -> Array | None:
        """The columns of L^-1 from the diagonal block on, one after the other, with K + lambda_c
        Sigma = L L^T (R A, R A); None: the covariance is the solution's own.
        """
        solution = self.query.solution
        return _packed(solution) if isinstance(solution, Dense) else None

    @cached_property
    def _reads(self) -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
        """What `means` and `slopes` read besides the queries."""
        q = self.query
        coordinates = frozen(np.concatenate([[q.scale], q.stretch]))
        return self.table, *self.derivatives, coordinates, q.prior_mean

    def mean(self, queries: Array) -> tuple[Array, Array] | None:
        """xi at queries (M, I), at least one: (M, O); and the last one's kernel row (R,).

        But for rounding as `Query.mean`; None where what was given, or comes of it, is not finite.
        """
        table, places, along, coordinates, prior = self._reads
        given = np.array(queries, np.float64, order="C")  # one type of array, and so compiled once
        values, out = np.empty(table.shape[1]), np.empty((len(given), len(prior)))
        finite = means(given, table, places, along, coordinates, prior, values, out)
        return (out, values[: len(self.rows)]) if finite else None

    def jacobian(self, query: Array) -> Array | None:
        """As `Query.jacobian`, but for rounding; None as in `mean`."""
        table, places, along, coordinates, prior = self._reads
        given = np.array(query, np.float64, order="C")
        out = np.empty((len(prior), len(given)))
        return out if slopes(given, table, places, along, coordinates, prior, out) else None

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
        if self.columns is None or not isinstance(q.solution, Dense):
            return q.covariance(values)
        apart = q.solution.apart
        found = np.empty((apart, apart))
        if not _posterior(values, self.columns, np.zeros((apart, len(values) * apart)), found):
            found = nearest_positive_semidefinite(found[None])[0]
        found *= q.covariance_scale
        return found if apart > 1 else found[0, 0] * np.eye(len(q.prior_mean))


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
