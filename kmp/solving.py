"""Which way the costs of a database are solved: exactly, or on features of the kernel."""

from __future__ import annotations

import warnings

from kmp.checks import RankReached
from kmp.database import Database
from kmp.dense import Dense
from kmp.hyperparameters import Hyperparameters
from kmp.low_rank import Features, LowRank
from kmp.solution import Solution, is_resolved

_SMALL = 450  # numbers N O up to which the dense solution takes a millisecond at most
LARGE = 6000  # numbers N O above which the dense solution takes seconds and 300 MB
_LOW = 0.3  # rank over N C, up to which the low rank solution is the faster one
_PROBE = 1 / 16  # of N C: the rank of a first look
_PROMISING = 0.1  # share of k(s, s) left by that first look, above which the rank is not low
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
    if representation == "dense" or (representation == "auto" and not _may_be_low(parameters, database)):
        return Dense(parameters, database).solved()
    optional = representation == "auto" and size <= LARGE
    most = min(rank, int(_LOW * len(database) * parameters.kernel.channels)) if optional else rank
    features, residual, made = Features.made(parameters.kernel, database.functionals, rank=most, tolerance=tolerance)
    reached = len(features.pivots) >= most
    enough = residual <= max(tolerance if reached else 100 * tolerance, _ROUNDING)
    if optional and not (enough and is_resolved(parameters, database)):
        return Dense(parameters, database).solved()
    solution = LowRank.fit(parameters, database, features, made=made).solved()
    if not enough:
        off = solution.error_bounds.at_points
        warnings.warn(
            f"rank: {rank} features leave up to {residual:.2g} of the kernel at the {len(database)} inputs, and "
            f"{tolerance:.2g} was asked for: the mean at them may be off by up to {off:.2g} "
            "[unit of the outputs]. Raise the rank, or take a smaller ell or fewer points with the dense solution.",
            RankReached,
            stacklevel=3,
        )
    return solution


def _may_be_low(parameters: Hyperparameters, database: Database) -> bool:
    """Whether a first look at the kernel allows a low rank."""
    size = database.reference.mean.size
    if not _SMALL < size <= LARGE:
        return size > LARGE
    rank = int(_PROBE * len(database) * parameters.kernel.channels)
    _, residual = Features.of(parameters.kernel, database.functionals, rank=rank, tolerance=_PROMISING)
    return residual <= _PROMISING
