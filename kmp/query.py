"""Mean, derivatives and covariance at one query.

With w (R C, D) the weights: xi(s) = k(s) w + m(s), equation (8); J = dxi/ds; for an input that
moves with v and a, d xi/dt = J v and d^2 xi/dt^2 = J a + d^2 xi(s + t v)/dt^2. Covariance N /
lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T), IJRR 2019.

The arrays that a query reads are prepared once. `kmp.loops.query` computes the same by loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable
from kmp.arrays.linear_algebra import nearest_positive_semidefinite
from kmp.functionals import Functionals
from kmp.kernel import Kernel, between, third_derivative
from kmp.solution import Solution, mean_of_rows


class MotionPrediction(NamedTuple):
    """The output at one query, and its motion with the input. I inputs, O outputs."""

    mean: Array
    """(O,) [unit of the outputs]"""
    velocity: Array
    """(O,) [unit of the outputs / s] the Jacobian times the input's velocity."""
    acceleration: Array
    """(O,) [unit of the outputs / s^2] the Jacobian times the input's, plus the curvature."""
    covariance: Array | None
    """(O, O) [unit of the outputs^2]; None if it was not requested."""
    jacobian: Array
    """(O, I) [unit of the outputs / unit of the inputs] d mean / d input."""
    curvature: Array
    """(O,) [unit of the outputs / s^2] the acceleration that the input's velocity makes alone."""


@dataclass(frozen=True, eq=False, repr=False)
class Query(Immutable):
    """The arrays of a solution for one query: R centres, C channels, D outputs a channel."""

    solution: Solution
    weights: Array  # (R C, D)
    prior_mean: Array  # (O, 1 + I) its offset and its matrix
    covariance_scale: float  # N / lambda_c

    @classmethod
    def of(cls, solution: Solution, count: int) -> Query:
        """The arrays of a solution, of a base of N = `count` points.

        Raises ValueError if the solution cannot be computed.
        """
        parameters = solution.hyperparameters
        weights = solution.weights.reshape(-1, parameters.channel_outputs)
        scale = count / parameters.lambda_covariance
        return cls(solution, weights, parameters.prior_columns, scale)

    @property
    def kernel(self) -> Kernel:
        """The kernel k."""
        return self.solution.hyperparameters.kernel

    def covariance(self, row: Array) -> Array:
        """N / lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T) (O, O), for a row. IJRR."""
        posterior = self.solution.posterior_covariance(row, self.kernel.prior_variance)
        deviations = self.solution.hyperparameters.prior_deviations
        nearest = nearest_positive_semidefinite(posterior, deviations)[0]
        return np.asarray(nearest * self.covariance_scale)

    def jacobians(self, queries: Array) -> Array:
        """dxi/ds at queries (M, I): (M, O, I). Equation (8), derived."""
        count, inputs = queries.shape
        axes = np.tile(np.eye(inputs), (count, 1))
        along = Functionals(np.repeat(queries, inputs, axis=0), axes)
        products = between(self.kernel, along, self.solution.functionals) @ self.weights
        slopes = products.reshape(count, inputs, -1).transpose(0, 2, 1)
        return np.asarray(slopes + self.prior_mean[:, 1:])

    def curvature(self, query: Array, velocity: Array) -> Array:
        """d^2 xi(s + t v)/dt^2 (O,) at t = 0, for v (I,). Equation (8), derived twice."""
        if not velocity.any():
            return np.zeros(len(self.prior_mean))
        # k is a function of s - s': minus its derivative by both along v is that by s, twice
        functionals = self.solution.functionals
        centres = functionals.inputs
        along = np.broadcast_to(velocity, centres.shape)
        bend = -self.kernel(query[None], centres, velocity[None], along)
        observed = np.flatnonzero(~functionals.values)
        if len(observed):
            offsets = query - centres[observed]
            directions = functionals.along[observed]
            third = third_derivative(self.kernel, offsets, directions, velocity)
            blocks = bend.reshape(len(bend), len(centres), -1)
            blocks[:, observed] = -third.transpose(1, 0, 2)
        return np.asarray(bend @ self.weights).ravel()

    def motion(
        self, query: Array, velocity: Array, acceleration: Array, *, covariance: bool
    ) -> MotionPrediction:
        """The output at a query (I,), and its motion by the query's velocity and acceleration
        (I,).
        """
        point = Functionals(query[None])
        row = between(self.kernel, point, self.solution.functionals)
        jacobian = self.jacobians(query[None])[0]
        curvature = self.curvature(query, velocity)
        return MotionPrediction(
            mean_of_rows(self.solution, point, row)[0],
            jacobian @ velocity,
            jacobian @ acceleration + curvature,
            self.covariance(row) if covariance else None,
            jacobian,
            curvature,
        )
