"""Primitives straight from demonstrations, with the hyper-parameters that predict held-out persons
best.

The N reference points s_n are samples of the demonstrations, y_n their outputs. The prior mean p is
constant, or affine in the inputs where that predicts clearly better: takes from all over a table
are then predicted everywhere, where a constant mean would hold the tool back. With the kernel's
vector k(s) and matrix K, r = `noise`, q = `spread` and d = `deviation`,

    mean         m(s) = p(s) + k(s) (K + r S)^-1 (y - p)
    covariance   C(s) = d² (k(s, s) - k(s) (K + q S)^-1 k(s)ᵀ)
    scatter      S_n ~ (1 - a) Σ_m w_nm e_m e_mᵀ + a |e|² I,   w_nm ~ exp(-|s_n - s_m|² / (2 l²))

S is scaled so that the mean of its traces is 3; e are the residuals without each point's person,
|e|² the mean of their squared coordinates, a = SHARED, l = LOCAL_M, and the w_nm add up to 1. ell,
r and p are those with the smallest residuals, of (K + r I)^-1; q is the least one under which the
residuals are about as likely as under any. With C_1 the covariance for d = 1, H persons and
sigma = NOISE_M,

    d² = max((H + 1) / (H - 1) mean(eᵀ C_1^-1 e), mean(trace(sigma² C_1^-1))) / 3

as each of H persons is predicted by H - 1 whose scatter was measured on the same few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, AffineMean, GaussianKernel, Gaussians
from kmp.cross_validation import (
    held_out_covariances,
    held_out_residuals,
    mahalanobis,
    preferred,
    rms,
    squared_distances,
)
from service.core.frame import Vector
from service.learning.skill_file import SkillError
from service.settings.config import ToolSettings

ELLS_PER_M2 = 2.0 ** np.arange(-1.0, 4.0)  # beyond these, via-points bend everything or nothing
RICH_ELLS_PER_M2 = 2.0 ** np.arange(-1.0, 6.0)  # inputs with memory or turns are farther from each other
NOISES = 10.0 ** np.arange(-3.0, 0.1, 0.5)  # r = variance of a reference point / variance of the kernel
SPREADS = 10.0 ** np.arange(-3.0, 1.1, 0.5)  # q, the same ratio for the covariance
LIKELIHOOD_TOLERANCE_NAT = 0.05  # a spread less likely by this much counts as equally likely
LOCAL_M = 0.08  # l, the standard deviation of the weights with which residuals are averaged
SHARED = 0.15  # a, the share of the scatter that is the same everywhere
RIDGE_M = 0.005  # an input that varies by less, as trembling hands do, does not move the affine mean
RICH_RIDGES_M = (RIDGE_M, 0.05)  # the second one suppresses inputs that repeat what others tell
LINEAR_SHARE = 0.9  # an affine mean extrapolates, so its error must be below this share of a constant one's
MAX_GAIN = ToolSettings().max_gain  # largest singular value of an affine mean, as between via-points
NOISE_M = 0.001  # sigma, the noise of a good tracker on each axis, which made demonstrations lack
DWELL_SHARE = 0.25  # this share of the reference points is even in time, the rest along the hands' path
LEAST_POINTS = 4  # reference points of a demonstration


class Parameters(NamedTuple):
    """Hyper-parameters of a primitive, see the equations of this module."""

    ell: float  # [1/m²] of the kernel
    noise: float  # r
    spread: float  # q
    deviation: float  # [m] d, the standard deviation far from all data
    ridge_m: float | None = None  # of the affine prior mean; None if the prior mean is constant


def thinned(hands: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` samples of hands (T, 6) and tool (T, 3) [m], evenly along the hands' path and,
    so that rests keep some, a little along time.
    """
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(hands, axis=0), axis=1))])
    along = path / max(path[-1], 1e-9) + DWELL_SHARE * np.linspace(0.0, 1.0, len(path))
    kept = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], count)).clip(0, len(path) - 1))
    return hands[kept], tool[kept]


