"""The kernelized movement primitive: fitting, adaptation, files.

The mean minimises sum_n (xi(s_n) - mu_n)^T Sigma_n^-1 (xi(s_n) - mu_n) + lambda |xi|^2, equation
(4) of the paper, section II-B; its weights are alpha = (K + lambda Sigma)^-1 (mu - m), equation
(9). Adaptation is Algorithm 1, section II-C.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import (
    Array,
    brief,
    check_kind,
    not_negative,
    numbers,
    one_of,
    parts_of,
    positive,
    squared,
    whole,
)
from kmp.arrays.immutable import frozen
from kmp.constraints import LinearConstraints
from kmp.dense import Dense
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, check_gaussians, check_pairs, unchecked
from kmp.kernel import Kernel
from kmp.low_rank import RANK, TOLERANCE, LowRank
from kmp.outputs import as_one, constrained, constraints_of, is_one
from kmp.plot import Plotted, Points, Shown
from kmp.predictor import Inner, Predictor
from kmp.problem.database import Changes, Database, warn_of_missed
from kmp.problem.hyperparameters import AffineMean, Hyperparameters
from kmp.radial import GaussianKernel
from kmp.representation import LARGE, solved
from kmp.solution import BaseSolution, Solution, check_resolved, mean_of, resolved
from kmp.time_kernels import VelocityKernel

_SAME_GOAL = 1e-12  # differences of goals below this share of the largest are rounding
_REACH_STEPS = 300  # number of distances at which a via-point's effect is computed


class Saved:
    """Values with a method that writes them to a file."""

    def save(self, path: str | Path, *, input_unit: str = "", output_unit: str = "") -> None:
        """Write this and the units of its numbers to an .npz file, as `kmp.save` does.

        Raises OSError if the file cannot be written.
        """
        from kmp.storage import save

        save(path, self, input_unit=input_unit, output_unit=output_unit)


@dataclass(frozen=True, eq=False, repr=False)
class KMP(Predictor, Plotted, Saved):
    """A skill: a reference database, the via-points in it, and its solution.

    `fit`, `adapt` and `load` return one. N points in all, I inputs, O outputs. Immutable, so that
    threads may share it. The fitted numbers depend on database and parameters only, bit for bit.
    """

    inner: Inner
    _base: KMP | None = None

    def __repr__(self) -> str:
        count, inputs = self.inputs.shape
        of = f"{count} points" + (
            f", {len(self.via_inputs)} of them taught" if len(self.via_inputs) else ""
        )
        return (
            f"KMP({of}: {inputs} inputs, {self.outputs} outputs, {self.kernel}, "
            f"{self.representation})"
        )

    @classmethod
    def fit(
        cls,
        inputs: ArrayLike,
        reference: Gaussians,
        *,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None = None,
        prior_mean: ArrayLike | AffineMean | None = None,
        prior_covariance: ArrayLike | None = None,
        directions: ArrayLike | None = None,
        representation: Literal["auto", "dense", "low_rank"] = "auto",
        rank: int = RANK,
        rank_tolerance: float = TOLERANCE,
    ) -> KMP:
        """The primitive of a reference database: inputs (N, I) or (N,), N normals over O outputs.

        The mean returns to `prior_mean` (O,) [unit of the outputs] far from the inputs; None is 0.
        An `AffineMean` depends on the input. The covariance does not depend on it.
        `lambda_covariance` None is `lambda_mean`; another value costs a second factor.

        `prior_covariance` B [unit of the outputs^2], variances (O,) or a covariance (O, O), is that
        of the outputs far from the inputs, over N / lambda_c; None is the identity. The prior
        is K (x) B. With the squares of the outputs' sizes, no output's unit changes another's
        prediction. With a `VelocityKernel`, B is that of the values alone.

        If a row of `directions` (N, I) [unit of the inputs] is not zero, the normal is that of the
        output's derivative along it [unit of the outputs], dxi/ds times the direction.

        `representation`: "dense" solves equation (9), N O x N O numbers; "low_rank" solves the cost
        (4) on at most `rank` features of the kernel, whose residual at the inputs is at most
        `rank_tolerance` of k(s, s). "auto" is low rank where that is faster: over time from about
        200 points, over more inputs from N O = 1500 (N, where outputs decouple), if the rank is low
        and no digits are lost. If the rank does not suffice, `RankReached` warns.

        Raises ValueError if there is no point, shapes do not agree, a number is not finite, a
        parameter is out of its range, or the equations cannot be solved to working precision.
        """
        s = numbers("inputs", inputs, "N", "I")
        if len(s) == 0:
            raise ValueError("inputs: no reference point given, at least 1 needed.")
        check_gaussians("reference", reference)
        check_pairs("reference", s, reference, reference.outputs)
        parameters = Hyperparameters.checked(
            kernel,
            lambda_mean,
            lambda_covariance,
            prior_mean,
            prior_covariance,
            inputs=s.shape[1],
            outputs=reference.outputs,
        )
        one_of("representation", representation, ("auto", "dense", "low_rank"))
        whole("rank", rank)
        if positive("rank_tolerance", rank_tolerance) >= 1:
            raise ValueError(
                f"rank_tolerance is {rank_tolerance:g}, and must be below 1, as it is a share."
            )
        points = Functionals.checked(s, directions)
        database = Database(points, resolved(parameters, points, reference))
        return cls(
            Inner.of_base(solved(parameters, database, representation, rank, rank_tolerance))
        )

    def adapt(
        self,
        inputs: ArrayLike,
        desired: Gaussians,
        *,
        tolerance: float | None = None,
        directions: ArrayLike | None = None,
    ) -> KMP:
        """A new primitive that also goes through desired points: inputs (V, I), V normals.

        The paper, Algorithm 1. A desired point nearer than `tolerance` [unit of the inputs] to a
        point of the *base's* reference replaces the nearest one (all of them, if several are
        equally near); any other is inserted. None is `base.spacing / 2`: evenly spaced points are
        then replaced one by one. The order of the desired points does not matter. An earlier
        via-point nearer than `tolerance`, or at the same input, is replaced too, so that a goal can
        be moved again and again; others remain, see `without_via_points`. N of the covariance
        remains that of the base, so that the covariance far away does not change.

        Points of a deviation of 0 (`Gaussians.of`) are met as exactly as rounding allows, beside
        free outputs that a covariance couples to them to about 1e-7.

        If a row of `directions` (V, I) [unit of the inputs] is not zero, the normal is that of the
        output's derivative along it [unit of the outputs], dxi/ds times the direction: a velocity
        of the output, if the direction is the velocity of the input. It is inserted, and replaces
        nothing.

        A `ViaPointMissed` warning names the desired points that the mean misses by more than 3 of
        their deviations and by more than 0.001 of the outputs' deviations far from the inputs, the
        roots of k(s, s) (x) B (1 mm without B, if the unit is the metre).

        Raises ValueError if shapes do not agree, a number is not finite, the tolerance is below 0,
        or the equations cannot be solved to working precision.
        """
        via = numbers("inputs", inputs, "V", self._dimensions)
        check_pairs("desired", via, desired, self.outputs)
        points = Functionals.checked(via, directions)
        return self._through(points, desired, self._tolerance(tolerance))

    def without_via_points(self, inputs: ArrayLike, *, tolerance: float | None = None) -> KMP:
        """A new primitive without the via-points at these inputs (V, I), all of them there.

        Those that remain replace points of the base as in `adapt` with this tolerance.

        Raises ValueError if there is none at an input, and as `adapt` does.
        """
        removed = numbers("inputs", inputs, "V", self._dimensions)
        changes = self.inner.changes
        same = (changes.inputs[:, None] == removed).all(axis=2)  # (via-points, V)
        for row in np.flatnonzero(~same.any(axis=0)):
            raise ValueError(
                f"inputs[{row}]: {brief(removed[row])} given, the input of a via-point needed; "
                f"they are at {brief(changes.inputs) if len(changes.inputs) else 'no input'}."
            )
        remaining = ~same.any(axis=1)
        points = changes.functionals.take(remaining)
        normals = changes.points.take(remaining)
        before = self.base.inner.changes
        remaining_changes = self._changes(before, points, normals, self._tolerance(tolerance))
        return _combined(self.base, remaining_changes, self._constraints)

    def adapt_jacobian(self, inputs: ArrayLike, jacobians: ArrayLike, *, deviation: float) -> KMP:
        """A new primitive with these Jacobians dxi/ds at inputs (V, I): jacobians (V, O, I).

        `deviation` [unit of the outputs / unit of the inputs] is that of each entry. One via-point
        then determines its surroundings: the output follows an input there (ones), or does not
        depend on it (zeros). To prescribe only some columns, use `adapt` along `directions`.

        Raises ValueError as `adapt` does.
        """
        via = numbers("inputs", inputs, "V", self._dimensions)
        matrices = numbers("jacobians", jacobians, len(via), self.outputs, self._dimensions)
        axes = np.tile(np.eye(self._dimensions), (len(via), 1))
        means = matrices.transpose(0, 2, 1).reshape(len(axes), self.outputs)
        variance = squared("deviation", deviation)
        desired = Gaussians(means, np.tile(variance * np.eye(self.outputs), (len(axes), 1, 1)))
        points = Functionals.checked(frozen(np.repeat(via, self._dimensions, axis=0)), axes)
        return self._through(points, desired, 0.0)

    def constrained(self, constraints: LinearConstraints) -> KMP:
        """A new primitive whose mean satisfies these constraints too, to 1e-9. LC-KMP.

        They hold at their inputs; between these the mean may cross a little, so choose them closer
        together than the kernel's length. They also hold after later adaptations; `base` does not
        have them. The covariance ignores them. Constraints need the dense representation: a low
        rank primitive with N O up to 6000 is solved again as dense.

        Raises ValueError if shapes do not agree, or the constraints cannot be met together.
        """
        check_kind(
            "constraints",
            constraints,
            LinearConstraints,
            "LinearConstraints(inputs, normals, bounds)",
        )
        for name, count, needed in (
            ("inputs", constraints.inputs.shape[1], self._dimensions),
            ("outputs", constraints.normals.shape[1], self.outputs),
        ):
            if count != needed:
                raise ValueError(f"constraints: {count} {name} given, {needed} needed.")
        size = self.base.reference.mean.size
        if self.representation == "low_rank" and size > LARGE:
            raise ValueError(
                f"constraints: a low rank primitive of {size} numbers given, at most {LARGE} "
                "or the dense representation needed. Fit fewer points, or with "
                'representation="dense".'
            )
        if self._constraints is not None:
            constraints = self._constraints.joined(constraints)
        return _combined(self.base, self.inner.changes, constraints)

    def refitted(self, reference: Gaussians) -> KMP:
        """The primitive of another reference at the base's points, and of the same via-points.

        Raises ValueError as `fit` and `adapt` do.
        """
        points = self.base.inner.solution.database.functionals
        check_pairs("reference", points.inputs, reference, self.outputs)
        fitted = self._solved_anew(self._database(points, reference))
        return _combined(fitted, self.inner.changes, self._constraints)

    def _database(self, points: Functionals, normals: Gaussians) -> Database:
        return Database(points, resolved(self.inner.solution.hyperparameters, points, normals))

    def _solved_anew(self, database: Database) -> KMP:
        """The primitive of another database, with the same parameters."""
        parameters = self.inner.solution.hyperparameters
        return KMP(
            Inner.of_base(solved(parameters, database, self.representation, RANK, TOLERANCE))
        )

    def _through(self, points: Functionals, desired: Gaussians, tolerance: float) -> KMP:
        """The primitive through these points. Warns if it misses one."""
        if len(points) == 0:
            return self
        parameters = self.inner.solution.hyperparameters
        adapted = self._toward(points, desired, tolerance)
        desired = resolved(parameters, points, desired)
        warn_of_missed(desired, mean_of(adapted.inner.solution, points), parameters)
        return adapted

    def _toward(self, points: Functionals, desired: Gaussians, tolerance: float) -> KMP:
        """The primitive through these points, whether it misses one or not."""
        desired = resolved(self.inner.solution.hyperparameters, points, desired)
        changes = self._changes(self.inner.changes, points, desired, tolerance)
        return _combined(self.base, changes, self._constraints)

    def _changes(
        self, before: Changes, points: Functionals, desired: Gaussians, tolerance: float
    ) -> Changes:
        """The changes of the base by earlier ones and then by these points."""
        nearest = self.base.inner.solution.database.nearest(points, tolerance, self.kernel.period)
        remaining = ~before.near(points, tolerance, self.kernel.period)
        return Changes(
            frozen(np.unique(np.concatenate([before.replaced, *nearest]))),
            Functionals.concatenated([before.functionals.take(remaining), points]),
            Gaussians.concatenated([before.points.take(remaining), desired]),
        )

    def _tolerance(self, tolerance: float | None) -> float:
        if tolerance is None:
            return self.base.spacing / 2
        return not_negative("tolerance", tolerance)

    @property
    def _constraints(self) -> LinearConstraints | None:
        return constraints_of(self.inner.solution)

    @property
    def _base_solution(self) -> BaseSolution:
        return cast(BaseSolution, self.base.inner.solution)

    def _to_plot(self) -> Shown:
        """The reference points and via-points that are values, not derivatives."""
        database = self.inner.solution.database
        count = len(self.inputs) - len(self.via_inputs)
        values = database.functionals.values
        before = np.flatnonzero(values[:count])
        taught = count + np.flatnonzero(values[count:])
        references, via = (
            Points(self.inputs[part], database.reference.take(part)) for part in (before, taught)
        )
        return Shown(references, via, self.kernel.channels, self.kernel.period)

    @classmethod
    def load(cls, path: str | Path, *, kernels: Mapping[str, type] | None = None) -> KMP:
        """The primitive that `save` wrote; `kmp.load` gives its units too, and explains `kernels`.

        Raises OSError if the file cannot be read, and ValueError if it holds no primitive.
        """
        from kmp.storage import load

        return load(path, kernels=kernels).primitive

    def with_lambda_covariance(self, lambda_covariance: float) -> KMP:
        """This primitive with another lambda of the covariance; the mean keeps its bits.

        A larger lambda_covariance gives smaller predicted deviations far from the points.
        Raises ValueError if it is not above 0, or the equations cannot be solved with it.
        """
        other = positive("lambda_covariance", lambda_covariance)
        parameters = replace(self.inner.solution.hyperparameters, lambda_covariance=other)
        before = self._base_solution
        other_base = before.with_hyperparameters(parameters).with_weights(before.weights)
        base = KMP(Inner.of_base(other_base.solved()))
        if self is self.base:
            return base
        changes = self.inner.changes
        solution = _solution(base, changes, self._constraints)
        weighted = solution.with_weights(self.inner.solution.weights)
        return KMP(Inner(weighted.solved(), changes, base.inner.count), base)

    def adapt_many(
        self, points: Sequence[tuple[ArrayLike, Gaussians]], *, tolerance: float | None = None
    ) -> Alternatives:
        """A new primitive for each of G pairs of inputs (V, I) and V normals, as by `adapt`.

        Each is adapted from this primitive: for alternative goals, people or rollouts. It is made
        when it is indexed; `Alternatives.mean` gives the means of all at once. Raises ValueError
        as `adapt` does.
        """
        pairs = parts_of("points", points)
        for i, pair in enumerate(pairs):
            if not (isinstance(pair, (tuple, list)) and len(pair) == 2):
                raise ValueError(
                    f"points[{i}]: {brief(pair)} given, a pair of inputs (V, I) and V normals "
                    "needed."
                )
        tolerance = self._tolerance(tolerance)
        inputs = [numbers("inputs", via, "V", self._dimensions) for via, _ in pairs]
        for via, (_, desired) in zip(inputs, pairs, strict=True):
            check_pairs("desired", via, desired, self.outputs)
        return Alternatives(self, inputs, [desired for _, desired in pairs], tolerance)

    def goal_jacobian(self, queries: ArrayLike) -> Array:
        """The derivatives (M, O, V, O) of the mean at queries (M, I) by the means of the V
        via-points: it is affine in these, so that they hold for any goal at the same inputs.

        Raises ValueError as `mean` does, or if there are constraints.
        """
        if self._constraints is not None:
            raise ValueError(
                "goal_jacobian: a primitive with constraints given, whose mean is not affine in "
                "its goals; one without needed."
            )
        functionals = Functionals(self._checked_many(queries))
        changes = self.inner.changes
        at_rest = mean_of(self.inner.solution, functionals)
        goals = changes.points.mean
        steps = self.inner.solution.hyperparameters.prior_deviations
        jacobian = np.empty((*at_rest.shape, *goals.shape))
        for n, o in np.ndindex(goals.shape):
            moved = np.array(goals)
            moved[n, o] += steps[o]
            points = unchecked(moved, changes.points.covariance)
            other = self._base_solution.adapted(changes._replace(points=points))
            jacobian[:, :, n, o] = (mean_of(other, functionals) - at_rest) / steps[o]
        return jacobian

    def via_point_reach(self, query: ArrayLike, *, share: float = 0.1) -> Array:
        """Distances (I,) [unit of the inputs] up to which a via-point at `query` (I,) matters.

        An exact via-point is inserted at the query, 1 [unit of the outputs] off the mean there.
        Along each input, in both directions and within the range of the reference points, this is
        the largest distance at which the mean moves by at least `share` of its move at the query.
        It depends on ell, lambda and the covariances of the reference.

        Raises ValueError if the shape differs, a number is not finite, or the share is not between
        0 and 1.
        """
        s = self._one_query(query)
        if not 0 < positive("share", share) < 1:
            raise ValueError(f"share is {share:g}, and must be between 0 and 1.")
        values = self.outputs // self.kernel.channels
        desired = Gaussians.of(
            self.mean(s[None]) + 1.0, deviation=np.repeat([0.0, np.inf], values)[: self.outputs]
        )
        adapted = self._toward(Functionals(s[None]), desired, 0.0)
        reach = np.empty(len(s))
        for i, farthest in enumerate(self._farthest(s)):
            r = np.linspace(0.0, farthest, _REACH_STEPS)
            path = np.tile(s, (2, len(r), 1))
            path[:, :, i] += [r, -r]
            moved = np.linalg.norm(
                (adapted.mean(flat := path.reshape(-1, len(s))) - self.mean(flat))[:, :values],
                axis=1,
            )
            matters = moved.reshape(2, -1) >= share * moved[0]
            if self.kernel.period is None:  # outside the data the mean extrapolates
                matters &= (path[:, :, i] >= self.inputs[:, i].min()) & (
                    path[:, :, i] <= self.inputs[:, i].max()
                )
            reach[i] = r[matters.any(axis=0)].max(initial=0.0)
        return reach

    def _farthest(self, query: Array) -> Array:
        """Distances (I,) along each input, beyond which a via-point at the query has no effect."""
        kernel = self.kernel
        if kernel.period is not None:
            return np.full(len(query), kernel.period / 2)
        if type(kernel) in (GaussianKernel, VelocityKernel):  # the kernel is exp(-9)
            return np.broadcast_to(3.0 / np.sqrt(kernel.ell), len(query))
        return np.asarray(np.abs(self.inputs - query).max(axis=0))

    @cached_property
    def spacing(self) -> float:
        """Median distance of a reference point to its nearest neighbour [unit of the inputs].

        Derivatives and repeated points are left out; 0 if there is one point.
        """
        return self.inner.solution.database.spacing(self.kernel.period)

    @property
    def base(self) -> KMP:
        """The primitive before any adaptation; the primitive itself if it was not adapted."""
        return self._base or self

    @property
    def inputs(self) -> Array:
        """Inputs (N, I) of the base's points that were not replaced, then of the via-points."""
        return self.inner.solution.database.inputs

    @property
    def reference(self) -> Gaussians:
        """The N reference points."""
        return self.inner.solution.database.reference

    @property
    def via_inputs(self) -> Array:
        """Inputs (V, I) of the via-points."""
        return self.inner.changes.inputs

    @property
    def via_directions(self) -> Array:
        """Directions (V, I) of via-points that are derivatives; zero for a value."""
        return self.inner.changes.functionals.along

    @property
    def via_points(self) -> Gaussians:
        """The V via-points."""
        return self.inner.changes.points


