"""Choice between the dense solution, of cost (N O)^3, and the low rank, of cost N O r^2.

Over one input the rank r is about 8 + 3.5 range sqrt(ell); the low rank is the faster solution
below a share of N.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kmp.arrays.checks import RankReached
from kmp.dense import SINGLE, Dense
from kmp.low_rank import FLOOR, Features, LowRank
from kmp.outputs import (
    Mapped,
    decoupled_groups,
    inner_problem,
    output_map,
    variances_over_prior,
)
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import Solution, is_resolved

_Some = TypeVar("_Some", Dense, LowRank)

_SMALL = 1500  # N O up to which finding the rank of several inputs costs more than it can save
LARGE = 6000  # N O above which the dense solution takes seconds and 300 MB
# the low rank is faster below these r / (N C), estimated and found
_LOW_EXPECTED = 0.2
_LOW = 0.45
# measured: r = 8 + 3.5 range sqrt(ell) over one input
_RANK_AT_0 = 8.0
_RANK_PER_LENGTH = 3.5
_FEW = 64  # N C up to which all features that rounding allows cost nothing
_ROUNDING = 1e-12  # a residual of this share of k(s, s) is rounding, and always allowed


def solved(
    parameters: Hyperparameters,
    database: Database,
    representation: str,
    rank: int,
    tolerance: float,
) -> Solution:
    """The solution of the database. Warns `RankReached` if the rank does not suffice."""
    t = output_map(parameters, database.reference)
    if t is None:
        return _solved(parameters, database, representation, rank, tolerance)
    with variances_over_prior(parameters):
        problem = inner_problem(parameters, database, t)
        inner = _solved(*problem, representation, rank, tolerance)
    return Mapped.around(parameters, database, t, inner).solved()


def dense(parameters: Hyperparameters, database: Database) -> Dense | Mapped:
    """The dense solution, of each group of outputs by itself where these decouple."""
    groups = decoupled_groups(parameters, database.reference, alike=True)
    return _of_groups(parameters, database, groups, Dense)


def _of_groups(
    parameters: Hyperparameters,
    database: Database,
    groups: tuple[NDArray[np.intp], ...],
    solution: Callable[[Hyperparameters, Database], _Some],
) -> _Some | Mapped:
    if len(groups) == 1:
        return solution(parameters, database)
    return Mapped.of_groups(parameters, database, groups, lambda p, d, _: solution(p, d))


def _solved(
    parameters: Hyperparameters,
    database: Database,
    representation: str,
    rank: int,
    tolerance: float,
) -> Solution:
    size = database.reference.mean.size
    if representation == "dense" or (
        representation == "auto" and not _may_be_low(parameters, database)
    ):
        return dense(parameters, database).solved()
    optional = representation == "auto" and size <= LARGE
    most = min(rank, int(_LOW * len(database) * parameters.kernel.channels)) if optional else rank
    points = database.functionals
    kernel = parameters.kernel
    if len(points) * kernel.channels <= _FEW:
        tolerance = min(tolerance, 2 * FLOOR)
    features, residual, values = Features.with_values(
        kernel, points, rank=most, tolerance=tolerance
    )
    reached = len(features.pivots) >= most
    enough = residual <= max(tolerance if reached else 100 * tolerance, _ROUNDING)
    if optional and not (enough and is_resolved(parameters, database)):
        return dense(parameters, database).solved()
    groups = decoupled_groups(parameters, database.reference, alike=False)
    solution = _of_groups(
        parameters, database, groups, lambda p, d: LowRank.fit(p, d, features, values=values)
    ).solved()
    if not enough:
        warnings.warn(
            f"rank: {rank} features leave up to {residual:.2g} of the kernel at the "
            f"{len(database)} inputs, and {tolerance:.2g} is required: the mean differs from the "
            "dense solution's. Raise the rank, or take a smaller ell or fewer points with the "
            "dense solution.",
            RankReached,
            stacklevel=4,
        )
    return solution


def _may_be_low(parameters: Hyperparameters, database: Database) -> bool:
    """True if the low rank may be the faster solution, estimated before features exist."""
    size = database.reference.mean.size
    kernel = parameters.kernel
    if database.inputs.shape[1] > 1:  # the rank grows with the number of inputs
        apart = len(decoupled_groups(parameters, database.reference, alike=False))
        return size // apart > _SMALL
    if size <= SINGLE or size > _SMALL:
        return size > _SMALL
    length = np.ptp(database.inputs) if kernel.period is None else kernel.period
    expected = _RANK_AT_0 + _RANK_PER_LENGTH * length * np.sqrt(np.max(kernel.ell))
    return bool(expected <= _LOW_EXPECTED * len(database) * kernel.channels)
