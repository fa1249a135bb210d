"""Predictions of a primitive at queries: mean, derivatives, covariance, samples.

Mean xi(s) = k(s) w + m(s), equation (8) of the paper, section II-B. Covariance N / lambda_c (k(s,
s) I - k (K + lambda_c Sigma)^-1 k^T), IJRR 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import Array, Seed, check_finite, check_shape, real, seeded, whole
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import nearest_positive_semidefinite
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, unchecked
from kmp.kernel import Kernel, between
from kmp.loops.query import CompiledQuery
from kmp.low_rank import Features
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import AffineMean
from kmp.query import MotionPrediction, Query
from kmp.solution import BLOCK, Solution, mean_at, mean_of_rows

_RESIDUAL = 1e-10  # residual of the features, as a share of k(s, s), in the uncertainty by distance


@dataclass(frozen=True, eq=False, repr=False)
class Inner(Immutable):
    """The inside of a primitive: its solution, its changes, and the arrays of a single query.

    For the package itself, its tests and those who extend it; it may change in any version.
    `KMP.inner` is the only way to it.
    """

    solution: Solution
    changes: Changes
    count: int
    """N of the covariance: the number of points of the base."""

    @classmethod
    def of_base(cls, solution: Solution) -> Inner:
        """The inside of a primitive without changes."""
        database: Database = solution.database
        return cls(solution, database.unchanged(), len(database))

    @cached_property
    def query(self) -> Query:
        """The arrays of a single query."""
        return Query.of(self.solution, self.count)

    @cached_property
    def compiled_query(self) -> CompiledQuery | None:
        """The arrays of a query for compiled loops; None without Numba, or for a kernel that they
        lack.
        """
        return CompiledQuery.of(self.query)


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Immutable):
    """The covariance of `predict` as a sum of two, each (M, O, O) [unit of the outputs^2]."""

    variability: Array
    """The part by differences between the demonstrations."""
    distance: Array
    """The part by distance from the data: it remains if each reference point is exact."""


class Predictor(Immutable):
    """The predictions of a solution, which `KMP` inherits. M queries, I inputs, O outputs.

    Where I is 1, queries may be (M,), and one query a number.
    """

    inner: Inner
    """Arrays and solutions, for other packages of this project; they may change."""

    def mean(self, queries: ArrayLike) -> Array:
        """xi(s) at queries (M, I): (M, O) [unit of the outputs]. Equation (8).

        Without Numba, a query alone and the same query in a set may differ by rounding. Raises
        ValueError if the shape differs or a number is not finite.
        """
        s = self._columns(real("queries", queries))
        if (mean_and_row := self._compiled_mean(s)) is not None:
            return mean_and_row[0]
        return mean_at(self.inner.solution, self._checked_many(s))

    def predict(self, queries: ArrayLike) -> Gaussians:
        """xi(s) with its covariance at queries (M, I): M normals.

        The mean is that of `mean`, bit for bit. Covariance: N / lambda_c (k(s, s) I - k (K +
        lambda_c Sigma)^-1 k^T), IJRR 2019. The first prediction inverts the triangular factor:
        predict once before a deadline matters. Raises ValueError if the shape differs, a number is
        not finite, or a stored primitive cannot be solved with these libraries.
        """
        s = self._columns(real("queries", queries))
        compiled = self.inner.compiled_query if s.shape[:1] == (1,) else None
        if compiled is not None and (mean_and_row := self._compiled_mean(s)) is not None:
            return unchecked(mean_and_row[0], compiled.covariance(mean_and_row[1])[None])
        s = self._checked_many(s)
        solution = self.inner.solution
        mean_and_row = self._compiled_mean(s)
        mean = np.empty((len(s), self.outputs)) if mean_and_row is None else mean_and_row[0]
        posterior = np.empty((len(s), self.outputs, self.outputs))
        for a in range(0, len(s), BLOCK):
            block = Functionals(s[a : a + BLOCK])
            rows = between(self.kernel, block, solution.functionals)
            posterior[a : a + BLOCK] = solution.posterior_covariance(
                rows, self.kernel.prior_variance
            )
            if mean_and_row is None:
                mean[a : a + BLOCK] = mean_of_rows(solution, block, rows)
        return unchecked(mean, self._scaled(posterior))

    def predict_joint(self, queries: ArrayLike) -> Gaussians:
        """xi(s) at queries (M, I) as one normal over all M O outputs, query after query.

        The blocks on the diagonal are the covariances of `predict`, the others those between
        queries, so that one draw is a path. (M O)^2 numbers. Raises ValueError as `predict` does.
        """
        s = self._checked_many(queries)
        if len(s) == 0:
            raise ValueError("queries: none given, at least 1 needed.")
        rows = between(self.kernel, Functionals(s), self.inner.solution.functionals)
        posterior = self.inner.solution.posterior_covariance(rows, self.kernel(s, s))
        return unchecked(self.mean(s).reshape(1, -1), self._scaled(posterior))

    def sample(self, queries: ArrayLike, count: int, *, seed: Seed = 0) -> Array:
        """Trajectories through queries (M, I), drawn from `predict_joint`: (count, M, O).

        `seed` is a whole number or a numpy Generator.

        Raises ValueError as `predict` does, or if the count is below 1.
        """
        joint = self.predict_joint(queries)
        drawn = drawn_paths(joint, self._units(joint.outputs), count, seed)
        return drawn.reshape(count, -1, self.outputs)

    def predict_motion(
        self,
        query: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        covariance: bool = True,
    ) -> MotionPrediction:
        """xi at one query (I,) and its motion with the input.

        The input's velocity v (I,) [unit of the inputs / s] and acceleration a (I,) [unit of the
        inputs / s^2] give those of the output: J v, and J a + d^2 xi(s + t v)/dt^2. The numbers are
        those of `jacobian`, and to rounding those of `predict`. The covariance takes longer than
        all else, and can be left out.

        Raises ValueError if a shape differs or a number is not finite.
        """
        s = real("query", query)
        v = real("velocity", velocity)
        a = real("acceleration", acceleration)
        compiled = self.inner.compiled_query
        if compiled is not None and s.shape == v.shape == a.shape == (self._dimensions,):
            motion = compiled.motion(s, v, a, covariance=covariance)
            if motion is not None:
                return motion
        checked = self._checked("velocity", v), self._checked("acceleration", a)
        return self.inner.query.motion(self._one_query(s), *checked, covariance=covariance)

    def jacobian(self, query: ArrayLike) -> Array:
        """dxi/ds at one query (I,): (O, I) [unit of the outputs / unit of the inputs].

        The derivative of equation (8). Raises ValueError if the shape differs or a number is not
        finite.
        """
        still = np.zeros(self._dimensions)
        return self.predict_motion(query, still, still, covariance=False).jacobian

    def jacobians(self, queries: ArrayLike) -> Array:
        """dxi/ds at queries (M, I): (M, O, I), equal to `jacobian` but for rounding.

        Raises ValueError if the shape differs or a number is not finite.
        """
        s = self._checked_many(queries)
        batches = [self.inner.query.jacobians(s[a : a + BLOCK]) for a in range(0, len(s), BLOCK)]
        return np.concatenate(batches) if batches else np.empty((0, self.outputs, self._dimensions))

    def uncertainty(self, queries: ArrayLike) -> Uncertainty:
        """The covariance at queries (M, I), by its causes: differing demonstrations, distance.

        The part by distance is IJRR 2019's covariance with Sigma = 0. Raises ValueError if the
        shape differs or a number is not finite.
        """
        s = self._checked_many(queries)
        total = self.predict(s).covariance
        c = self.kernel.channels
        z = self._spanned(Functionals(s)).T.reshape(len(s), c, len(self._spanned.pivots))
        residual = self.inner.solution.hyperparameters.over_outputs(
            self.kernel.prior_variance - z @ z.transpose(0, 2, 1)
        )
        distance = self._scaled(residual)
        variability = nearest_positive_semidefinite(total - distance, self._units(self.outputs))
        return Uncertainty(frozen(variability), frozen(distance))

    @property
    def kernel(self) -> Kernel:
        """The kernel k."""
        return self.inner.solution.hyperparameters.kernel

    @property
    def lambda_mean(self) -> float:
        """lambda of equation (9) [1 / (unit of the outputs)^2]."""
        return self.inner.solution.hyperparameters.lambda_mean

    @property
    def lambda_covariance(self) -> float:
        """lambda of the covariance [1 / (unit of the outputs)^2]."""
        return self.inner.solution.hyperparameters.lambda_covariance

    @property
    def prior_mean(self) -> Array | AffineMean:
        """(O,) [unit of the outputs], to which the mean returns far from the data, or affine."""
        return self.inner.solution.hyperparameters.prior_mean

    @property
    def prior_covariance(self) -> Array:
        """B (D, D) [unit of the outputs^2] of the D outputs of a channel."""
        covariance = self.inner.solution.hyperparameters.prior_covariance
        if covariance is None:
            return np.eye(self.outputs // self.kernel.channels)
        return covariance

    @property
    def outputs(self) -> int:
        """O, the number of outputs."""
        return self.inner.solution.hyperparameters.outputs

    @property
    def representation(self) -> Literal["dense", "low_rank"]:
        """The kind of solution."""
        return self.inner.solution.representation

    @cached_property
    def _spanned(self) -> Features:
        points = self.inner.solution.database.functionals
        return Features.spanning(self.kernel, points, tolerance=_RESIDUAL)

    @cached_property
    def _dimensions(self) -> int:
        return int(self.inner.solution.database.inputs.shape[1])

    def _scaled(self, posterior: Array) -> Array:
        """N / lambda_c times posterior covariances (M, n, n), made positive semi-definite."""
        nearest = nearest_positive_semidefinite(posterior, self._units(posterior.shape[1]))
        return nearest * self.inner.query.covariance_scale

    def _units(self, count: int) -> Array:
        """The prior deviations of `count` outputs, query after query."""
        deviations = self.inner.solution.hyperparameters.prior_deviations
        return np.tile(deviations, count // self.outputs)

    def _compiled_mean(self, queries: Array) -> tuple[Array, Array] | None:
        """The mean (M, O) by compiled loops, and the last kernel row; None if these cannot."""
        compiled = self.inner.compiled_query
        if (
            compiled is None
            or queries.ndim != 2
            or queries.shape[1] != self._dimensions
            or len(queries) == 0
        ):
            return None
        return compiled.mean(queries)

    def _wrapped(self, queries: Array) -> Array:
        """The queries modulo the period, if any: rounding then differs nowhere in the period."""
        period = self.kernel.period
        return queries if period is None else queries % period

    def _one_query(self, query: ArrayLike) -> Array:
        return self._wrapped(self._checked("query", query))

    def _checked(self, name: str, value: ArrayLike) -> Array:
        s = real(name, value)
        s = s[None] if s.ndim == 0 and self._dimensions == 1 else s
        check_shape(name, s, self._dimensions)
        check_finite(name, s)
        return s

    def _columns(self, queries: Array) -> Array:
        """Queries (M,) of one input as (M, 1)."""
        return queries[:, None] if queries.ndim == self._dimensions == 1 else queries

    def _checked_many(self, queries: ArrayLike) -> Array:
        s = self._columns(real("queries", queries))
        if s.ndim != 2 or s.shape[1] != self._dimensions:
            check_shape("queries", s, "M", self._dimensions)
        check_finite("queries", s)
        return self._wrapped(s)


def drawn_paths(normal: Gaussians, units: Array, count: int, seed: Seed) -> Array:
    """Draws (count, n) of one normal, whose covariance may be singular.

    `units` (n,) are the outputs' sizes, so that a small output's variance is not lost in rounding.
    """
    whole("count", count)
    values, vectors = np.linalg.eigh(normal.covariance[0] / np.outer(units, units))
    root = units[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    random = np.random.default_rng(seeded(seed))
    return np.asarray(normal.mean[0] + random.standard_normal((count, len(values))) @ root.T)
