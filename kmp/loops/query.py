"""Mean, derivatives and covariance at one query as compiled loops, for the Gaussian kernel.

The equations are those of `kmp.query`. The covariance of a dense solution is N / lambda_c (I - R
R^T) with the root R = (L^-1 (k^T (x) I))^T, of L L^T = K + lambda_c Sigma.
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
from kmp.loops.kernel_row import kernel_value
from kmp.loops.mean import means, table_of
from kmp.query import MotionPrediction, Query
from kmp.radial import GaussianKernel

# rows and columns of a factor that is computed in a fixed order, in less than 2 s
_MOST_EXACT = 1500
MEANS = 4  # rows of a motion's output before the Jacobian: mean, velocity, acceleration, curvature


@dataclass(frozen=True, eq=False, repr=False)
class CompiledQuery(Immutable):
    """The arrays of a query for compiled loops. R centres, O outputs."""

    query: Query
    scale: float
    stretch: Array
    """(I,) x = stretch * s are the kernel's coordinates."""
    rows: Array
    """(R, I + O) each centre, in the kernel's coordinates, and its weights."""
    table: Array
    """(I + O, P) the rows transposed and padded, for `means`."""
    along: Array
    """(R, I) the directions of derivatives, in the kernel's coordinates, zero for a value; (0, I)
    if all are values."""
    places: NDArray[np.intp]
    """(R',) the centres that are derivatives."""

    @classmethod
    def of(cls, query: Query) -> CompiledQuery | None:
        """The query for compiled loops; None without Numba, or for another kernel."""
        kernel = query.kernel
        if not AVAILABLE or type(kernel) is not GaussianKernel:
            return None
        functionals = query.solution.functionals
        scale, stretch = kernel.coordinates(functionals.inputs.shape[1])
        centres = functionals.inputs * stretch
        along = functionals.along * stretch
        places = np.flatnonzero(~functionals.values)
        return cls(
            query,
            scale,
            stretch,
            frozen(np.hstack([centres, query.weights])),
            frozen(table_of(centres, query.weights)),
            frozen(along if len(places) else along[:0]),
            frozen(places),
        )

    @cached_property
    def columns(self) -> Array | None:
        """The columns of L^-1 from the diagonal block down, one after the other.

        L (R A, R A) with L L^T = K + lambda_c Sigma. None if the solution is not dense.
        """
        solution = self.query.solution
        return self._packed(solution) if isinstance(solution, Dense) else None

    @cached_property
    def _reads(self) -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
        """The arguments of `means` other than the queries."""
        coordinates = frozen(np.concatenate([[self.scale], self.stretch]))
        directions = frozen(self.along[self.places])
        return self.table, self.places, directions, coordinates, self.query.prior_mean

    def mean(self, queries: Array) -> tuple[Array, Array] | None:
        """xi (M, O) at M >= 1 queries (M, I), and the last query's kernel row (R,).

        Equal to `Query.mean` but for rounding; None if a query or a result is not finite.
        """
        table, places, along, coordinates, prior = self._reads
        # one type of array, and so compiled once
        query_array = np.array(queries, np.float64, order="C")
        values = np.empty(table.shape[1])
        out = np.empty((len(query_array), len(prior)))
        finite = means(query_array, table, places, along, coordinates, prior, values, out)
        return (out, values[: len(self.rows)]) if finite else None

    def motion(
        self, query: Array, velocity: Array, acceleration: Array, *, covariance: bool
    ) -> MotionPrediction | None:
        """As `Query.motion`, to rounding; None as in `mean`."""
        q = self.query
        moving = np.empty((3, len(query)))
        values = np.empty(len(self.rows))
        moving[0] = query
        moving[1] = velocity
        moving[2] = acceleration
        out = np.empty((MEANS + len(query), len(q.prior_mean)))
        if not _motion(
            moving, self.rows, self.along, self.stretch, self.scale, q.prior_mean, values, out
        ):
            return None
        posterior = self.covariance(values) if covariance else None
        return MotionPrediction(
            out[0], out[1], out[2], posterior, out[MEANS:].reshape(-1, len(query)), out[3]
        )

    def covariance(self, values: Array) -> Array:
        """As `Query.covariance`, to rounding."""
        q = self.query
        if self.columns is None or not isinstance(q.solution, Dense):
            return q.covariance(values[None])
        distinct = q.solution.distinct
        posterior = np.empty((distinct, distinct))
        if not _posterior(
            values, self.columns, np.zeros((distinct, len(values) * distinct)), posterior
        ):
            unit = q.solution.hyperparameters.prior_deviations[:distinct]
            posterior = nearest_positive_semidefinite(posterior[None], unit)[0]
        posterior *= q.covariance_scale
        return posterior if distinct > 1 else posterior[0, 0] * np.eye(len(q.prior_mean))

    def _packed(self, solution: Dense) -> Array:
        a = solution.distinct
        inverse = np.empty((len(self.rows) * a, len(self.rows) * a))
        centres = np.array(self.rows[:, : len(self.stretch)], order="C")  # not read-only
        penalty = solution.hyperparameters.lambda_covariance
        noise = penalty * solution.database.reference.covariance[:, :a, :a]
        is_exact = len(inverse) <= _MOST_EXACT and not len(self.places)
        if not (is_exact and _inverse_factor(centres, self.scale, noise, inverse)):
            inverse, _ = lapack.dtrtri(solution.covariance_factor, lower=1)
        return frozen(np.concatenate([inverse[i - i % a :, i] for i in range(len(inverse))]))


