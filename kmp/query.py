"""Mean, derivatives and covariance at one query, from one kernel row.

With w (R C, D) the weights: xi(s) = k(s) w + m(s), equation (8); J = dxi/ds; for an input that
moves with v and a, d xi/dt = J v and d^2 xi/dt^2 = J a + d^2 xi(s + t v)/dt^2. Covariance N /
lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T), IJRR 2019.

The arrays that a query reads are prepared once. `kmp.loops.query` computes the same by loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np

from kmp.arrays.checks import Array
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import nearest_positive_semidefinite
from kmp.functionals import Derivatives, Functionals
from kmp.kernel import between, third_derivative, unstretched
from kmp.radial import GaussianKernel
from kmp.solution import Solution
from kmp.time_kernels import PeriodicKernel, VelocityKernel


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


class KernelRow(NamedTuple):
    """The kernel between one query and R centres."""

    query: Array  # (I,)
    offsets: Array  # (R, I) x - x_r, in the kernel's coordinates
    values: Array  # (R,) exp(-scale |x - x_r|^2)
    kernel: Array  # (R,) or (C, R C) k(s, s_r), derived where s_r stands for a derivative


@dataclass(frozen=True, eq=False, repr=False)
class Query(Immutable):
    """The arrays of a solution for one query: R centres, C channels, D outputs a channel."""

    solution: Solution
    kernel: GaussianKernel | VelocityKernel | PeriodicKernel
    scale: float
    stretch: Array  # (I,): x = stretch * s are the kernel's coordinates
    centres: Array  # (R, I), there
    derivatives: Derivatives | None  # the derivatives among the R centres
    weights: Array  # (R C, D)
    weight_rows: Array  # (D, R C), the same
    prior_mean: Array  # (O, 1) its offset, or (O, 1 + I) and its matrix
    covariance_scale: float  # N / lambda_c

    @classmethod
    def of(cls, solution: Solution, count: int) -> Query:
        """The arrays of a solution, of a base of N = `count` points.

        Raises ValueError if the solution cannot be computed.
        """
        parameters = solution.hyperparameters
        centres = solution.centres
        kernel = cast(GaussianKernel, parameters.kernel)
        inputs = centres.shape[1]
        # a subclass may have other formulas than those for one query
        is_general = type(kernel) not in (GaussianKernel, VelocityKernel, PeriodicKernel)
        scale, stretch = (1.0, unstretched(inputs)) if is_general else kernel.coordinates(inputs)
        weights = solution.weights.reshape(-1, parameters.channel_outputs)
        return (_GeneralQuery if is_general else cls)(
            solution,
            kernel,
            scale,
            stretch,
            frozen(centres * stretch),
            solution.functionals.derivatives(stretch),
            weights,
            frozen(np.ascontiguousarray(weights.T)),
            parameters.prior_columns,
            count / parameters.lambda_covariance,
        )

    @cached_property
    def unstretched(self) -> bool:
        """True if the kernel's coordinates are the inputs themselves."""
        return bool((self.stretch == 1.0).all())

    @cached_property
    def prior_offset(self) -> Array:
        """(O,) the prior mean's offset."""
        return frozen(np.ascontiguousarray(self.prior_mean[:, 0]))

    def row(self, query: Array) -> KernelRow:
        """The kernel row of a query (I,)."""
        offsets = (query if self.unstretched else query * self.stretch) - self.centres
        values = self.kernel.values(offsets, self.scale)
        return KernelRow(
            query, offsets, values, self.kernel.row(offsets, values, self.scale, self.derivatives)
        )

    def mean(self, row: KernelRow) -> Array:
        """xi(s) (O,). Equation (8)."""
        mean = row.kernel @ self.weights
        mean = (mean if mean.ndim == 1 else mean.ravel()) + self.prior_offset
        return np.asarray(
            mean if self.prior_mean.shape[1] == 1 else mean + self.prior_mean[:, 1:] @ row.query
        )

    def covariance(self, kernel: Array) -> Array:
        """N / lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T) (O, O), for a row's k. IJRR."""
        posterior = self.solution.posterior_covariance_one(kernel)
        deviations = self.solution.hyperparameters.prior_deviations
        nearest = nearest_positive_semidefinite(posterior[None], deviations)[0]
        return np.asarray(nearest * self.covariance_scale)

    def jacobian(self, row: KernelRow) -> Array:
        """dxi/ds (O, I). Equation (8), derived."""
        jacobian = self.kernel.jacobian(
            row.offsets, row.values, self.scale, self.weight_rows, self.derivatives
        )
        jacobian = jacobian if self.unstretched else jacobian * self.stretch
        return jacobian if self.prior_mean.shape[1] == 1 else jacobian + self.prior_mean[:, 1:]

    def jacobians(self, queries: Array) -> Array:
        """dxi/ds at queries (M, I): (M, O, I). Equation (8), derived."""
        functionals = self.solution.functionals
        kernel = self.kernel
        i = len(self.stretch)
        if type(kernel) is GaussianKernel and self.derivatives is None:
            # -2 scale sum_r k_r w_r (x - x_r) is one product with w_r and w_r x_r. With the origin
            # at the mean of the centres, the differences lose few digits.
            products = between(kernel, Functionals(queries), functionals) @ self._moments
            x = queries * self.stretch - self._origin
            pulls = products[:, : self.weights.shape[1], None]
            moments = products[:, self.weights.shape[1] :]
            slopes = (pulls * x[:, None, :] - moments.reshape(len(x), -1, i)) * (
                -2 * self.scale * self.stretch
            )
        else:
            along = Functionals(
                np.repeat(queries, i, axis=0), np.tile(np.eye(i), (len(queries), 1))
            )
            products = between(kernel, along, functionals) @ self.weights
            slopes = products.reshape(len(queries), i, -1).transpose(0, 2, 1)
        return slopes if self.prior_mean.shape[1] == 1 else slopes + self.prior_mean[:, 1:]

    @cached_property
    def _origin(self) -> Array:
        """(I,) the mean of the centres, in the kernel's coordinates."""
        return frozen(np.asarray(self.centres.mean(axis=0)))

    @cached_property
    def _moments(self) -> Array:
        """(R, O + O I) the weights w_r, and w_r (x_r - origin)."""
        products = self.weights[:, :, None] * (self.centres - self._origin)[:, None, :]
        return frozen(np.hstack([self.weights, products.reshape(len(products), -1)]))

    def curvature(self, row: KernelRow, velocity: Array) -> Array:
        """d^2 xi(s + t v)/dt^2 (O,) at t = 0, for v (I,). Equation (8), derived twice."""
        direction = velocity * self.stretch
        return self.kernel.curvature(
            row.offsets, row.values, self.scale, self.weights, direction, self.derivatives
        )

    def motion(
        self, query: Array, velocity: Array, acceleration: Array, *, covariance: bool
    ) -> MotionPrediction:
        """The output at a query (I,), and its motion by the query's velocity and acceleration
        (I,).
        """
        row = self.row(query)
        jacobian = self.jacobian(row)
        curvature = self.curvature(row, velocity)
        return MotionPrediction(
            self.mean(row),
            jacobian @ velocity,
            jacobian @ acceleration + curvature,
            self.covariance(row.kernel) if covariance else None,
            jacobian,
            curvature,
        )


class _GeneralQuery(Query):
    """The same for any `Kernel`, by calls of it. Its coordinates are the inputs themselves."""

    def row(self, query: Array) -> KernelRow:
        k = between(self.kernel, Functionals(query[None]), self.solution.functionals)
        k = k[0] if len(k) == 1 else k
        return KernelRow(query, query - self.centres, k, k)

    def jacobian(self, row: KernelRow) -> Array:
        return np.asarray(self.jacobians(row.query[None])[0])

    def curvature(self, row: KernelRow, velocity: Array) -> Array:
        if not velocity.any():
            return np.zeros(len(self.prior_mean))
        # k is a function of s - s': minus its derivative by both along v is that by s, twice
        along = np.broadcast_to(velocity, self.centres.shape)
        bend = -self.kernel(row.query[None], self.centres, velocity[None], along)
        if self.derivatives is not None:
            rows, observed = self.derivatives
            offsets = row.offsets[rows]
            bend[0, rows] = -third_derivative(self.kernel, offsets, observed, velocity)
        return np.asarray(bend @ self.weights).ravel()
