"""Which way the costs of a database are solved: exactly, or on features of the kernel."""

from __future__ import annotations

import warnings

from kmp.checks import RankReached
from kmp.database import Database
from kmp.dense import Dense
from kmp.hyperparameters import Hyperparameters
from kmp.low_rank import Features, LowRank
from kmp.solution import Solution

_SMALL = 1500  # N O up to which the dense solution is the faster one
_LARGE = 6000  # N O beyond which the dense solution takes seconds and 300 MB
_ROUNDING = 1e-12  # share of k(s, s) that rounding may leave, whatever was asked for


def solved(
    parameters: Hyperparameters,
    database: Database,
    representation: str,
    rank: int,
    tolerance: float,
) -> Solution:
    """The database solved. Warns `RankReached` where the rank does not suffice."""
    size = database.reference.mean.size
    if representation == "dense" or (representation == "auto" and size <= _SMALL):
        return Dense(parameters, database).solved()
    features, residual, made = Features.made(parameters.kernel, database.functionals, rank=rank, tolerance=tolerance)
    reached = len(features.pivots) >= rank
    enough = residual <= max(tolerance if reached else 100 * tolerance, _ROUNDING)
    if representation == "auto" and not enough and size <= _LARGE:
        return Dense(parameters, database).solved()
    solution = LowRank.fit(parameters, database, features, made=made).solved()
    if not enough:
        warnings.warn(
            f"rank: {rank} features leave up to {residual:.2g} of the kernel at the {len(database)} inputs, and "
            f"{tolerance:.2g} was asked for: the mean at them may be off by up to {solution.error_bounds.at_points:.2g} "
            "[unit of the outputs]. Raise the rank, or take a smaller ell or fewer points with the dense solution.",
            RankReached,
            stacklevel=3,
        )
    return solution
