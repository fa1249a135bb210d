"""The kernelized movement primitive: the output at any input, and how sure it is.

The paper, sections II-B and II-C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp import named_arrays
from kmp.checks import Array, check_finite, check_shape, numbers, positive, real
from kmp.compiled_query import CompiledQuery
from kmp.database import Changes, Database, warn_of_missed
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, check_pairs, unchecked
from kmp.hyperparameters import Hyperparameters
from kmp.immutable import Immutable, frozen
from kmp.kernel import Kernel, between
from kmp.linear_algebra import kron_identity, nearest_positive_semidefinite
from kmp.low_rank import RANK, TOLERANCE, Features
from kmp.query import MotionPrediction, Query
from kmp.solution import Solution, mean_at, mean_of
from kmp.solving import solved

_BATCH = 256  # queries at once, which bounds the memory of `predict`
_RESIDUAL = 1e-10  # the same, for the uncertainty that is distance from the data


@dataclass(frozen=True, eq=False)
class Uncertainty(Immutable):
    """The covariance of `predict` as the sum of two, each (M, O, O) [unit of the outputs^2]."""

    variability: Array
    """How much the demonstrations differ from each other there."""
    distance: Array
    """How far the query is from the data: what would remain if each reference point were exact."""


@dataclass(frozen=True, eq=False)
class KMP(Immutable):
    """A skill: a reference database, the via-points in it, and its solution.

    Made by `fit`, `adapt` and `from_arrays`. N points in all, I inputs, O outputs. Immutable, so
    that threads may share it. What is fitted depends on the database and the parameters alone, bit
    for bit, however the primitive came about.
    """

    _solution: Solution
    _changes: Changes
    _base: KMP | None = None

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
        directions: ArrayLike | None = None,
        representation: Literal["auto", "dense", "low_rank"] = "auto",
        rank: int = RANK,
        rank_tolerance: float = TOLERANCE,
    ) -> KMP:
        """The primitive of a reference database: inputs (N, I), N normals over O outputs.

        `prior_mean` (O,) [unit of the outputs] is what the mean returns to far from the inputs, the
        origin by default. `lambda_covariance` None is `lambda_mean`; another value costs a second
        factor.

        Where a row of `directions` (N, I) [unit of the inputs] is not zero, that normal is of the
        output's derivative along it [unit of the outputs], dxi/ds times the direction.

        `representation`: "dense" solves equation (9), N O x N O numbers; "low_rank" solves the cost
        (4) on at most `rank` features of the kernel, which leave a share of at most
        `rank_tolerance` of it at the inputs. "auto" is dense for few points or where the rank does
        not suffice, and low rank for many. A rank that did not suffice is said in a `RankReached`
        warning, with the accuracy lost.

        Raises ValueError if there is no point, shapes do not agree, a number is not finite, a
        parameter is out of its range, or the equations cannot be solved to working precision.
        """
        s = numbers("inputs", inputs, "N", "I")
        if len(s) == 0:
            raise ValueError("inputs: no reference point given, at least 1 needed.")
        check_pairs(s, reference, reference.outputs)
        parameters = Hyperparameters.checked(
            kernel,
            lambda_mean,
            lambda_covariance,
            prior_mean,
            inputs=s.shape[1],
            outputs=reference.outputs,
        )
        if representation not in {"auto", "dense", "low_rank"}:
            raise ValueError(f"representation: {representation!r} given, 'auto', 'dense' or 'low_rank' needed.")
        if rank < 1:
            raise ValueError(f"rank is {rank}, and must be at least 1.")
        positive("rank_tolerance", rank_tolerance)
        database = Database(Functionals.checked(s, directions), reference)
        return cls(solved(parameters, database, representation, rank, rank_tolerance), database.unchanged())

    def mean(self, queries: ArrayLike) -> Array:
        """xi(s) at queries (M, I): (M, O) [unit of the outputs]. Equation (8).

        One query alone may differ by rounding from the same in a set. Raises ValueError if the
        shape is another or a number is not finite.
        """
        s = self._checked_many(queries)
        if len(s) == 1:
            return self._query.mean(self._query.row(s[0]))[None]
        return mean_at(self._solution, s)

    def predict(self, queries: ArrayLike) -> Gaussians:
        """xi(s) with its covariance at queries (M, I): M normals.

        The mean is that of `mean`, bit for bit. Covariance: N / lambda_c (k(s, s) I - k (K +
        lambda_c Sigma)^-1 k^T), IJRR 2019. The first prediction inverts the triangular factor: make
        one before there is a deadline. Raises ValueError if the shape is another, a number is not
        finite, or what was stored cannot be solved here.
        """
        s = self._checked_many(queries)
        if len(s) == 1:
            row = self._query.row(s[0])
            by = self._compiled_query or self._query
            return unchecked(self._query.mean(row)[None], by.covariance(row.kernel)[None])
        batches = [s[i : i + _BATCH] for i in range(0, len(s), _BATCH)]
        posterior = [self._solution.posterior_covariance(self._rows(one)) for one in batches]
        stacked = np.concatenate(posterior) if posterior else np.empty((0, self.outputs, self.outputs))
        return unchecked(self.mean(s), nearest_positive_semidefinite(stacked) * self._query.covariance_scale)

    def predict_motion(
        self,
        query: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        covariance: bool = True,
    ) -> MotionPrediction:
        """xi at one query (I,), and how it moves with the input: all from one kernel row.

        The input's velocity (I,) [unit of the inputs / s] and its acceleration (I,) [unit of the
        inputs / s^2] give those of the output. The numbers are those of `predict`, `jacobian` and
        `curvature`: but for rounding where Numba is installed, whose compiled loops then serve, bit
        for bit where it is not. The covariance takes longer than all else, and can be left out.

        Raises ValueError if a shape is another or a number is not finite.
        """
        s, v, a = real("query", query), real("velocity", velocity), real("acceleration", acceleration)
        compiled = self._compiled_query
        if compiled is not None and s.shape == v.shape == a.shape == (self._dimensions,):
            found = compiled.motion(s, v, a, covariance=covariance)
            if found is not None:
                return found
        checked = self._checked("velocity", v), self._checked("acceleration", a)
        return self._query.motion(self._one_query(s), *checked, covariance=covariance)

    def jacobian(self, query: ArrayLike) -> Array:
        """dxi/ds at one query (I,): (O, I) [unit of the outputs / unit of the inputs].

        Equation (8), derived. Raises ValueError if the shape is another or a number is not finite.
        """
        return self._query.jacobian(self._query.row(self._one_query(query)))

    def curvature(self, query: ArrayLike, direction: ArrayLike) -> Array:
        """d^2 xi(s + t v)/dt^2 at t = 0, for one query s (I,) and a direction v (I,): (O,).

        Equation (8), derived twice. Where v is the velocity of the input [unit of the inputs / s],
        this is the part of the output's acceleration [unit of the outputs / s^2] that the velocity
        makes. Raises ValueError if a shape is another or a number is not finite.
        """
        s, v = self._one_query(query), self._checked("direction", direction)
        return self._query.curvature(self._query.row(s), v)

    def uncertainty(self, queries: ArrayLike) -> Uncertainty:
        """The covariance at queries (M, I), split: how demonstrations vary, how far they are.

        The second is what IJRR 2019's covariance would be with Sigma = 0. Raises ValueError if the
        shape is another or a number is not finite.
        """
        s = self._checked_many(queries)
        total = self.predict(s).covariance
        c = self.kernel.channels
        z = self._spanned(Functionals(s)).T.reshape(len(s), c, -1)
        residual = kron_identity(self.kernel.prior_variance - z @ z.transpose(0, 2, 1), self.outputs // c)
        distance = nearest_positive_semidefinite(residual) * self._query.covariance_scale
        return Uncertainty(frozen(nearest_positive_semidefinite(total - distance)), frozen(distance))

    def adapt(
        self,
        inputs: ArrayLike,
        desired: Gaussians,
        *,
        tolerance: float,
        directions: ArrayLike | None = None,
    ) -> KMP:
        """A new primitive that also goes through desired points: inputs (V, I), V normals.

        The paper, Algorithm 1. A desired point nearer than `tolerance` [unit of the inputs] to a
        point of the *base's* reference takes the place of its nearest one (of all, where several
        are equally near); any other is inserted. The order of the desired points does not matter.
        Earlier via-points stay: to be rid of them, adapt `base` anew. N of the covariance stays the
        base's, so that teaching here changes nothing elsewhere.

        Where a row of `directions` (V, I) [unit of the inputs] is not zero, that normal is of the
        output's derivative along it [unit of the outputs], dxi/ds times the direction: a velocity
        of the output, where the direction is that of the input. It is inserted, and replaces
        nothing.

        A desired point that is then missed by more than 3 of its deviations, and by more than 0.001
        (1 mm, where the unit is the metre), is named in a `ViaPointMissed` warning.

        Raises ValueError if shapes do not agree, a number is not finite, the tolerance is below 0,
        or the equations cannot be solved to working precision.
        """
        via = numbers("inputs", inputs, "V", self._dimensions)
        check_pairs(via, desired, self.outputs)
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance:g}, and must not be below 0.")
        if len(via) == 0:
            return self
        before, points = self._changes, Functionals.checked(via, directions)
        nearest = self.base._solution.database.nearest(points, tolerance, self.kernel.period)
        changes = Changes(
            frozen(np.union1d(before.replaced, nearest)),
            Functionals.concatenated([before.functionals, points]),
            Gaussians.concatenated([before.points, desired]),
        )
        adapted = KMP(self.base._solution.adapted(changes).solved(), changes, self.base)
        warn_of_missed(desired, mean_of(adapted._solution, points), self.kernel.channels)
        return adapted

    def adapt_jacobian(self, inputs: ArrayLike, jacobians: ArrayLike, *, deviation: float) -> KMP:
        """A new primitive with these Jacobians dxi/ds at inputs (V, I): jacobians (V, O, I).

        `deviation` [unit of the outputs / unit of the inputs] is how sure each entry is. So one
        via-point says what lies about it: the output follows an input there (ones), or does not
        heed it (zeros). What is not known of a Jacobian is left out by `adapt` along `directions`.

        Raises ValueError as `adapt` does.
        """
        via = numbers("inputs", inputs, "V", self._dimensions)
        given = numbers("jacobians", jacobians, len(via), self.outputs, self._dimensions)
        axes = np.tile(np.eye(self._dimensions), (len(via), 1))
        means = given.transpose(0, 2, 1).reshape(len(axes), self.outputs)
        variance = positive("deviation", deviation) ** 2
        desired = Gaussians(means, np.tile(variance * np.eye(self.outputs), (len(axes), 1, 1)))
        return self.adapt(np.repeat(via, self._dimensions, axis=0), desired, tolerance=0, directions=axes)

    def refitted(self, reference: Gaussians) -> KMP:
        """The primitive of another reference at the base's points, and of the same via-points.

        Raises ValueError as `fit` and `adapt` do.
        """
        points = self.base._solution.database.functionals
        check_pairs(points.inputs, reference, self.outputs)
        database, parameters = Database(points, reference), self._solution.hyperparameters
        fitted = KMP(solved(parameters, database, self.representation, RANK, TOLERANCE), database.unchanged())
        if self is self.base:
            return fitted
        return KMP(fitted._solution.adapted(self._changes).solved(), self._changes, fitted)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All that `from_arrays` needs, by name: base, via-points, fitted weights, parameters."""
        return named_arrays.to_arrays(self.base._solution, self._changes, self._solution)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> KMP:
        """The primitive that `to_arrays` gave these arrays for, with its very weights.

        Other names are left alone. The factors are made when `predict` or `adapt` first asks for
        them, and come out the same bit for bit, given the same libraries and kind of processor.
        Raises ValueError if an array is missing, or the arrays do not go together.
        """
        base, changes, solution = named_arrays.from_arrays(arrays)
        unadapted = cls(base, base.database.unchanged())
        return unadapted if solution is base else cls(solution, changes, unadapted)

    @property
    def kernel(self) -> Kernel:
        """The kernel k."""
        return self._solution.hyperparameters.kernel

    @property
    def lambda_mean(self) -> float:
        """lambda of equation (9) [1 / (unit of the outputs)^2]."""
        return self._solution.hyperparameters.lambda_mean

    @property
    def lambda_covariance(self) -> float:
        """lambda of the covariance [1 / (unit of the outputs)^2]."""
        return self._solution.hyperparameters.lambda_covariance

    @property
    def prior_mean(self) -> Array:
        """(O,) [unit of the outputs] what the mean returns to far from the inputs."""
        return self._solution.hyperparameters.prior_mean

    @property
    def base(self) -> KMP:
        """The primitive before any adaptation: itself, if there was none."""
        return self._base or self

    @property
    def inputs(self) -> Array:
        """(N, I) the reference points: the base's that were not replaced, then the via-points."""
        return self._solution.database.inputs

    @property
    def reference(self) -> Gaussians:
        """The N reference points."""
        return self._solution.database.reference

    @property
    def via_inputs(self) -> Array:
        """(V, I) where the via-points are."""
        return self._changes.inputs

    @property
    def via_points(self) -> Gaussians:
        """The V via-points."""
        return self._changes.points

    @property
    def outputs(self) -> int:
        """O, the number of outputs."""
        return self._solution.hyperparameters.outputs

    @property
    def representation(self) -> Literal["dense", "low_rank"]:
        """How the primitive is solved."""
        return self._solution.representation

    @property
    def weights(self) -> Array:
        """Those of equation (8): alpha (N, O) of equation (9), or those of the low rank centres."""
        return self._solution.weights

    @property
    def error_bound(self) -> float:
        """How far the mean can be from equation (9)'s at the points [unit of the outputs].

        An upper bound: 0 for the dense solution; for the low rank one rigorous but for rounding,
        and pessimistic by one to three orders.
        """
        return self._solution.error_bound

    @cached_property
    def _query(self) -> Query:
        return Query.of(self._solution, len(self.base.inputs))

    @cached_property
    def _compiled_query(self) -> CompiledQuery | None:
        return CompiledQuery.of(self._query)

    @cached_property
    def _spanned(self) -> Features:
        known = self._solution.functionals
        return Features.of(self.kernel, known, rank=len(known), tolerance=_RESIDUAL)[0]

    @cached_property
    def _dimensions(self) -> int:
        return int(self._changes.inputs.shape[1])

    def _rows(self, queries: Array, directions: Array | None = None) -> Array:
        """k of M queries, or their derivatives, and what is known: (M C, R C)."""
        return between(self.kernel, Functionals(queries, directions), self._solution.functionals)

    def _wrapped(self, queries: Array) -> Array:
        """The queries, within the period where there is one: no seam, not even rounding's."""
        period = self.kernel.period
        return queries if period is None else queries % period

    def _one_query(self, query: ArrayLike) -> Array:
        return self._wrapped(self._checked("query", query))

    def _checked(self, name: str, value: ArrayLike) -> Array:
        s = real(name, value)
        check_shape(name, s, self._dimensions)
        check_finite(name, s)
        return s

    def _checked_many(self, queries: ArrayLike) -> Array:
        s = real("queries", queries)
        if s.ndim != 2 or s.shape[1] != self._dimensions:
            check_shape("queries", s, "M", self._dimensions)
        check_finite("queries", s)
        return self._wrapped(s)
