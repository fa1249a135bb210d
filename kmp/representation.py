"""Which way the costs of a database are solved: exactly, or on features of the kernel."""

from __future__ import annotations

import warnings

import numpy as np

from kmp.arrays.checks import RankReached
from kmp.dense import Dense
from kmp.low_rank import Features, LowRank
from kmp.problem.database import Database
from kmp.problem.hyperparameters import Hyperparameters
from kmp.solution import Solution, is_resolved

_TINY = 450  # numbers N O up to which the dense solution takes a millisecond at most
_SMALL = 1500  # numbers N O up to which a look for the rank of several inputs costs more than it may save
LARGE = 6000  # numbers N O above which the dense solution takes seconds and 300 MB
_LOW_SMALL, _LOW = 0.2, 0.45  # rank over N C up to which the low rank solution is the faster one
_RANK_AT_0, _RANK_PER_LENGTH = 8.0, 3.5  # rank = 8 + 3.5 range sqrt(ell) of one input, measured
_ROUNDING = 1e-12  # share of k(s, s) that rounding may leave, whatever is required


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
            f"{tolerance:.2g} is required: the mean at them may be off by up to {off:.2g} "
            "[unit of the outputs]. Raise the rank, or take a smaller ell or fewer points with the dense solution.",
            RankReached,
            stacklevel=3,
        )
    return solution


def _may_be_low(parameters: Hyperparameters, database: Database) -> bool:
    """True if the low rank may be the faster solution, judged before any feature is computed."""
    size, kernel = database.reference.mean.size, parameters.kernel
    if size <= _TINY or size > _SMALL:
        return size > _SMALL
    if database.inputs.shape[1] > 1:  # the rank grows with the number of inputs
        return False
    length = np.ptp(database.inputs) if kernel.period is None else kernel.period
    expected = _RANK_AT_0 + _RANK_PER_LENGTH * length * np.sqrt(np.max(kernel.ell))
    return bool(expected <= _LOW_SMALL * len(database) * kernel.channels)
