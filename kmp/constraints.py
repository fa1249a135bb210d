"""Linear inequality constraints g_j . xi(s_j) >= b_j on the mean.

Huang and Caldwell, A Linearly Constrained Nonparametric Framework for Imitation Learning, ICRA 2020
(arXiv 1909.07374, "LC-KMP").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np

from kmp.arrays.checks import Array, check_kind, numbers
from kmp.arrays.immutable import Immutable, frozen
from kmp.dense import Dense
from kmp.functionals import Functionals
from kmp.kernel import between
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import Expansion, mean_of

_VIOLATION = 1e-9  # [unit of the outputs] largest violation, for a normal of norm 1
_CONVERGED = 1e-13  # [unit of the outputs] the search ends at this violation of active constraints
_ROUNDS = 30  # the search ends after this number of active sets
_RIDGE = 1e-12  # least eigenvalue over the largest one, at the start of the search only


@dataclass(frozen=True, eq=False, repr=False)
class LinearConstraints(Immutable):
    """J constraints g_j . xi(s_j) >= b_j: the output is on one side of a plane.

    inputs (J, I), normals g (J, O), bounds b (J,) [unit of the outputs, if g has norm 1]. If a row
    of `directions` (J, I) is not zero, the constraint is on the derivative along it: a limit of
    speed. Read-only. Raises ValueError if shapes do not agree, a number is not finite, or a normal
    is 0.
    """

    inputs: Array
    normals: Array
    bounds: Array
    directions: Array | None = None

    def __post_init__(self) -> None:
        inputs = numbers("constraints.inputs", self.inputs, "J", "I")
        normals = numbers("constraints.normals", self.normals, len(inputs), "O")
        for j in np.flatnonzero(~normals.any(axis=1))[:1]:
            raise ValueError(f"constraints.normals[{j}] is 0, and must have a direction.")
        bounds = numbers("constraints.bounds", self.bounds, len(inputs))
        directions = Functionals.checked(inputs, self.directions).directions
        self.__dict__.update(inputs=inputs, normals=normals, bounds=bounds, directions=directions)

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def functionals(self) -> Functionals:
        """The values and derivatives that are constrained."""
        return Functionals(self.inputs, self.directions)

    def joined(self, other: LinearConstraints) -> LinearConstraints:
        """These constraints, then the others. Raises ValueError if I or O differs."""
        check_kind("other", other, LinearConstraints, "LinearConstraints(inputs, normals, bounds)")
        shapes = [
            (constraints.inputs.shape[1], constraints.normals.shape[1])
            for constraints in (self, other)
        ]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"other: constraints of {shapes[1]} inputs and outputs given, {shapes[0]} needed."
            )
        points = Functionals.concatenated([self.functionals, other.functionals])
        normals = np.concatenate([self.normals, other.normals])
        return LinearConstraints(
            points.inputs, normals, np.concatenate([self.bounds, other.bounds]), points.directions
        )


@dataclass(frozen=True, eq=False, repr=False)
class Constrained(Expansion):
    """The dense solution with J constraints on its mean; LC-KMP, section III.

    The mean has the least cost (4) of those that satisfy the constraints. It is f + sum_j a_j
    P(., s_j) g_j with the unconstrained mean f, the posterior covariance P = k - k (K + lambda
    Sigma)^-1 k^T and the multipliers a >= 0, which are 0 for inactive constraints. The covariance
    is the unconstrained one.
    The members are those of `Solution`.
    """

    solution: Dense
    constraints: LinearConstraints

    representation: ClassVar[Literal["dense"]] = "dense"

    @property
    def hyperparameters(self) -> Hyperparameters:
        return self.solution.hyperparameters

    @property
    def database(self) -> Database:
        return self.solution.database

    @cached_property
    def functionals(self) -> Functionals:
        """The N reference points, then the J constraints."""
        return Functionals.concatenated([self.solution.functionals, self.constraints.functionals])

    @cached_property
    def weights(self) -> Array:
        """(N + J, O) the weights of their kernels."""
        constraints = self.constraints
        outputs = self.hyperparameters.outputs
        kernel = self.hyperparameters.kernel
        c = self.hyperparameters.kernel.channels
        normals = constraints.normals.reshape(len(constraints), c, -1)
        points = constraints.functionals
        across = between(kernel, self.solution.functionals, points).reshape(-1, c, len(points), c)
        pulls = np.einsum("ncje,jed->ncdj", across, normals).reshape(-1, len(points))
        stacked = pulls.reshape(len(self.database), outputs, -1)
        back = self.solution.times_inverse(stacked).reshape(pulls.shape)  # (N O, J)
        within = between(kernel, points, points).reshape(len(points), c, len(points), c)
        stiffness = np.einsum("icd,icje,jed->ij", normals, within, normals) - pulls.T @ back

        def weights(multipliers: Array) -> Array:
            data = self.solution.weights - (back @ multipliers).reshape(-1, outputs)
            return np.concatenate([data, multipliers[:, None] * constraints.normals])

        def slack(multipliers: Array) -> Array:
            mean = mean_of(self.with_weights(weights(multipliers)), points)
            return np.asarray((mean * constraints.normals).sum(axis=1) - constraints.bounds)

        kkt_multipliers = _multipliers((stiffness + stiffness.T) / 2, slack)
        size = np.linalg.norm(constraints.normals, axis=1)
        missed = -slack(kkt_multipliers) / size
        for worst in np.flatnonzero(missed > _VIOLATION)[:1]:
            raise ValueError(
                f"The constraints cannot be met together: {worst} is missed by "
                f"{missed[worst]:.3g}. They contradict each other, or the reference's variance "
                "there is too small: give it more, or fewer constraints."
            )
        return frozen(weights(kkt_multipliers))

    def solved(self) -> Self:
        self.solution.solved()
        self.weights  # noqa: B018
        return self

    def posterior_covariance(self, rows: Array, prior: Array) -> Array:
        columns = len(self.database) * self.hyperparameters.kernel.channels
        return self.solution.posterior_covariance(rows[:, :columns], prior)


def _multipliers(stiffness: Array, slack: Callable[[Array], Array]) -> Array:
    """Multipliers a >= 0 (J,): the slack is 0 where a > 0, and >= 0 elsewhere.

    slack(a) = slack(0) + stiffness (J, J) a. Non-negative least squares gives the active
    constraints; Newton steps with the slack of the mean itself then remove rounding.
    """
    size = np.sqrt(np.maximum(np.diagonal(stiffness), np.finfo(np.float64).tiny))
    scaled = stiffness / np.outer(size, size)
    values, vectors = np.linalg.eigh(scaled)
    root = np.sqrt(np.maximum(values, _RIDGE * values[-1]))
    from scipy.optimize import nnls  # its import takes a quarter of a second

    multipliers = (
        nnls(root[:, None] * vectors.T, vectors.T @ (-slack(np.zeros(len(scaled))) / size) / root)[
            0
        ]
        / size
    )
    for _ in range(_ROUNDS):
        left = slack(multipliers)
        acts = (multipliers > 0) | (left < 0)
        if not acts.any() or np.abs(left[acts]).max() <= _CONVERGED:
            break
        step = (
            np.linalg.lstsq(scaled[np.ix_(acts, acts)], -left[acts] / size[acts], rcond=1e-13)[0]
            / size[acts]
        )
        multipliers = multipliers.copy()
        multipliers[acts] = np.maximum(multipliers[acts] + step, 0.0)
    return multipliers