@compiled
def _inverse_factor(centres: Array, scale: float, noise: Array, out: Array) -> bool:  # noqa: C901, PLR0912 - one algorithm
    """Write L^-1 to `out` (N A, N A), of the Cholesky factor L L^T = K (x) I + noise; true if the
    matrix is positive definite.

    `centres` (N, I) are in the kernel's coordinates, `noise` is (N, A, A). LAPACK is several times
    faster, but rounds differently on each kind of processor; here all sums have a fixed order.
    """
    count, outputs = noise.shape[:2]
    size = count * outputs
    factor = np.zeros((size, size))
    offset = np.empty(centres.shape[1])
    column = np.empty(size)
    for n in range(count):
        for m in range(n + 1):
            value = kernel_value(centres[n], centres[m], scale, offset)
            for a in range(outputs):
                factor[n * outputs + a, m * outputs + a] = value
        for a in range(outputs):
            for b in range(outputs):
                factor[n * outputs + a, n * outputs + b] += noise[n, a, b]
    for k in range(size):
        if not factor[k, k] > 0.0:
            return False
        root = math.sqrt(factor[k, k])
        for i in range(k, size):
            column[i] = factor[i, k] / root
        factor[k:, k] = column[k:]
        for i in range(k + 1, size):
            row = factor[i]
            share = column[i]
            for j in range(k + 1, i + 1):
                row[j] -= share * column[j]
    out[:] = 0.0
    for i in range(size):
        row = out[i]
        row[i] = 1.0
        for k in range(i):
            share = factor[i, k]
            other = out[k]
            for j in range(k + 1):
                row[j] -= share * other[j]
        for j in range(i + 1):
            row[j] /= factor[i, i]
    return True


@compiled
def _motion(  # noqa: C901, PLR0912 - one nest of loops
    moving: Array,
    rows: Array,
    along: Array,
    stretch: Array,
    scale: float,
    prior: Array,
    values: Array,
    out: Array,
) -> bool:
    """Equation (8) and its derivatives along a motion, in one pass over the centres.

    Returns true if all is finite. `moving` (3, I) is the query, its velocity and acceleration;
    `prior` the prior mean's offset and matrix (O, 1 + I). Writes the kernel row
    to `values` (R,), and mean, velocity, acceleration, curvature, Jacobian to `out` (4 + I, O).
    """
    inputs = len(stretch)
    outputs = len(prior)
    derivatives = len(along) > 0
    query = np.empty(inputs)
    offset = np.empty(inputs)
    direction = np.empty(inputs)
    mean = out[0]
    moved = out[1]
    pushed = out[2]
    curvature = out[3]
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
        moved[o] = 0.0
        pushed[o] = curvature[o]
        for i in range(inputs):
            jacobian[o, i] *= stretch[i]
            jacobian[o, i] += prior[o, 1 + i]
            mean[o] += prior[o, 1 + i] * moving[0, i]
            moved[o] += jacobian[o, i] * moving[1, i]
            pushed[o] += jacobian[o, i] * moving[2, i]
        total += mean[o] + moved[o] + pushed[o]
    return math.isfinite(total)


@compiled
def _posterior(values: Array, columns: Array, roots: Array, out: Array) -> bool:  # noqa: C901, PLR0912 - one nest of loops
    """Write I - k (K + lambda_c Sigma)^-1 k^T to `out` (O, O); true if it is positive definite.

    By the roots (O, R O) = (L^-1 (k^T (x) I))^T, which must be 0 at first.
    """
    outputs, size = roots.shape
    start = 0
    for r in range(len(values)):
        value = values[r]
        first = r * outputs
        length = size - first
        for o in range(outputs):
            root = roots[o, first:]
            column = columns[start : start + length]
            for i in range(length):
                root[i] += value * column[i]
            start += length
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
