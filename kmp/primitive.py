"""The kernelized movement primitive: the output at any input, and how sure it is (the paper, sections II-B, II-C)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack
from scipy.spatial.distance import cdist

from kmp import storage
from kmp.bound import error_bound
from kmp.checks import Array, RankReached, numbers, positive
from kmp.dense import Dense
from kmp.features import Features
from kmp.gaussians import Gaussians, check_pairs, warn_of_missed
from kmp.immutable import Immutable, frozen
from kmp.kernel import Kernel, spread
from kmp.low_rank import Conditioned, LowRank
from kmp.problem import Problem

_BATCH = 256  # queries at once, which bounds the memory of `predict`
_DISTANCES = 10_000_000  # from via-points to the base's points, at once
_ROWS = 8192  # reference points at once
_MACHINE = float(np.finfo(np.float64).eps)
_SMALL = 1500  # N O up to which the dense solution is the faster one
_LARGE = 6000  # N O beyond which the dense solution takes seconds and 300 MB
_RANK = 400
_TOLERANCE = 4e-12  # share of k(s, s) that the features may leave at a reference point
_ROUNDING = 1e-12  # share that rounding may leave, whatever was asked for
_LEFT = 1e-10  # the same, for the uncertainty that is distance from the data


@dataclass(frozen=True)
class Uncertainty(Immutable):
    """The covariance of `predict` in two parts, each (M, O, O) [unit of the outputs^2], whose sum it is."""

    variability: Array
    """How much the demonstrations differ from each other there."""
    distance: Array
    """How far the query is from the data: what would remain if each reference point were exact."""


@dataclass(frozen=True, eq=False)
class KMP(Immutable):
    """A skill: the reference database, the via-points in it, and its solution. From `fit`, `adapt`, `from_arrays`.

    N points in all, I inputs, O outputs. Immutable, so that threads may share it. `inputs` (N, I) and `reference` (N)
    are the database after adaptation: the points of `base` that were not replaced, then `via_inputs` with `via_points`.
    What is fitted depends on the fields alone, bit for bit, however the primitive came about.
    """

    kernel: Kernel
    problem: Problem
    own_inputs: Array
    """The base's points, or after an adaptation the via-points."""
    own_reference: Gaussians
    replaced: NDArray[np.intp]
    """(R,) the indices of the base's points that via-points took the place of, ascending."""
    origin: KMP | None
    """The base, or None in the base itself."""
    solution: Dense | LowRank | Conditioned

    @classmethod
    def fit(
        cls,
        inputs: ArrayLike,
        reference: Gaussians,
        *,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None = None,
        prior_mean: ArrayLike | None = None,
        representation: Literal["auto", "dense", "low_rank"] = "auto",
        rank: int = _RANK,
        rank_tolerance: float = _TOLERANCE,
    ) -> KMP:
        """The primitive of a reference database: inputs (N, I), N normals over O outputs.

        `prior_mean` (O,) [unit of the outputs] is what the mean returns to far from the inputs, the origin by default.
        `lambda_covariance` None is `lambda_mean`; another value costs a second factor.

        `representation`: "dense" solves equation (9), N O x N O numbers; "low_rank" solves the cost (4) on at most
        `rank` features of the kernel, which leave a share of at most `rank_tolerance` of it at the inputs. "auto" is
        dense for few points or where the rank does not suffice, and low rank for many. A rank that did not suffice is
        said in a `RankReached` warning, with the accuracy that was lost.
        """
        s = numbers("inputs", inputs, "N", "I")
        if len(s) == 0:
            raise ValueError("inputs: no reference point given, at least 1 needed.")
        problem = Problem.of(s, reference, kernel, lambda_mean=lambda_mean, lambda_covariance=lambda_covariance, prior_mean=prior_mean)
        if representation not in {"auto", "dense", "low_rank"}:
            raise ValueError(f"representation: {representation!r} given, 'auto', 'dense' or 'low_rank' needed.")
        if rank < 1:
            raise ValueError(f"rank is {rank}, and must be at least 1.")
        positive("rank_tolerance", rank_tolerance)
        size = reference.mean.size
        if representation == "dense" or (representation == "auto" and size <= _SMALL):
            return cls.of_base(s, reference, problem, Dense(kernel, problem, s, reference).solved())
        features, left = Features.of(kernel, s, rank=rank, tolerance=rank_tolerance)
        reached = len(features.pivots) >= rank
        enough = left <= max(rank_tolerance if reached else 100 * rank_tolerance, _ROUNDING)
        if representation == "auto" and not enough and size <= _LARGE:
            return cls.of_base(s, reference, problem, Dense(kernel, problem, s, reference).solved())
        self = cls.of_base(s, reference, problem, LowRank.fit(features, problem, s, reference).solved())
        if not enough:
            warnings.warn(
                f"rank: {rank} features leave up to {left:.2g} of the kernel at the {len(s)} inputs, and "
                f"{rank_tolerance:.2g} was asked for: the mean at them may be off by up to {self.error_bound:.2g} "
                "[unit of the outputs]. Raise the rank, or take a smaller ell or fewer points with the dense solution.",
                RankReached,
                stacklevel=2,
            )
        return self

    def mean(self, queries: ArrayLike) -> Array:
        """xi(s) at queries (M, I): (M, O). Equation (8). One query alone may differ by rounding from it in a set."""
        s = self._checked(queries)
        if len(s) == 1:
            return self._mean_of(self.kernel.row_at(s - self._centres))
        mean = (self.kernel(s, self._centres) @ self._weights).reshape(len(s), self.outputs) + self._prior
        for n in np.flatnonzero(np.isnan(mean[:, 0]))[:1]:
            raise ValueError(f"queries[{n}]: {s[n]} given, and every number must be finite.")
        return mean

    def predict(self, queries: ArrayLike) -> Gaussians:
        """xi(s) with its covariance at queries (M, I): M normals. The mean is that of `mean`, bit for bit.

        Covariance: N / lambda_c (k(s, s) I - k (K + lambda_c Sigma)^-1 k^T), IJRR 2019.
        The first prediction inverts the triangular factor: make one before there is a deadline.
        """
        s = self._checked(queries)
        solution = self.solution
        if len(s) == 1:
            row = self.kernel.row_at(s - self._centres)
            mean = self._mean_of(row)
            unexplained = solution.unexplained_one(row)[None]
        else:
            mean = self.mean(s)
            parts = [solution.unexplained(self.kernel(s[i : i + _BATCH], solution.centres)) for i in range(0, len(s), _BATCH)]
            unexplained = np.concatenate(parts) if parts else np.empty((0, self.outputs, self.outputs))
        return Gaussians.trusted(mean, _positive(unexplained) * (self._count / self.problem.lambda_covariance))

    def uncertainty(self, queries: ArrayLike) -> Uncertainty:
        """The covariance at queries (M, I), split: how the demonstrations vary, and how far away they are.

        The second is what IJRR 2019's covariance would be with Sigma = 0.
        """
        s = self._checked(queries)
        total = self.predict(s).covariance
        c = self.kernel.channels
        z = self._spanned(s).T.reshape(len(s), c, -1)
        left = _positive(spread(self.kernel.own - z @ z.transpose(0, 2, 1), self.outputs // c))
        distance = left * (self._count / self.problem.lambda_covariance)
        return Uncertainty(frozen(_positive(total - distance)), frozen(distance))

    def jacobian(self, query: ArrayLike) -> Array:
        """dxi/ds at one query (I,): (O, I) [unit of the outputs / unit of the inputs]. Equation (8), derived."""
        offsets = self._checked_one("query", query) - self._centres
        return _finite(self.kernel.jacobian_of(offsets, self._weight_rows))

    def curvature(self, query: ArrayLike, direction: ArrayLike) -> Array:
        """d^2 xi(s + t v)/dt^2 at t = 0, for one query s (I,), direction v (I,): (O,). Equation (8), derived twice.

        Where v is the velocity of the input, this is the part of the output's acceleration that the velocity makes.
        """
        offsets = self._checked_one("query", query) - self._centres
        return self.kernel.curvature_of(offsets, self._checked_one("direction", direction), self._weights)

    def adapt(self, inputs: ArrayLike, desired: Gaussians, *, tolerance: float) -> KMP:
        """A new primitive that also goes through the desired points: inputs (V, I), V normals. Algorithm 1.

        A desired point nearer than `tolerance` [unit of the inputs] to a point of the *base's* reference takes the
        place of its nearest one (of all, where several are equally near); any other is inserted. The order of
        the desired points does not matter. Earlier via-points stay: to be rid of them, adapt `base` anew.

        A desired point that is then missed by more than 3 of its deviations, and by more than 0.001 (1 mm, where the
        unit is the metre), is named in a `ViaPointMissed` warning.
        """
        via = numbers("inputs", inputs, "V", self._dimensions)
        check_pairs(via, desired, self.outputs)
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance:g}, and must not be below 0.")
        if len(via) == 0:
            return self
        base = self.base
        claimed = np.zeros(len(base.inputs), dtype=bool)
        claimed[self.replaced] = True
        step = max(1, _DISTANCES // len(claimed))
        for i in range(0, len(via), step):
            distance = cdist(via[i : i + step], base.inputs)  # (V, N of the base)
            nearest = distance.min(axis=1, keepdims=True)
            claimed |= ((distance == nearest) & (nearest < tolerance)).any(axis=0)
        adapted = base.changed(
            np.flatnonzero(claimed),
            np.concatenate([self.via_inputs, via]),
            Gaussians.concatenated([self.via_points, desired]),
        )
        adapted.solution.solved()
        warn_of_missed(desired, adapted.mean(via), self.kernel.channels)
        return adapted

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All that `from_arrays` needs, by name: base and via-points apart, their fitted weights, the parameters."""
        return storage.to_arrays(self)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> KMP:
        """The primitive that `to_arrays` gave these arrays for, with its very weights. Other names are left alone.

        Nothing is fitted here: the factors are made when `predict` or `adapt` first asks for them, and come out the
        same bit for bit, given the same libraries and kind of processor.
        """
        return storage.from_arrays(cls, arrays)

    @property
    def lambda_mean(self) -> float:
        """lambda of equation (9)."""
        return self.problem.lambda_mean

    @property
    def lambda_covariance(self) -> float:
        """lambda of the covariance."""
        return self.problem.lambda_covariance

    @property
    def prior_mean(self) -> Array:
        """(O,) what the mean returns to far from the inputs."""
        return self.problem.prior_mean

    @property
    def base(self) -> KMP:
        """The primitive before any adaptation: itself, if there was none."""
        return self.origin or self

    @cached_property
    def inputs(self) -> Array:
        """(N, I) where the reference points are: the base's that were not replaced, then the via-points."""
        if isinstance(self.solution, Dense):
            return self.solution.inputs
        if self.origin is None:
            return self.own_inputs
        return _changed(self.origin, self.replaced, self.own_inputs, self.own_reference)[0]

    @cached_property
    def reference(self) -> Gaussians:
        """The N reference points."""
        if isinstance(self.solution, Dense):
            return self.solution.reference
        if self.origin is None:
            return self.own_reference
        return _changed(self.origin, self.replaced, self.own_inputs, self.own_reference)[1]

    @property
    def via_inputs(self) -> Array:
        """(V, I) where the via-points are."""
        return self.own_inputs[:0] if self.origin is None else self.own_inputs

    @property
    def via_points(self) -> Gaussians:
        """The V via-points."""
        return self.own_reference.take(slice(0, 0)) if self.origin is None else self.own_reference

    @property
    def outputs(self) -> int:
        """O."""
        return self.own_reference.outputs

    @property
    def representation(self) -> Literal["dense", "low_rank"]:
        """How the primitive is solved."""
        return "dense" if isinstance(self.solution, Dense) else "low_rank"

    @property
    def weights(self) -> Array:
        """The weights of equation (8): alpha (N, O) of equation (9), or those of the low rank solution's centres."""
        return self.solution.weights

    @cached_property
    def error_bound(self) -> float:
        """How far the mean at the reference points can be from the dense solution's [unit of the outputs], at most.

        0 for the dense solution; rigorous but for rounding, and pessimistic by one to three orders.
        """
        if isinstance(self.solution, Dense):
            return 0.0
        mean = np.concatenate([self.mean(self.inputs[i : i + _ROWS]) for i in range(0, self._count, _ROWS)])
        return error_bound(self.solution, self.inputs, self.reference, mean, lambda_mean=self.problem.lambda_mean)

    @cached_property
    def _prior(self) -> Array:
        return self.problem.prior_mean

    @cached_property
    def _centres(self) -> Array:
        return self.solution.centres

    @cached_property
    def _weights(self) -> Array:
        return self.solution.weights.reshape(-1, self.outputs // self.kernel.channels)

    @cached_property
    def _weight_rows(self) -> Array:
        return frozen(np.ascontiguousarray(self._weights.T))

    @cached_property
    def _spanned(self) -> Features:
        centres = self.solution.centres
        return Features.of(self.kernel, centres, rank=len(centres), tolerance=_LEFT)[0]

    @cached_property
    def _dimensions(self) -> int:
        return int(self.own_inputs.shape[1])

    @cached_property
    def _count(self) -> int:
        return len(self.own_inputs) + (0 if self.origin is None else len(self.origin.own_inputs) - len(self.replaced))

    @classmethod
    def of_base(cls, inputs: Array, reference: Gaussians, problem: Problem, solution: Dense | LowRank) -> KMP:
        """The primitive before any adaptation, of a database and its solution."""
        nothing = frozen(np.empty(0, dtype=np.intp))
        return cls(solution.kernel, problem, inputs, reference, nothing, None, solution)

    def changed(self, replaced: NDArray[np.intp], via_inputs: Array, via_points: Gaussians) -> KMP:
        """The primitive with these via-points, and without those points of this base whose indices are given."""
        solution: Dense | LowRank | Conditioned = self.solution
        if isinstance(solution, Dense):
            same = int(replaced[0]) if len(replaced) else len(self.inputs)
            solution = solution.adapted(same, *_changed(self, replaced, via_inputs, via_points))
        elif isinstance(solution, LowRank) and len(replaced) + len(via_inputs) <= len(solution.centres):
            changed = np.concatenate([via_inputs, self.inputs[replaced]])
            points = Gaussians.concatenated([via_points, self.reference.take(replaced)])
            solution = Conditioned(solution, frozen(changed), points, len(via_inputs))
        else:  # so many changes cost more, and lose more digits, than a new solution
            inputs, reference = _changed(self, replaced, via_inputs, via_points)
            rank = max(_RANK, len(solution.centres) + len(via_inputs))
            features, _ = Features.of(self.kernel, inputs, rank=rank, tolerance=_TOLERANCE)
            solution = LowRank.fit(features, self.problem, inputs, reference)
        own = frozen(via_inputs)
        return KMP(self.kernel, self.problem, own, via_points, frozen(replaced), origin=self, solution=solution)

    def _mean_of(self, row: Array) -> Array:
        return _finite(((row @ self._weights).ravel() + self._prior)[None])

    def _checked(self, queries: ArrayLike) -> Array:
        s = np.asarray(queries, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] != self._dimensions:
            raise ValueError(f"queries: shape {s.shape} given, (M, {self._dimensions}) needed.")
        return s

    def _checked_one(self, name: str, value: ArrayLike) -> Array:
        s = np.asarray(value, dtype=np.float64)
        if s.shape != (self._dimensions,):
            raise ValueError(f"{name}: shape {s.shape} given, {(self._dimensions,)} needed.")
        return s


def _finite(found: Array) -> Array:
    # Quicker than a look at each number of the query.
    if found[0, 0] != found[0, 0]:
        raise ValueError("The query holds a number that is not finite, and every number must be finite.")
    return found


def _changed(base: KMP, replaced: NDArray[np.intp], inputs: Array, points: Gaussians) -> tuple[Array, Gaussians]:
    kept = np.delete(np.arange(len(base.inputs)), replaced)
    changed = frozen(np.concatenate([base.inputs[kept], inputs]))
    return changed, Gaussians.concatenated([base.reference.take(kept), points])


def _positive(covariance: Array) -> Array:
    """The nearest positive definite covariances (M, O, O): rounding can leave some just below zero."""
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2
    if len(covariance) == 1 and lapack.dpotrf(covariance[0])[1] == 0:
        return covariance  # the same as below, without NumPy's overhead
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        raised = (vectors * np.maximum(values, _MACHINE)[:, None, :]) @ vectors.swapaxes(1, 2)
        below = (values[:, 0] < _MACHINE)[:, None, None]
        covariance = np.where(below, (raised + raised.swapaxes(1, 2)) / 2, covariance)
    return covariance
