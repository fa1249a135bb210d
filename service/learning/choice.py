"""References straight from the demonstrations, and the hyper-parameters that predict best a
demonstration which is left out.

The prior mean is constant, or linear in the hands where that predicts clearly better: people who
work elsewhere on a table are then followed there, where a constant would hold the tool back. The
mean is that of kernel ridge regression, whose residuals with one demonstration left out come
from one inverse (Rasmussen and Williams 2006, section 5.4.2, for blocks). The covariance must hold
what people do differently and what nobody showed: both are scaled to those residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, AffineMean, GaussianKernel, Gaussians
from service.core.frame import Vector
from service.learning.skill_file import SkillError
from service.settings.config import ToolSettings

ELLS = 2.0 ** np.arange(-1.0, 4.0)  # [1/m²] beyond these, via-points bend everything or nothing
NARROW = 2.0 ** np.arange(-1.0, 6.0)  # [1/m²] of more inputs than positions: hands are farther from each other there
NOISES = 10.0 ** np.arange(-3.0, 0.1, 0.5)  # a reference point's variance over the kernel's, for the mean
SPREADS = 10.0 ** np.arange(-3.0, 1.1, 0.5)  # the same, for the covariance
AS_LIKELY = 0.05  # [nat] less likely is as good: then what grows most off the data
LOCAL_M = 0.08  # distance of hands over which demonstrations are alike in how much they differ
SHARED = 0.15  # of the scatter that is everywhere the same, as few demonstrations tell little of one place
REGIONS = (2.366, 7.815)  # chi-square of three degrees of freedom: the 50 and 95 % regions of a normal in space
CLEARLY = 0.9  # a linear mean must have less than this share of a constant one's error: it extrapolates
RIDGE_M = 0.005  # along which hands hardly moved, as trackers and fingers tremble, the tool is said to stay
RIDGES = (RIDGE_M, 0.05)  # [m] of more inputs than positions, of which some tell nothing that others do not
MAX_GAIN = ToolSettings().max_gain  # of a linear mean, as of the way between via-points
NOISE_M = 0.001  # of a good tracker, each axis: demonstrations without noise tell no more of people
DWELL = 0.25  # share of the reference points that goes by time, the rest by the hands' way


class Parameters(NamedTuple):
    """What `Choice.primitive` needs."""

    ell: float  # [1/m²] of the kernel
    noise: float  # a reference point's variance over the kernel's, for the mean
    spread: float  # the same, for the covariance
    deviation: float  # [m] standard deviation far from all data
    ridge_m: float | None = None  # of the linear prior mean; None: it is constant


def thinned(hands: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` of the samples (T, 6), (T, 3) [m], evenly along the hands' way and a little
    along the time, so that rests keep some.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(hands, axis=0), axis=1))])
    along = way / max(way[-1], 1e-9) + DWELL * np.linspace(0.0, 1.0, len(way))
    kept = np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], count)).clip(0, len(way) - 1))
    return hands[kept], tool[kept]


def in_time(inputs: Vector, tool: Vector, count: int) -> tuple[Vector, Vector]:
    """About `count` of the samples (T, I), (T, 3), evenly in time, as an error counts at any."""
    kept = np.unique(np.linspace(0.0, len(inputs) - 1, count).round().astype(int))
    return inputs[kept], tool[kept]


@dataclass(frozen=True, eq=False)
class Choice:
    """Reference points of H demonstrations: inputs (N, I), outputs (N, 3) [m], and owners (N,),
    which are left out one after the other: a demonstration, or those of a person.
    """

    inputs: Vector
    outputs: Vector
    owner: NDArray[np.intp]
    alike: bool = False  # whether each point is as sure about all outputs: a covariance is found in a ninth of the time
    even: bool = False  # whether the points are even in time, and the mean beneath chosen with the kernel

    @classmethod
    def of(
        cls,
        pairs: Sequence[tuple[Vector, Vector]],
        points: int,
        *,
        together: NDArray[np.intp] | None = None,
        alike: bool = False,
        even: bool = False,
    ) -> Choice:
        """About so many points of the demonstrations' inputs (T, I) and tools (T, 3) [m], of which
        those are left out `together` (H,) that have the same number; each alone, if not given.
        """
        each = max(4, points // len(pairs))
        parts = [(in_time if even else thinned)(hands, tool, each) for hands, tool in pairs]
        numbers = np.arange(len(parts), dtype=np.intp) if together is None else together
        owner = np.repeat(numbers, [len(hands) for hands, _ in parts])
        return cls(np.concatenate([h for h, _ in parts]), np.concatenate([t for _, t in parts]), owner, alike, even)

    @cached_property
    def _constant(self) -> Vector:
        return np.asarray(self.outputs.mean(axis=0))

    def _kept(self, without: int | None) -> NDArray[np.bool_]:
        return np.ones(len(self.owner), bool) if without is None else self.owner != without

    @cached_property
    def _squares(self) -> Vector:
        norms = (self.inputs**2).sum(axis=1)
        squares = norms[:, None] + norms - 2.0 * self.inputs @ self.inputs.T
        return np.asarray(np.maximum(0.5 * (squares + squares.T), 0.0))

    def mean(self, ell: float | None = None, *, may_be_linear: bool = False) -> tuple[float, Parameters]:
        """The root mean square error [m] and the parameters of the mean that predicts best a
        demonstration left out, with this ell or the best; `spread` and `deviation` say nothing yet.

        Raises SkillError where nothing can be left out.
        """
        count = len(np.unique(self.owner))
        if count < 2:
            raise SkillError(
                f"{count} demonstration given: at least 2 needed, as what is learned from the others must predict "
                "each; record another"
            )
        ells, ridges = (NARROW, RIDGES) if self.even else (ELLS, (RIDGE_M,))
        ells = ells if ell is None else np.array([ell])
        beneath = (None, *ridges) if may_be_linear and self.even else (None,)
        tried = list(self._tried(ells, beneath))
        constant = min((one for one in tried if one[1].ridge_m is None), key=lambda one: one[0])
        if not may_be_linear:
            return constant
        # Of positions the kernel's length stays: off the data the covariance grows as fast, and the
        # gate holds what it would hold over a constant, however straight the way was.
        tried = tried if self.even else list(self._tried(np.array([constant[1].ell]), ridges))
        linear = min((one for one in tried if one[1].ridge_m is not None), key=lambda one: one[0])
        return linear if linear[0] < (1.0 if self.even else CLEARLY) * constant[0] else constant

    def _tried(self, ells: Vector, ridges: Sequence[float | None]) -> Iterator[tuple[float, Parameters]]:
        for ell in ells.tolist():
            for noise, missed in zip(NOISES.tolist(), self._missed(ell, NOISES, ridges), strict=True):
                for ridge_m, residuals in zip(ridges, missed, strict=True):
                    yield rms(residuals), Parameters(ell, noise, 1.0, 1.0, ridge_m)

    def parameters(self, ell: float | None = None, *, may_be_linear: bool = False) -> Parameters:
        """Those that predict best a demonstration left out, with this ell or the best; over a
        linear mean, where it may be, only if they do so clearly better.

        Raises SkillError where nothing can be left out.
        """
        _, unscaled = self.mean(ell, may_be_linear=may_be_linear)
        over = unscaled if self.even or unscaled.ridge_m is None else self.mean(unscaled.ell)[1]
        spread = self._spread(unscaled.ell, self.residuals(over.ell, over.noise, over.ridge_m))
        unscaled = unscaled._replace(spread=spread)
        residuals = self.residuals(unscaled.ell, unscaled.noise, unscaled.ridge_m)
        squares, floors = [], []
        owners = np.unique(self.owner)
        for left_out in owners.tolist():
            mine = self.owner == left_out
            found = self.primitive(unscaled, residuals, without=left_out).predict(self.inputs[mine])
            squares.append(mahalanobis(self.outputs[mine] - found.mean, found.covariance))
            floors.append(NOISE_M**2 * np.trace(np.linalg.inv(found.covariance), axis1=1, axis2=2))
        # Of H demonstrations each is predicted by H - 1 whose scatter was measured on the same few.
        few = (len(owners) + 1) / (len(owners) - 1)
        scale = max(few * np.concatenate(squares).mean(), np.concatenate(floors).mean()) / 3
        return unscaled._replace(deviation=float(np.sqrt(scale)))

    def residuals(self, ell: float, noise: float, ridge_m: float | None = None) -> Vector:
        """By how far the mean from the other demonstrations misses each point (N, 3) [m]."""
        return np.asarray(self._missed(ell, np.array([noise]), (ridge_m,))[0, 0])

    def _missed(self, ell: float, noises: Vector, ridges: Sequence[float | None]) -> Vector:
        """The residuals (J, R, N, 3) [m] with each noise (J,) over each mean beneath (R,): by one
        eigendecomposition, as noise moves eigenvalues alone.
        """
        values, vectors = np.linalg.eigh(np.exp(-ell * self._squares))
        out = np.empty((len(noises), len(ridges), *self.outputs.shape))
        for h in np.unique(self.owner).tolist():
            mine, departures = self.owner == h, [self._departures(ridge_m)[h] for ridge_m in ridges]
            rows = vectors[mine] / (values + noises[:, None])[:, None]
            missed = np.linalg.solve(rows @ vectors[mine].T, rows @ (vectors.T @ np.hstack(departures)))
            out[:, :, mine] = missed.reshape(*missed.shape[:2], len(ridges), 3).swapaxes(1, 2)
        return out

    def _departures(self, ridge_m: float | None) -> dict[int, Vector]:
        """By how much outputs (N, 3) depart from the mean beneath, without each demonstration."""
        if ridge_m not in self._known:
            owners = np.unique(self.owner).tolist()
            self._known[ridge_m] = {h: self._departing(ridge_m, self._kept(h)) for h in owners}
        return self._known[ridge_m]

    @cached_property
    def _known(self) -> dict[float | None, dict[int, Vector]]:
        return {}

    def _departing(self, ridge_m: float | None, kept: NDArray[np.bool_]) -> Vector:
        if ridge_m is None:
            return np.asarray(self.outputs - self._constant)
        mean = ridge(self.inputs[kept], self.outputs[kept], ridge_m)
        return np.asarray(self.outputs - self.inputs @ mean.matrix.T - mean.offset)

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
            prior_mean=self._constant
            if parameters.ridge_m is None
            else ridge(self.inputs[kept], self.outputs[kept], parameters.ridge_m),
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
        scatter = self._scatter(residuals, np.ones(len(self.owner), bool))
        likelihoods = []
        for covariance in self._left_out(np.exp(-ell * self._squares), scatter):
            scale = mahalanobis(residuals, covariance).mean() / 3
            likelihoods.append(0.5 * (3 * np.log(scale) + np.linalg.slogdet(covariance)[1].mean()))
        return float(SPREADS[np.flatnonzero(np.array(likelihoods) <= min(likelihoods) + AS_LIKELY)[0]])

    def _left_out(self, kernel: Vector, scatter: Vector) -> Vector:
        """The covariances (J, N, 3, 3) at each point given the other demonstrations, in units of
        the kernel, where the points' noise is each of SPREADS (J,) times their scatter (N, 3, 3):
        by one eigendecomposition of the kernel over that, of one output where all are alike.
        """
        roots = np.linalg.cholesky(scatter[:, :1, :1] if self.alike else scatter)
        white, (count, width, _) = np.linalg.inv(roots), roots.shape
        total = np.einsum("nm,nik,mjk->nimj", kernel, white, white, optimize=True).reshape(2 * [count * width])
        values, vectors = np.linalg.eigh(total)
        out = np.empty((len(SPREADS), count, width, width))
        for h in np.unique(self.owner):
            mine = np.flatnonzero(self.owner == h)
            rows, each = vectors[(width * mine[:, None] + np.arange(width)).ravel()], np.arange(len(mine))
            blocks = np.linalg.inv(rows / (values + SPREADS[:, None])[:, None] @ rows.T)
            found = blocks.reshape(-1, len(mine), width, len(mine), width)[:, each, :, each].swapaxes(0, 1)
            out[:, mine] = roots[mine] @ (found - SPREADS[:, None, None, None] * np.eye(width)) @ roots[mine].mT
        return 0.5 * (out + out.mT) * np.eye(3) if self.alike else 0.5 * (out + out.mT)


def ridge(hands: Vector, tool: Vector, ridge_m: float = RIDGE_M) -> AffineMean:
    """The linear mean of a tool (N, 3) [m] for inputs (N, I) [m], by ridge regression; its gain is
    MAX_GAIN at most.
    """
    centre, middle = hands.mean(axis=0), tool.mean(axis=0)
    off = hands - centre
    square = off.T @ off + len(hands) * ridge_m**2 * np.eye(hands.shape[1])
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