def even_in_time(inputs: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` samples of inputs (T, I) and tool (T, 3), evenly in time."""
    kept = np.unique(np.linspace(0.0, len(inputs) - 1, count).round().astype(int))
    return inputs[kept], tool[kept]


@dataclass(frozen=True, eq=False)
class Choice:
    """Reference points of demonstrations: inputs (N, I), outputs (N, 3) [m] and the persons (N,)
    that are held out one after the other.
    """

    inputs: Vector
    outputs: Vector
    owner: NDArray[np.intp]
    isotropic: bool = False  # true if S is a multiple of I at each point, which costs a ninth of the time
    rich: bool = False  # true if points are even in time, and the prior mean is chosen with the kernel

    @classmethod
    def of(
        cls,
        pairs: Sequence[tuple[Vector, Vector]],
        points: int,
        *,
        persons: NDArray[np.intp] | None = None,
        isotropic: bool = False,
        rich: bool = False,
    ) -> Choice:
        """About `points` reference points of demonstrations, each inputs (T, I) and tool (T, 3)
        [m], by `persons` (H,); None if each is by another person.
        """
        each = max(LEAST_POINTS, points // len(pairs))
        parts = [(even_in_time if rich else thinned)(inputs, tool, each) for inputs, tool in pairs]
        numbers = np.arange(len(parts), dtype=np.intp) if persons is None else persons
        inputs, outputs = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return cls(inputs, outputs, np.repeat(numbers, [len(one) for one, _ in parts]), isotropic, rich)

    @cached_property
    def _constant(self) -> Vector:
        return np.asarray(self.outputs.mean(axis=0))

    @cached_property
    def _squares(self) -> Vector:
        return squared_distances(self.inputs)

    @cached_property
    def _targets(self) -> dict[tuple[float | None, int], Vector]:
        return {}

    def best_mean(self, ell: float | None = None, *, may_be_linear: bool = False) -> tuple[float, Parameters]:
        """The root mean square residual [m] and the parameters of the best mean, with this ell or
        any of the module's; `spread` and `deviation` are 1.

        Raises SkillError if all points are of one person.
        """
        count = len(np.unique(self.owner))
        if count < 2:
            raise SkillError(
                f"{count} demonstration given: at least 2 needed, as what is learned from the others must predict "
                "each; record another"
            )
        ells, ridges = (RICH_ELLS_PER_M2, RICH_RIDGES_M) if self.rich else (ELLS_PER_M2, (RIDGE_M,))
        ells = ells if ell is None else np.array([ell])
        tried = list(self._tried(ells, (None, *ridges) if may_be_linear and self.rich else (None,)))
        constant = min((one for one in tried if one[1].ridge_m is None), key=lambda one: one[0])
        if not may_be_linear:
            return constant
        # Over positions both means have the same kernel, so off the data the covariance grows
        # equally fast and the gate holds the same hands.
        tried = tried if self.rich else list(self._tried(np.array([constant[1].ell]), ridges))
        linear = min((one for one in tried if one[1].ridge_m is not None), key=lambda one: one[0])
        return linear if linear[0] < (1.0 if self.rich else LINEAR_SHARE) * constant[0] else constant

    def _tried(self, ells: Vector, ridges: Sequence[float | None]) -> Iterator[tuple[float, Parameters]]:
        for ell in ells.tolist():
            for noise, by_ridge in zip(NOISES.tolist(), self._residuals(ell, NOISES, ridges), strict=True):
                for ridge_m, residuals in zip(ridges, by_ridge, strict=True):
                    yield rms(residuals), Parameters(ell, noise, 1.0, 1.0, ridge_m)

    def parameters(self, ell: float | None = None, *, may_be_linear: bool = False) -> Parameters:
        """The parameters that predict held-out persons best, with this ell or any of the module's.

        Raises SkillError if all points are of one person.
        """
        _, unscaled = self.best_mean(ell, may_be_linear=may_be_linear)
        basis = unscaled if self.rich or unscaled.ridge_m is None else self.best_mean(unscaled.ell)[1]
        spread = self._spread(unscaled.ell, self.residuals(basis.ell, basis.noise, basis.ridge_m))
        unscaled = unscaled._replace(spread=spread)
        residuals = self.residuals(unscaled.ell, unscaled.noise, unscaled.ridge_m)
        squares, floors = [], []
        persons = np.unique(self.owner)
        for person in persons.tolist():
            mine = self.owner == person
            found = self.primitive(unscaled, residuals, without=person).predict(self.inputs[mine])
            squares.append(mahalanobis(self.outputs[mine] - found.mean, found.covariance))
            floors.append(NOISE_M**2 * np.trace(np.linalg.inv(found.covariance), axis1=1, axis2=2))
        few = (len(persons) + 1) / (len(persons) - 1)
        scale = max(few * np.concatenate(squares).mean(), np.concatenate(floors).mean()) / 3
        return unscaled._replace(deviation=float(np.sqrt(scale)))

    def residuals(self, ell: float, noise: float, ridge_m: float | None = None) -> Vector:
        """The residuals (N, 3) [m] of each point without its person."""
        return np.asarray(self._residuals(ell, np.array([noise]), (ridge_m,))[0, 0])

    def _residuals(self, ell: float, noises: Vector, ridges: Sequence[float | None]) -> Vector:
        """The residuals (J, R, N, 3) [m] for noises (J,) and prior means of these ridges (R,)."""
        kernel, shape = np.exp(-ell * self._squares), (len(noises), len(self.owner), len(ridges), 3)
        found = held_out_residuals(
            kernel, noises, self.owner, lambda person: np.hstack([self._target(ridge_m, person) for ridge_m in ridges])
        )
        return np.asarray(found.reshape(shape).swapaxes(1, 2))

    def _target(self, ridge_m: float | None, without: int) -> Vector:
        """The outputs (N, 3) minus the prior mean that is fitted without a person."""
        if ridge_m is None:
            return np.asarray(self.outputs - self._constant)
        if (ridge_m, without) not in self._targets:
            kept = self.owner != without
            mean = ridge(self.inputs[kept], self.outputs[kept], ridge_m)
            self._targets[ridge_m, without] = self.outputs - self.inputs @ mean.matrix.T - mean.offset
        return self._targets[ridge_m, without]

    def primitive(self, parameters: Parameters, residuals: Vector, *, without: int | None = None) -> KMP:
        """The primitive of all persons but one, with the covariance of IJRR 2019:
        N / lambda_c = d² and lambda_c Sigma_n = q S_n; for the mean, lambda Sigma_n = r S_n.
        """
        kept = np.ones(len(self.owner), bool) if without is None else self.owner != without
        lambda_covariance = kept.sum() / parameters.deviation**2
        size = parameters.spread / lambda_covariance
        return KMP.fit(
            self.inputs[kept],
            Gaussians(self.outputs[kept], size * self._scatter(residuals, kept)),
            kernel=GaussianKernel(parameters.ell),
            lambda_mean=parameters.noise / size,
            lambda_covariance=lambda_covariance,
            prior_mean=self._constant
            if parameters.ridge_m is None
            else ridge(self.inputs[kept], self.outputs[kept], parameters.ridge_m),
        )

    def _scatter(self, residuals: Vector, kept: NDArray[np.bool_]) -> Vector:
        """The scatter S (n, 3, 3) of the residuals around the kept points."""
        known = residuals[kept]
        weights = np.exp(-0.5 * self._squares[np.ix_(kept, kept)] / LOCAL_M**2)
        weights /= weights.sum(axis=1, keepdims=True)
        local = np.einsum("nm,mi,mj->nij", weights, known, known)
        if self.isotropic:
            local = np.trace(local, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        local = (1 - SHARED) * local + SHARED * max((known**2).mean(), 1e-12) * np.eye(3)
        return np.asarray(local / (np.trace(local, axis1=1, axis2=2).mean() / 3))

    def _spread(self, ell: float, residuals: Vector) -> float:
        """The least q under which the residuals are about as likely as under any, at any scale; the
        covariance then grows most off the data.
        """
        scatter = self._scatter(residuals, np.ones(len(self.owner), bool))
        if self.isotropic:
            scatter = scatter[:, :1, :1]
        costs = []
        for covariance in held_out_covariances(np.exp(-ell * self._squares), scatter, SPREADS, self.owner):
            covariances = covariance * np.eye(3) if self.isotropic else covariance
            scale = mahalanobis(residuals, covariances).mean() / 3
            costs.append(0.5 * (3 * np.log(scale) + np.linalg.slogdet(covariances)[1].mean()))
        return float(preferred(SPREADS.tolist(), costs, min(costs) + LIKELIHOOD_TOLERANCE_NAT))


def ridge(inputs: Vector, outputs: Vector, ridge_m: float = RIDGE_M) -> AffineMean:
    """The affine mean of outputs (N, 3) [m] over inputs (N, I) [m] by ridge regression,

        A = Yᵀ X (Xᵀ X + N ridge_m² I)^-1

    for centred X and Y, with the singular values of A limited to MAX_GAIN.
    """
    centre, middle = inputs.mean(axis=0), outputs.mean(axis=0)
    off = inputs - centre
    square = off.T @ off + len(inputs) * ridge_m**2 * np.eye(inputs.shape[1])
    u, gains, v = np.linalg.svd(np.linalg.solve(square, off.T @ (outputs - middle)).T, full_matrices=False)
    matrix = (u * np.minimum(gains, MAX_GAIN)) @ v
    return AffineMean(matrix, middle - matrix @ centre)
