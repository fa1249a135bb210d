"""Outputs with a prior covariance B, and outputs that decouple in some coordinates.

The equation (9) with B is alpha = (I (x) B) (K (x) B + lambda Sigma)^-1 (mu - m). With B = T T^T,
the coordinates x of y = T x have the prior covariance K (x) I. Where every Sigma_n is s_n A, T is
chosen so that T^-1 A T^-T is diagonal, too. Where all of T^-1 Sigma_n T^-T are diagonal, each
output is a system of its own, or shares that of those with the same variances: D systems of N rows
instead of one of N D.

Over C channels, T is the same for the values and for their rates: I (x) T.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import Array
from kmp.arrays.immutable import frozen
from kmp.arrays.linear_algebra import symmetric
from kmp.constraints import Constrained, LinearConstraints
from kmp.dense import SINGLE, Dense
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, unchecked
from kmp.kernel import variances
from kmp.low_rank import LowRank
from kmp.problem.database import Changes, Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import BaseSolution, Expansion, Solution

_ONE_SHAPE = 1e-14  # differences between the shapes of covariances that are rounding
_FREE_SHARE = 1e8  # an output is free above this lambda Sigma / k(s, s)
_MIXED_FREE = 1e4  # lambda Sigma / k(s, s) of a free output that a map mixes with others
# that of an exact output there: the rounding of the free one leaves it two digits
_MIXED_EXACT = 1e-10


@contextmanager
def variances_over_prior(parameters: Hyperparameters) -> Iterator[None]:
    """A ValueError from within says in which unit its variances are."""
    try:
        yield
    except ValueError as error:
        if parameters.prior_covariance is None:
            raise
        raise ValueError(f"{error} Variances are over those of prior_covariance.") from None


def output_map(parameters: Hyperparameters, reference: Gaussians) -> Array | None:
    """T (O, O) for these parameters and normals; None where it is the identity."""
    prior = parameters.prior_covariance
    values = parameters.channel_outputs
    root: NDArray[Any] = np.eye(values) if prior is None else np.linalg.cholesky(prior)
    rotated = None
    if parameters.kernel.channels == 1 and reference.mean.size > SINGLE:
        rotated = _basis(root, reference.covariance)
    if prior is None and rotated is None:
        return None
    matrix = root if rotated is None else root @ rotated
    return frozen(np.kron(np.eye(parameters.kernel.channels), matrix))


def _basis(root: NDArray[Any], covariance: Array) -> Array | None:
    """The eigenvectors (O, O) of R^-1 A R^-T, if all covariances (N, O, O) are s_n A and it is not
    diagonal.
    """
    sizes = np.trace(covariance, axis1=1, axis2=2)
    shape = covariance[0] / sizes[0]
    if np.abs(covariance / sizes[:, None, None] - shape).max() > _ONE_SHAPE:
        return None
    inverse = np.linalg.inv(root)
    inner = symmetric(inverse @ shape @ inverse.T)
    if not (inner - np.diag(np.diagonal(inner))).any():
        return None
    return np.asarray(np.linalg.eigh(inner)[1], dtype=np.float64)


def _inner_parameters(parameters: Hyperparameters, t: Array | None) -> Hyperparameters:
    """The parameters in the coordinates x = T^-1 y; T None is the identity."""
    if t is None:
        return parameters
    inverse = np.linalg.inv(t)
    return replace(
        parameters,
        prior_offset=frozen(inverse @ parameters.prior_offset),
        prior_matrix=frozen(inverse @ parameters.prior_matrix),
        prior_covariance=None,
    )


def inner_problem(
    parameters: Hyperparameters, database: Database, t: Array | None
) -> tuple[Hyperparameters, Database]:
    """The problem in the coordinates x = T^-1 y; T None is the identity."""
    if t is None:
        return parameters, database
    inner = _inner_parameters(parameters, t)
    points = database.functionals
    return inner, Database(points, inside(inner, points, t, database.reference))


def inside(
    parameters: Hyperparameters, points: Functionals, t: Array, normals: Gaussians
) -> Gaussians:
    """Normals of y = T x in the coordinates x, of which the parameters are.

    Without the differences that rounding makes: entries beside the diagonal are 0, and equal
    variances are equal to the bit, so that one factor serves them.
    """
    inverse = np.linalg.inv(t)
    mean = normals.mean @ inverse.T
    covariance = symmetric(inverse @ normals.covariance @ inverse.T)
    for n in np.flatnonzero(mixes(parameters, points, t, normals)):
        chosen = slice(n, n + 1)
        point = points.take(chosen)
        mean[n], covariance[n] = _of_fixed(parameters, point, t, normals.take(chosen))
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    covariance[np.abs(covariance) < _ONE_SHAPE * size[:, :, None] * size[:, None, :]] = 0.0
    variances = size**2
    for output in range(1, variances.shape[1]):
        for other in range(output):
            differences = np.abs(variances[:, output] - variances[:, other])
            if (differences <= _ONE_SHAPE * variances[:, other]).all():
                covariance[:, output, output] = covariance[:, other, other]
                break
    return unchecked(mean, covariance)


def mixes(
    parameters: Hyperparameters, points: Functionals, t: Array, normals: Gaussians
) -> NDArray[np.bool_]:
    """(N,) true where T mixes free outputs with others, or exact ones: variances so far apart
    that rounding hides the small ones in the coordinates x.
    """
    variances = np.diagonal(normals.covariance, axis1=1, axis2=2)
    is_free = variances > _FREE_SHARE * _prior_variances(parameters, points, t)
    kinds = np.stack([is_free, normals.exact, ~(is_free | normals.exact)])  # (3, N, O)
    enters = kinds @ (np.linalg.inv(t) != 0).T  # each kind in each x
    return np.asarray((enters.sum(axis=0) > 1).any(axis=1))


def _prior_variances(parameters: Hyperparameters, points: Functionals, t: Array) -> Array:
    """(N, O) the prior variances of y = T x over lambda, for x of these parameters."""
    penalty = min(parameters.lambda_mean, parameters.lambda_covariance)
    kernel = variances(parameters.kernel, points).repeat(parameters.channel_outputs, axis=1)
    prior = t @ parameters.over_outputs(np.eye(parameters.kernel.channels)) @ t.T
    return np.asarray(kernel * np.diagonal(prior) / penalty)


def _of_fixed(
    parameters: Hyperparameters, point: Functionals, t: Array, normal: Gaussians
) -> tuple[Array, Array]:
    """Mean (O,) and covariance (O, O) of x for one normal of y = T x with free or exact outputs.

    With the rows H of T of the outputs that are not free: x = H^+ y and H^+ Sigma H^+T, plus a
    variance in the null space of H, so small that rounding does not hide the least one.
    """
    prior = _prior_variances(parameters, point, t)[0]
    variance = np.diagonal(normal.covariance[0])
    fixed = np.flatnonzero(variance <= _FREE_SHARE * prior)
    rows = t[fixed]
    sizes = np.linalg.norm(rows, axis=1)
    back = np.linalg.pinv(rows / sizes[:, None]) / sizes
    noise = normal.covariance[0][np.ix_(fixed, fixed)]
    least = _MIXED_EXACT * len(fixed) * prior[fixed]
    noise = noise + np.diag(np.maximum(least - variance[fixed], 0.0))
    free = np.sqrt(_MIXED_FREE * _prior_variances(parameters, point, np.eye(len(t)))[0])
    null = free[:, None] * (np.eye(len(t)) - back @ rows) * free
    before = parameters.prior_at(point)[0]
    mean = before + back @ (normal.mean[0, fixed] - rows @ before)
    return mean, symmetric(back @ noise @ back.T + null)


@dataclass(frozen=True, eq=False, repr=False)
class Mapped(Expansion):
    """The solution y = T x, of a solution for each group of the coordinates x, which do not depend
    on those of other groups. The members are those of `Solution`.
    """

    hyperparameters: Hyperparameters
    database: Database
    parts: tuple[Any, ...]  # a solution of each group
    groups: tuple[NDArray[np.intp], ...]  # the coordinates of each group
    t: Array | None = None  # None is the identity
    constraints: LinearConstraints | None = None

    @classmethod
    def of_groups(
        cls,
        parameters: Hyperparameters,
        database: Database,
        groups: tuple[NDArray[np.intp], ...],
        solution: Any,
    ) -> Mapped:
        """The solution by `solution(parameters, database, group)` of each group of outputs."""
        parts = tuple(
            solution(
                _parameters_of(parameters, group),
                Database(database.functionals, _of_group(database.reference, group)),
                group,
            )
            for group in groups
        )
        return cls(parameters, database, parts, groups)

    @classmethod
    def around(
        cls, parameters: Hyperparameters, database: Database, t: Array | None, inner: Any
    ) -> Mapped:
        """The solution of an inner one, of the coordinates x."""
        if isinstance(inner, Mapped):
            return replace(inner, hyperparameters=parameters, database=database, t=t)
        return cls(parameters, database, (inner,), (frozen(np.arange(parameters.outputs)),), t)

    @property
    def representation(self) -> Literal["dense", "low_rank"]:
        kind: Literal["dense", "low_rank"] = self.parts[0].representation
        return kind

    @property
    def functionals(self) -> Functionals:
        functionals: Functionals = self.parts[0].functionals
        return functionals

    @cached_property
    def weights(self) -> Array:
        weights = np.empty((len(self.functionals), self.hyperparameters.outputs))
        for part, group in self._pairs:
            weights[:, group] = part.weights
        return frozen(weights if self.t is None else weights @ self.t.T)

    def solved(self) -> Mapped:
        with variances_over_prior(self.hyperparameters):
            for part in self.parts:
                part.solved()
        self.weights  # noqa: B018
        return self

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        outputs = self.hyperparameters.outputs
        queries = len(prior) // self.hyperparameters.kernel.channels
        out = np.zeros((len(rows) // len(prior), queries * outputs, queries * outputs))
        for part, group in self._pairs:
            columns = (np.arange(queries)[:, None] * outputs + group).ravel()
            out[:, columns[:, None], columns] = part.posterior_covariance(rows, prior)
        if self.t is None:
            return out
        blocks = out.reshape(-1, queries, outputs, queries, outputs).swapaxes(2, 3)
        return np.asarray((self.t @ blocks @ self.t.T).swapaxes(2, 3).reshape(out.shape))

    def adapted(self, changes: Changes) -> Solution:
        points = changes.points
        if self.t is not None:
            inner = _inner_parameters(self.hyperparameters, self.t)
            points = inside(inner, changes.functionals, self.t, points)
        if not self._is_decoupled(points):
            return self._together.adapted(changes)
        parts = tuple(
            part.adapted(changes._replace(points=_of_group(points, group)))
            for part, group in self._pairs
        )
        return replace(self, database=self.database.changed(changes), parts=parts)

    def with_hyperparameters(self, hyperparameters: Hyperparameters) -> Mapped:
        inner = _inner_parameters(hyperparameters, self.t)
        parts = tuple(
            part.with_hyperparameters(_parameters_of(inner, group)) for part, group in self._pairs
        )
        return replace(self, hyperparameters=hyperparameters, parts=parts)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        stored: list[dict[str, NDArray[np.float64]]] = [part.to_arrays() for part in self.parts]
        arrays = stored[0]
        if arrays and len(stored) > 1:
            arrays["information"] = np.stack([part["information"] for part in stored])
            arrays["features"] = np.hstack([part["features"] for part in stored])
        return arrays if self.t is None else arrays | {"output_map": self.t}

    @property
    def _pairs(self) -> Iterator[tuple[Any, NDArray[np.intp]]]:
        return zip(self.parts, self.groups, strict=True)

    @cached_property
    def _together(self) -> BaseSolution:
        """The solution with all coordinates as one system."""
        first = self.parts[0]
        if isinstance(first, LowRank):
            return self.as_one(lambda p, d: LowRank.fit(p, d, first.features))
        return self.as_one(Dense)

    def as_one(
        self, solution: Callable[[Hyperparameters, Database], Dense | LowRank]
    ) -> BaseSolution:
        """The same problem by one `solution(parameters, database)` of all coordinates."""
        system = solution(*inner_problem(self.hyperparameters, self.database, self.t))
        if self.t is None:
            return system
        return Mapped.around(self.hyperparameters, self.database, self.t, system)

    def _is_decoupled(self, normals: Gaussians) -> bool:
        """True if no covariance couples two groups."""
        number = np.empty(normals.outputs, dtype=np.intp)
        for n, group in enumerate(self.groups):
            number[group] = n
        return not normals.covariance[:, number[:, None] != number].any()


def decoupled_groups(
    parameters: Hyperparameters, reference: Gaussians, *, alike: bool
) -> tuple[NDArray[np.intp], ...]:
    """The groups of outputs (each value with its rate) that no covariance couples to others.

    Outputs whose covariances are `alike` share a group, as one factor serves them all.
    """
    values = parameters.channel_outputs
    channels = parameters.kernel.channels
    everything = (frozen(np.arange(parameters.outputs)),)
    if values == 1 or reference.mean.size <= SINGLE:
        return everything
    blocks = reference.covariance.reshape(-1, channels, values, channels, values)
    coupled = blocks.any(axis=(0, 1, 3))
    if (coupled & ~np.eye(values, dtype=bool)).any():
        return everything
    variances = [blocks[:, :, value, :, value] for value in range(values)]
    groups: list[list[int]] = []
    for value in range(values):
        group = next(
            (g for g in groups if alike and np.array_equal(variances[g[0]], variances[value])), None
        )
        if group is None:
            groups.append([value])
        else:
            group.append(value)
    if len(groups) == 1:
        return everything
    every = values * np.arange(channels)[:, None]
    return tuple(frozen((every + np.array(group)).ravel()) for group in groups)


def _of_group(normals: Gaussians, group: NDArray[np.intp]) -> Gaussians:
    return unchecked(normals.mean[:, group], normals.covariance[:, group[:, None], group])


def _parameters_of(parameters: Hyperparameters, group: NDArray[np.intp]) -> Hyperparameters:
    return replace(
        parameters,
        prior_offset=frozen(parameters.prior_offset[group]),
        prior_matrix=frozen(parameters.prior_matrix[group]),
    )


def constraints_of(solution: Solution) -> LinearConstraints | None:
    """The constraints on a solution's mean, if it has any."""
    return solution.constraints if isinstance(solution, (Constrained, Mapped)) else None


def as_one(base: Solution) -> BaseSolution:
    """The dense solution of a base as one system, to which constraints can be added."""
    if is_one(base):
        return cast(BaseSolution, base)
    if isinstance(base, Mapped):
        return base.as_one(Dense)
    return Dense(base.hyperparameters, base.database)


def constrained(solution: Solution, constraints: LinearConstraints) -> Solution:
    """A solution as one system, with these constraints."""
    if isinstance(solution, Mapped):
        assert solution.t is not None, "as one"
        inner = LinearConstraints(
            constraints.inputs,
            constraints.normals @ solution.t,
            constraints.bounds,
            constraints.directions,
        )
        parts = (constrained(solution.parts[0], inner),)
        return replace(solution, parts=parts, constraints=constraints)
    assert isinstance(solution, Dense), "as one"
    return Constrained(solution, constraints)


def is_one(solution: Solution) -> bool:
    """True if constraints can be added to the solution."""
    parts = solution.parts if isinstance(solution, Mapped) else (solution,)
    return len(parts) == 1 and isinstance(parts[0], Dense)
