"""References straight from the demonstrations, and the hyper-parameters that predict best a
demonstration which is left out.

The prior mean is constant, or linear in the hands where that predicts clearly better: people who
work elsewhere on a table are then followed there, where a constant would hold the tool back. The
mean is that of kernel ridge regression, whose residuals with one demonstration left out come
from one inverse (Rasmussen and Williams 2006, section 5.4.2, for blocks). The covariance must hold
what people do differently and what nobody showed: both are scaled to those residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, AffineMean, GaussianKernel, Gaussians
from service.config import ToolSettings
from service.core.frame import Vector
from service.learning.skill_file import SkillError

ELLS = 2.0 ** np.arange(-1.0, 4.0)  # [1/m²] beyond these, via-points bend everything or nothing
NOISES = 10.0 ** np.arange(-3.0, 0.1, 0.5)  # a reference point's variance over the kernel's, for the mean
SPREADS = 10.0 ** np.arange(-3.0, 1.1, 0.5)  # the same, for the covariance
AS_LIKELY = 0.05  # [nat] less likely is as good: then what grows most off the data
LOCAL_M = 0.08  # distance of hands over which demonstrations are alike in how much they differ
SHARED = 0.15  # of the scatter that is everywhere the same, as few demonstrations tell little of one place
REGIONS = (2.366, 7.815)  # chi-square of three degrees of freedom: the 50 and 95 % regions of a normal in space
CLEARLY = 0.9  # a linear mean must have less than this share of a constant one's error: it extrapolates
RIDGE_M = 0.005  # along which hands hardly moved, as trackers and fingers tremble, the tool is said to stay
MAX_GAIN = ToolSettings().max_gain  # of a linear mean, as of the way between via-points
NOISE_M = 0.001  # of a good tracker, each axis: demonstrations without noise tell no more of people
DWELL = 0.25  # share of the reference points that goes by time, the rest by the hands' way


class Parameters(NamedTuple):
    """What `Choice.primitive` needs."""

    ell: float  # [1/m²] of the kernel
    noise: float  # a reference point's variance over the kernel's, for the mean
    spread: float  # the same, for the covariance
    deviation: float  # [m] standard deviation far from all data
    is_linear: bool = False  # the prior mean


def thinned(hands: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` of the samples (T, 6), (T, 3) [m], evenly along the hands' way and a little
    along the time, so that rests keep some.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(hands, axis=0), axis=1))])
    along = way / max(way[-1], 1e-9) + DWELL * np.linspace(0.0, 1.0, len(way))
    kept = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], count)).clip(0, len(way) - 1))
    return hands[kept], tool[kept]


@dataclass(frozen=True, eq=False)
class Choice:
    """Reference points of H demonstrations: inputs (N, 6), outputs (N, 3) [m], and owners (N,)."""

    inputs: Vector
    outputs: Vector
    owner: NDArray[np.intp]
    alike: bool = False  # whether each point is as sure about all outputs: a covariance is found in a ninth of the time

    @classmethod
    def of(cls, pairs: Sequence[tuple[Vector, Vector]], points: int, *, alike: bool = False) -> Choice:
        """About so many points of the demonstrations' hands (T, 6) and tools (T, 3) [m]."""
        each = max(4, points // len(pairs))
        parts = [thinned(hands, tool, each) for hands, tool in pairs]
        owner = np.repeat(np.arange(len(parts), dtype=np.intp), [len(hands) for hands, _ in parts])
        return cls(np.concatenate([h for h, _ in parts]), np.concatenate([t for _, t in parts]), owner, alike)

    @cached_property
    def _constant(self) -> Vector:
        return np.asarray(self.outputs.mean(axis=0))

    def _kept(self, without: int | None) -> NDArray[np.bool_]:
        return np.ones(len(self.owner), bool) if without is None else self.owner != without

    @cached_property
    def _squares(self) -> Vector:
        return np.asarray(((self.inputs[:, None] - self.inputs) ** 2).sum(axis=2))

    def parameters(self, ell: float | None = None, *, may_be_linear: bool = False) -> Parameters:
        """Those that predict best a demonstration left out, with this ell or the best; over a
        linear mean, where it may be, only if they do so clearly better.

        Raises SkillError for fewer than two demonstrations.
        """
        count = len(np.unique(self.owner))
        if count < 2:
            raise SkillError(
                f"{count} demonstration given: at least 2 needed, as what is learned from the others must predict "
                "each; record another"
            )
        ells = ELLS if ell is None else (ell,)
        error, ell, noise = min((rms(self.residuals(one, noise)), one, noise) for one in ells for noise in NOISES)
        residuals, is_linear = self.residuals(ell, noise), False
        spread = self._spread(ell, residuals)
        if may_be_linear:
            # The kernel's length and the spread stay: off the data the covariance grows as fast,
            # and the gate holds what it would hold over a constant, however straight the way was.
            least, best = min((rms(self.residuals(ell, one, is_linear=True)), one) for one in NOISES)
            if least < CLEARLY * error:
                noise, residuals, is_linear = best, self.residuals(ell, best, is_linear=True), True
        unscaled = Parameters(ell, noise, spread, 1.0, is_linear)
        squares, floors = [], []
        for left_out in range(count):
            mine = self.owner == left_out
            found = self.primitive(unscaled, residuals, without=left_out).predict(self.inputs[mine])
            squares.append(mahalanobis(self.outputs[mine] - found.mean, found.covariance))
            floors.append(NOISE_M**2 * np.trace(np.linalg.inv(found.covariance), axis1=1, axis2=2))
        # Of H demonstrations each is predicted by H - 1 whose scatter was measured on the same few.
        few = (count + 1) / (count - 1)
        scale = max(few * np.concatenate(squares).mean(), np.concatenate(floors).mean()) / 3
        return unscaled._replace(deviation=float(np.sqrt(scale)))

    def residuals(self, ell: float, noise: float, *, is_linear: bool = False) -> Vector:
        """By how far the mean from the other demonstrations misses each point (N, 3) [m]."""
        inverse = np.linalg.inv(np.exp(-ell * self._squares) + noise * np.eye(len(self.inputs)))
        weighted, out = inverse @ (self.outputs - self._constant), np.empty_like(self.outputs)
        for h in np.unique(self.owner):
            mine = self.owner == h
            if is_linear:
                weighted = inverse @ self._departures[h]
            out[mine] = np.linalg.solve(inverse[np.ix_(mine, mine)], weighted[mine])
        return out

    @cached_property
    def _departures(self) -> dict[int, Vector]:
        """By how much outputs (N, 3) depart from the linear mean without each demonstration."""
        out = {}
        for h in np.unique(self.owner).tolist():
            kept = self._kept(h)
            mean = ridge(self.inputs[kept], self.outputs[kept])
            out[h] = self.outputs - self.inputs @ mean.matrix.T - mean.offset
        return out

    def primitive(self, parameters: Parameters, residuals: Vector, *, without: int | None = None) -> KMP:
        """The primitive of all demonstrations but one.

        The covariance of IJRR 2019 has two free scales: with N / lambda_c the square of `deviation`
        it comes to that far from the data, and Sigma is then what gives each point its `spread`.
        """
        kept = self._kept(without)
        lambda_covariance = kept.sum() / parameters.deviation**2
        size = parameters.spread / lambda_covariance
        return KMP.fit(
            self.inputs[kept],
            Gaussians(self.outputs[kept], size * self._scatter(residuals, kept)),
            kernel=GaussianKernel(parameters.ell),
            lambda_mean=parameters.noise / size,
            lambda_covariance=lambda_covariance,
            prior_mean=ridge(self.inputs[kept], self.outputs[kept]) if parameters.is_linear else self._constant,
        )

    def _scatter(self, residuals: Vector, kept: NDArray[np.bool_]) -> Vector:
        """Scatter (n, 3, 3) of the residuals around each of the kept points, over its mean."""
        known = residuals[kept]
        near = np.exp(-0.5 * self._squares[np.ix_(kept, kept)] / LOCAL_M**2)
        near /= near.sum(axis=1, keepdims=True)
        local = np.einsum("nm,mi,mj->nij", near, known, known)
        if self.alike:
            local = np.trace(local, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        local = (1 - SHARED) * local + SHARED * max((known**2).mean(), 1e-12) * np.eye(3)
        return np.asarray(local / (np.trace(local, axis1=1, axis2=2).mean() / 3))

    def _spread(self, ell: float, residuals: Vector) -> float:
        """The spread under which these residuals are most likely, at whatever scale; of those as
        likely the least, with which the covariance grows most off the data.
        """
        everyone = np.ones(len(self.owner), bool)
        kernel, scatter = np.exp(-ell * self._squares), self._scatter(residuals, everyone)
        likelihoods = []
        for spread in SPREADS:
            covariance = self._left_out(kernel, spread * scatter)
            scale = mahalanobis(residuals, covariance).mean() / 3
            likelihoods.append(0.5 * (3 * np.log(scale) + np.linalg.slogdet(covariance)[1].mean()))
        return float(SPREADS[np.flatnonzero(np.array(likelihoods) <= min(likelihoods) + AS_LIKELY)[0]])

    def _left_out(self, kernel: Vector, noise: Vector) -> Vector:
        """The covariance (N, 3, 3) at each point given the other demonstrations, in the kernel's
        units, with the noise (N, 3, 3) of the points.
        """
        count = len(kernel)
        total = np.einsum("nm,ij->nimj", kernel, np.eye(3))
        total[np.arange(count), :, np.arange(count), :] += noise
        inverse = np.linalg.inv(total.reshape(3 * count, 3 * count))
        out = np.empty((count, 3, 3))
        for h in np.unique(self.owner):
            mine = np.flatnonzero(self.owner == h)
            rows = (3 * mine[:, None] + np.arange(3)).ravel()
            block = np.linalg.inv(inverse[np.ix_(rows, rows)]).reshape(len(mine), 3, len(mine), 3)
            each = np.arange(len(mine))
            out[mine] = block[each, :, each, :] - noise[mine]
        return 0.5 * (out + out.transpose(0, 2, 1))


def ridge(hands: Vector, tool: Vector) -> AffineMean:
    """The linear mean of a tool (N, 3) [m] for hands (N, 6) [m], by ridge regression; its gain is
    MAX_GAIN at most.
    """
    centre, middle = hands.mean(axis=0), tool.mean(axis=0)
    off = hands - centre
    square = off.T @ off + len(hands) * RIDGE_M**2 * np.eye(hands.shape[1])
    u, gains, v = np.linalg.svd(np.linalg.solve(square, off.T @ (tool - middle)).T, full_matrices=False)
    matrix = (u * np.minimum(gains, MAX_GAIN)) @ v
    return AffineMean(matrix, middle - matrix @ centre)


def rms(errors: Vector) -> float:
    """Root mean square length of errors (M, 3) [m]."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def mahalanobis(errors: Vector, covariance: Vector) -> Vector:
    """Squared Mahalanobis distances (M,) of errors (M, 3) under covariances (M, 3, 3)."""
    white = np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("ni,ni->n", errors, white))
