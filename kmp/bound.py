"""How far the low rank solution can be from the dense one."""

from __future__ import annotations

import numpy as np

from kmp.checks import Array
from kmp.gaussians import Gaussians
from kmp.low_rank import Conditioned, LowRank

_BLOCK = 8192  # rows at once, which bounds the memory


def error_bound(solution: LowRank | Conditioned, inputs: Array, reference: Gaussians, miss: Array) -> float:
    """The largest distance of the means at the inputs (N, I) from the dense solution's, given mu - xi there (N, O).

    Let K = Z^T Z + E: E is positive semidefinite and its diagonal e is known. With alpha = Sigma^-1 (mu - xi) / lambda
    the low rank solution is the dense one for means moved by E alpha, of which element n is at most
    sqrt(e_n) sum_m sqrt(e_m) |alpha_m|; and moving the means by delta moves the solution f by so much that
    |Sigma^-1/2 df| <= |Sigma^-1/2 delta|.
    """
    low = solution.base if isinstance(solution, Conditioned) else solution
    added = solution.added if isinstance(solution, Conditioned) else 0
    c, count = low.kernel.channels, len(inputs)
    own = np.diagonal(low.kernel.own)
    alpha = np.linalg.solve(reference.covariance, miss[:, :, None]).reshape(count, c, -1) / low.problem.lambda_mean
    left = np.concatenate([low.features.left(inputs[i : i + _BLOCK]) for i in range(0, count, _BLOCK)])
    root = np.sqrt(left * own)[:, :, None]  # (N, C, 1)
    pulled = root * np.abs(alpha)
    data, via = pulled[: count - added].sum(axis=(0, 1)), pulled[count - added :].sum(axis=(0, 1))
    moved = root * (data + via)  # (N, C, D)
    moved[count - added :] -= root[count - added :] * via  # between via-points nothing is neglected
    variances = np.linalg.eigvalsh(reference.covariance)
    total = np.sqrt(((moved**2).sum(axis=(1, 2)) / variances[:, 0]).sum())
    return float(np.sqrt(variances[:, -1].max()) * total + moved[: count - added].max(initial=0))