def _solution(base: KMP, changes: Changes, constraints: LinearConstraints | None) -> Solution:
    """The solution of a base with these changes and constraints."""
    changed: Solution = base.inner.solution
    if len(changes.inputs):
        changed = base._base_solution.adapted(changes)  # noqa: SLF001 (of its own kind)
    return changed if constraints is None else constrained(changed, constraints)


def _combined(base: KMP, changes: Changes, constraints: LinearConstraints | None) -> KMP:
    """The primitive of a base with these changes and constraints, solved."""
    if constraints is None and not len(changes.inputs):
        return base
    if constraints is not None and not is_one(base.inner.solution):
        base = KMP(Inner.of_base(as_one(base.inner.solution).solved()))
    solution = _solution(base, changes, constraints)
    return KMP(Inner(solution.solved(), changes, base.inner.count), base)


def checked_primitive(value: object, name: str = "primitive") -> KMP:
    """The value as a `KMP`. Raises ValueError if it is none."""
    check_kind(name, value, KMP, "KMP.fit(inputs, reference, kernel=..., lambda_mean=...)")
    return cast(KMP, value)


class Alternatives(Sequence[KMP]):
    """Primitives that `KMP.adapt_many` adapts from one, made when they are indexed."""

    def __init__(
        self,
        primitive: KMP,
        inputs: Sequence[Array],
        desired: Sequence[Gaussians],
        tolerance: float,
    ) -> None:
        self._primitive = primitive
        self._inputs = inputs
        self._desired = desired
        self._tolerance = tolerance

    def __len__(self) -> int:
        return len(self._inputs)

    @overload
    def __getitem__(self, index: int) -> KMP: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[KMP, ...]: ...

    def __getitem__(self, index: int | slice) -> KMP | tuple[KMP, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(len(self))[index])
        return self._primitive.adapt(
            self._inputs[index], self._desired[index], tolerance=self._tolerance
        )

    def mean(self, queries: ArrayLike) -> Array:
        """The means (G, M, O) of all G primitives at queries (M, I), equal to theirs to 1e-8.

        Goals at the same inputs with the same covariances take at most V O + 1 adaptations. Goals
        at other inputs take one solve, if the primitive is a single system without via-points and
        constraints; else each takes an adaptation. Raises ValueError as `KMP.mean` does.
        """
        solution = self._primitive.inner.solution
        if constraints_of(solution) is None and len({len(via) for via in self._inputs}) == 1:
            inputs = np.stack(self._inputs)
            covariance = np.stack([desired.covariance for desired in self._desired])
            if (inputs == inputs[0]).all() and (covariance == covariance[0]).all():
                return self._by_directions(queries)
            if isinstance(solution, (Dense, LowRank)) and not len(self._primitive.via_inputs):
                return self._by_one_solve(solution, queries)
        return np.stack([adapted.mean(queries) for adapted in self])

    def _by_one_solve(self, solution: Dense | LowRank, queries: ArrayLike) -> Array:
        """The means (G, M, O) of goals at inputs of their own."""
        from kmp.goals import moved_means  # rarely used

        functionals = Functionals(self._primitive._checked_many(queries))  # noqa: SLF001 (of its own kind)
        points = Functionals(np.concatenate(self._inputs))
        normals = Gaussians.concatenated(self._desired)
        added = Database(points, resolved(solution.hyperparameters, points, normals))
        is_low_rank = solution.representation == "low_rank"
        check_resolved(solution.hyperparameters, added, both=is_low_rank)
        if is_low_rank:
            check_resolved(solution.hyperparameters, added, name="lambda_mean", both=True)
        nearest = solution.database.nearest(points, self._tolerance, self._primitive.kernel.period)
        v = len(points) // len(self)
        replaced = [
            np.unique(np.concatenate(nearest[start : start + v]))
            for start in range(0, len(points), v)
        ]
        means = moved_means(solution, added, replaced, functionals)
        means += mean_of(solution, functionals)
        for n in np.flatnonzero(np.isnan(means).any(axis=(1, 2))):
            means[n] = self[int(n)].mean(queries)
        return means

    def _by_directions(self, queries: ArrayLike) -> Array:
        """The means (G, M, O), which are affine in the goals: by one adaptation for each of the
        directions in which these differ.
        """
        primitive = self._primitive
        points = Functionals(self._inputs[0])
        first = self._desired[0]
        away = np.stack([desired.mean - first.mean for desired in self._desired])
        units = primitive.inner.solution.hyperparameters.prior_deviations
        shares, sizes, directions = np.linalg.svd(
            (away / units).reshape(len(self), -1), full_matrices=False
        )
        kept = sizes > _SAME_GOAL * sizes.max(initial=0.0)
        mean = self[0].mean(queries)
        moves = np.empty((kept.sum(), mean.size))
        for n, step in enumerate(sizes[kept, None] * directions[kept]):
            goal = unchecked(first.mean + step.reshape(first.mean.shape) * units, first.covariance)
            moved = primitive._toward(points, goal, self._tolerance)  # noqa: SLF001
            moves[n] = (moved.mean(queries) - mean).ravel()
        return np.asarray(mean + (shares[:, kept] @ moves).reshape(len(self), *mean.shape))
