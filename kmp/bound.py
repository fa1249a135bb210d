"""How far the low rank solution can be from the dense one."""

from __future__ import annotations

import numpy as np

from kmp.checks import Array
from kmp.gaussians import Gaussians
from kmp.low_rank import Conditioned, LowRank

_BLOCK = 8192  # rows at once, which bounds the memory


def error_bound(solution: LowRank | Conditioned, inputs: Array, reference: Gaussians, mean: Array, *, lambda_mean: float) -> float:
    """The largest distance of the mean (N, O) at the inputs (N, I) from the dense solution's: the least of two bounds.

    Let K = Z^T Z + E: E is positive semidefinite and its diagonal e is known. With alpha = Sigma^-1 (mu - xi) / lambda
    the low rank solution is the dense one for means moved by E alpha, of which element n is at most
    sqrt(e_n) sum_m sqrt(e_m) |alpha_m|; and moving the means by delta moves the solution f by so much that
    |Sigma^-1/2 df| <= |Sigma^-1/2 delta|. This is the lower where the rank suffices.

    The cost (4) is quadratic and least at the dense solution, so |Sigma^-1/2 df|^2 is at most what (4) is here.
    """
    low = solution.base if isinstance(solution, Conditioned) else solution
    added = solution.added if isinstance(solution, Conditioned) else 0
    c, count = low.kernel.channels, len(inputs)
    miss = reference.mean - mean
    pull = np.linalg.solve(reference.covariance, miss[:, :, None])[:, :, 0]
    variances = np.linalg.eigvalsh(reference.covariance)

    own = np.diagonal(low.kernel.own)
    left = np.concatenate([low.features.left(inputs[i : i + _BLOCK]) for i in range(0, count, _BLOCK)])
    root = np.sqrt(left * own)[:, :, None]  # (N, C, 1)
    pulled = root * np.abs(pull.reshape(count, c, -1)) / lambda_mean
    data, via = pulled[: count - added].sum(axis=(0, 1)), pulled[count - added :].sum(axis=(0, 1))
    moved = root * (data + via)  # (N, C, D)
    moved[count - added :] -= root[count - added :] * via  # between via-points nothing is neglected
    total = np.sqrt(((moved**2).sum(axis=(1, 2)) / variances[:, 0]).sum())
    by_means = total + moved[: count - added].max(initial=0) / np.sqrt(variances[:, -1].max())

    weights = solution.weights.reshape(len(solution.centres) * c, -1)
    penalty = (weights * (low.kernel(solution.centres, solution.centres) @ weights)).sum()
    by_cost = np.sqrt((miss * pull).sum() + lambda_mean * max(float(penalty), 0.0))
    return float(np.sqrt(variances[:, -1].max()) * min(by_means, by_cost))
