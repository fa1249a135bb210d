"""Primitives straight from demonstrations, with the hyper-parameters that predict held-out groups.

The N reference points s_n are samples of the demonstrations, y_n their outputs (3,). The prior mean
p is constant, or affine in the inputs where that predicts clearly better: demonstrations that are
far from each other are then predicted where a constant mean would draw them together. With the
kernel's vector k(s) and matrix K, r = `noise`, q = `spread` and d = `deviation`,

    mean         m(s) = p(s) + k(s) (K + r S)^-1 (y - p)
    covariance   C(s) = d^2 (k(s, s) - k(s) (K + q S)^-1 k(s)^T)
    scatter      S_n ~ (1 - a) sum_m w_nm e_m e_m^T + a |e|^2 I
    weights      w_nm ~ exp(-|s_n - s_m|^2 / (2 l^2))

S is scaled so that the mean of its traces is 3; e are the residuals without each point's group,
|e|^2 the mean of their squared coordinates, a the share that is the same everywhere, l = `local`,
and the w_nm add up to 1. A point with a factor f_n has f_n S_n for S_n, and the weight 1 / f_n in
p. Residuals of points that are not judged enter no choice. ell, r and p are those with the smallest
residuals, of (K + r I)^-1; q is the least one under which the residuals are about as likely as
under any. With C_1 the covariance for d = 1, H groups and sigma = `Scales.noise`,

    d^2 = max((H + 1) / (H - 1) mean(e^T C_1^-1 e), mean(trace(sigma^2 C_1^-1))) / 3

as each of H groups is predicted by H - 1 whose scatter was measured on the same few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array
from kmp.criteria.errors import preferred, rms
from kmp.gaussians import Gaussians
from kmp.primitive import KMP
from kmp.problem.hyperparameters import AffineMean
from kmp.radial import GaussianKernel
from thirdhand.workbench.learning.cross_validation import (
    held_out_covariances,
    held_out_residuals,
    mahalanobis,
    squared_distances,
)

_NOISES = 10.0 ** np.arange(-3.0, 0.1, 0.5)  # candidates for r
_SPREADS = 10.0 ** np.arange(-3.0, 1.1, 0.5)  # candidates for q
_AS_LIKELY_NAT = 0.05  # a spread less likely by this much counts as equally likely
_SHARED = 0.15  # a


class Scales(NamedTuple):
    """The numbers of a selection that depend on the units of inputs and outputs."""

    ells: Sequence[float]  # candidates for the kernel's ell
    ridges: Sequence[float]  # candidates: inputs that vary by less do not move the affine mean
    linear_share: (
        float  # an affine mean is chosen if its error is below this share of a constant one's
    )
    max_gain: float  # limit of the affine mean's singular values
    local: float  # l [unit of the inputs]
    # sigma, the noise of the outputs, which synthetic demonstrations lack
    noise: float


class Parameters(NamedTuple):
    """The hyper-parameters of a primitive, see the equations of this module."""

    ell: float  # of the kernel
    noise: float  # r
    spread: float  # q
    deviation: float  # d, the standard deviation far from all data
    ridge: float | None = None  # of the affine prior mean; None if the prior mean is constant


@dataclass(frozen=True, eq=False)
class DirectSelection:
    """Reference points of demonstrations, and the selection of hyper-parameters for them.

    Inputs (N, I), outputs (N, 3) and the numbers (N,) of the groups that are held out one after the
    other.
    """

    inputs: Array
    outputs: Array
    group: NDArray[np.intp]
    scales: Scales
    # True if S is a multiple of I at each point, which costs a ninth of the time
    isotropic: bool = False
    joint: bool = False  # True if the prior mean is chosen with the kernel, not after it
    factors: Array | None = None  # (N,) f_n; None if all are 1
    # (N,) True for points whose residuals count; None if all do
    judged: NDArray[np.bool_] | None = None

    @cached_property
    def _constant(self) -> Array:
        return np.asarray(np.average(self.outputs, axis=0, weights=self._weights))

    @property
    def _weights(self) -> Array | None:
        """The points' weights (N,) in a prior mean; None if they are equal."""
        return None if self.factors is None else 1.0 / self.factors

    @cached_property
    def _squares(self) -> Array:
        return squared_distances(self.inputs)

    @cached_property
    def _targets(self) -> dict[tuple[float | None, int], Array]:
        return {}

    @cached_property
    def _counted(self) -> NDArray[np.bool_]:
        return np.ones(len(self.group), bool) if self.judged is None else self.judged

    def best_mean(
        self, ell: float | None = None, *, may_be_linear: bool = False
    ) -> tuple[float, Parameters]:
        """The root mean square residual and the parameters of the best mean.

        ell is this one, or chosen from `Scales.ells`; `spread` and `deviation` are 1.

        Raises ValueError if all points are of one group.
        """
        count = len(np.unique(self.group))
        if count < 2:
            raise ValueError(f"group: {count} number given, at least 2 needed to hold one out.")
        ridges = self.scales.ridges
        ells = np.array(self.scales.ells if ell is None else [ell])
        tried = list(
            self._tried(ells, (None, *ridges) if may_be_linear and self.joint else (None,))
        )
        constant = min(
            (candidate for candidate in tried if candidate[1].ridge is None), key=lambda one: one[0]
        )
        if not may_be_linear:
            return constant
        # Chosen one after the other, both means have the same kernel, and the covariance grows
        # equally fast off the data.
        tried = tried if self.joint else list(self._tried(np.array([constant[1].ell]), ridges))
        linear = min(
            (candidate for candidate in tried if candidate[1].ridge is not None),
            key=lambda one: one[0],
        )
        return linear if linear[0] < self.scales.linear_share * constant[0] else constant

    def _tried(
        self, ells: Array, ridges: Sequence[float | None]
    ) -> Iterator[tuple[float, Parameters]]:
        for ell in ells.tolist():
            for noise, by_ridge in zip(
                _NOISES.tolist(), self._residuals(ell, _NOISES, ridges), strict=True
            ):
                for ridge, residuals in zip(ridges, by_ridge, strict=True):
                    yield rms(residuals[self._counted]), Parameters(ell, noise, 1.0, 1.0, ridge)

    def parameters(self, ell: float | None = None, *, may_be_linear: bool = False) -> Parameters:
        """The parameters that predict held-out groups best, with this ell or one of the scales.

        Raises ValueError if all points are of one group.
        """
        _, unscaled = self.best_mean(ell, may_be_linear=may_be_linear)
        basis = (
            unscaled if self.joint or unscaled.ridge is None else self.best_mean(unscaled.ell)[1]
        )
        spread = self._spread(unscaled.ell, self.residuals(basis.ell, basis.noise, basis.ridge))
        unscaled = unscaled._replace(spread=spread)
        residuals = self.residuals(unscaled.ell, unscaled.noise, unscaled.ridge)
        squares = []
        floors = []
        groups = np.unique(self.group[self._counted])
        for number in groups.tolist():
            mine = self.group == number
            prediction = self.primitive(unscaled, residuals, without=number).predict(
                self.inputs[mine]
            )
            squares.append(mahalanobis(self.outputs[mine] - prediction.mean, prediction.covariance))
            floors.append(
                self.scales.noise**2
                * np.trace(np.linalg.inv(prediction.covariance), axis1=1, axis2=2)
            )
        few = (len(groups) + 1) / (len(groups) - 1)
        scale = max(few * np.concatenate(squares).mean(), np.concatenate(floors).mean()) / 3
        return unscaled._replace(deviation=float(np.sqrt(scale)))

    def residuals(self, ell: float, noise: float, ridge: float | None = None) -> Array:
        """The residuals (N, 3) of each point without its group."""
        return np.asarray(self._residuals(ell, np.array([noise]), (ridge,))[0, 0])

    def by_group(self, residuals: Array) -> Array:
        """The squared residuals (G,) of each judged group, weighted by its points so that their
        mean is that of all points.
        """
        squares = (residuals[self._counted] ** 2).sum(axis=1)
        groups, numbers = np.unique(self.group[self._counted], return_inverse=True)
        return np.asarray(np.bincount(numbers, squares) * len(groups) / len(squares))

    def _residuals(self, ell: float, noises: Array, ridges: Sequence[float | None]) -> Array:
        """The residuals (J, R, N, 3) for noises (J,) and prior means of these ridges (R,)."""
        kernel = np.exp(-ell * self._squares)
        shape = (len(noises), len(self.group), len(ridges), 3)

        def targets(number: int) -> Array:
            return np.hstack([self._target(ridge, number) for ridge in ridges])

        if self.factors is None:
            residuals = held_out_residuals(kernel, noises, self.group, targets)
        else:  # K + r F = F^1/2 (F^-1/2 K F^-1/2 + r I) F^1/2
            roots = np.sqrt(self.factors)[:, None]
            white = kernel / (roots * roots.T)
            residuals = roots * held_out_residuals(
                white, noises, self.group, lambda number: targets(number) / roots
            )
        return np.asarray(residuals.reshape(shape).swapaxes(1, 2))

    def _target(self, ridge: float | None, without: int) -> Array:
        """The outputs (N, 3) minus the prior mean that is fitted without a group."""
        if ridge is None:
            return np.asarray(self.outputs - self._constant)
        if (ridge, without) not in self._targets:
            training_mask = self.group != without
            mean = self._affine(ridge, training_mask)
            self._targets[ridge, without] = self.outputs - self.inputs @ mean.matrix.T - mean.offset
        return self._targets[ridge, without]

    def primitive(
        self, parameters: Parameters, residuals: Array, *, without: int | None = None
    ) -> KMP:
        """The primitive of all groups, or of those `without` one.

        With the covariance of IJRR 2019, N / lambda_c = d^2 and lambda_c Sigma_n = q S_n; for the
        mean, lambda Sigma_n = r S_n.
        """
        training_mask = np.ones(len(self.group), bool) if without is None else self.group != without
        lambda_covariance = training_mask.sum() / parameters.deviation**2
        size = parameters.spread / lambda_covariance
        return KMP.fit(
            self.inputs[training_mask],
            Gaussians(self.outputs[training_mask], size * self._scatter(residuals, training_mask)),
            kernel=GaussianKernel(parameters.ell),
            lambda_mean=parameters.noise / size,
            lambda_covariance=lambda_covariance,
            prior_mean=self._constant
            if parameters.ridge is None
            else self._affine(parameters.ridge, training_mask),
        )

    def _scatter(self, residuals: Array, kept: NDArray[np.bool_]) -> Array:
        """The scatter S (n, 3, 3) of the residuals around the kept points."""
        errors = residuals[kept]
        weights = np.exp(-0.5 * self._squares[np.ix_(kept, kept)] / self.scales.local**2)
        weights /= weights.sum(axis=1, keepdims=True)
        local = np.einsum("nm,mi,mj->nij", weights, errors, errors)
        if self.isotropic:
            local = np.trace(local, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        local = (1 - _SHARED) * local + _SHARED * max((errors**2).mean(), 1e-12) * np.eye(3)
        scatter = local / (np.trace(local, axis1=1, axis2=2).mean() / 3)
        return np.asarray(
            scatter if self.factors is None else scatter * self.factors[kept, None, None]
        )

    def _spread(self, ell: float, residuals: Array) -> float:
        """The least q under which the residuals are about as likely as under any, at any scale.

        The covariance then grows most off the data.
        """
        scatter = self._scatter(residuals, np.ones(len(self.group), bool))
        if self.isotropic:
            scatter = scatter[:, :1, :1]
        counted = self._counted
        costs = []
        for covariance in held_out_covariances(
            np.exp(-ell * self._squares), scatter, _SPREADS, self.group
        ):
            covariances = (covariance * np.eye(3) if self.isotropic else covariance)[counted]
            scale = mahalanobis(residuals[counted], covariances).mean() / 3
            costs.append(0.5 * (3 * np.log(scale) + np.linalg.slogdet(covariances)[1].mean()))
        return float(preferred(_SPREADS.tolist(), costs, min(costs) + _AS_LIKELY_NAT))

    def _affine(self, ridge: float, kept: NDArray[np.bool_]) -> AffineMean:
        weights = None if self._weights is None else self._weights[kept]
        return ridge_mean(
            self.inputs[kept],
            self.outputs[kept],
            ridge,
            max_gain=self.scales.max_gain,
            weights=weights,
        )


def ridge_mean(
    inputs: Array, outputs: Array, ridge: float, *, max_gain: float, weights: Array | None = None
) -> AffineMean:
    """The affine mean of outputs (N, O) over inputs (N, I) by ridge regression, with the weights W
    (N,) of the points, 1 unless they are given.

    A = Y^T W X (X^T W X + tr(W) ridge^2 I)^-1 for centred X and Y, with the singular values of A
    limited to `max_gain`.
    """
    centre, middle = (np.average(part, axis=0, weights=weights) for part in (inputs, outputs))
    centred = inputs - centre
    total = len(inputs) if weights is None else float(weights.sum())
    weighed = centred if weights is None else weights[:, None] * centred
    square = weighed.T @ centred + total * ridge**2 * np.eye(inputs.shape[1])
    u, gains, v = np.linalg.svd(
        np.linalg.solve(square, weighed.T @ (outputs - middle)).T, full_matrices=False
    )
    matrix = (u * np.minimum(gains, max_gain)) @ v
    return AffineMean(matrix, middle - matrix @ centre)
