"""How far the low rank solution can be from the dense one."""

from __future__ import annotations

import numpy as np

from kmp.kernel import between, variances
from kmp.low_rank.features import BLOCK, Features
from kmp.solution import Solution, mean_of


def error_bound(solution: Solution, features: Features, *, added: int = 0) -> float:
    """The largest distance of the mean at the reference points from the dense solution's, at most.

    The last `added` reference points are via-points. The least of two bounds. Let K = Z^T Z + E: E
    is positive semidefinite and its diagonal e is known. With alpha = Sigma^-1 (mu - xi) / lambda
    the low rank solution is the dense one for means moved by E alpha, of which element n is at most
    sqrt(e_n) sum_m sqrt(e_m) |alpha_m|; and moving the means by delta moves the solution f by so
    much that |Sigma^-1/2 df| <= |Sigma^-1/2 delta|. This is the lower where the rank suffices.

    The cost (4) is quadratic and least at the dense solution: |Sigma^-1/2 df|^2 is at most what (4)
    is.
    """
    kernel, lambda_mean = features.kernel, solution.hyperparameters.lambda_mean
    points, reference = solution.database.functionals, solution.database.reference
    c, count = kernel.channels, len(points)
    blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
    miss = reference.mean - np.concatenate([mean_of(solution, block) for block in blocks])
    pull = np.linalg.solve(reference.covariance, miss[:, :, None])[:, :, 0]
    spread = np.linalg.eigvalsh(reference.covariance)

    residual = np.concatenate([features.residual(block) for block in blocks])
    root = np.sqrt(residual * variances(kernel, points))[:, :, None]  # (N, C, 1)
    pulled = root * np.abs(pull.reshape(count, c, -1)) / lambda_mean
    data, via = pulled[: count - added].sum(axis=(0, 1)), pulled[count - added :].sum(axis=(0, 1))
    moved = root * (data + via)  # (N, C, D)
    moved[count - added :] -= root[count - added :] * via  # between via-points nothing is neglected
    total = np.sqrt(((moved**2).sum(axis=(1, 2)) / spread[:, 0]).sum())
    by_means = total + moved[: count - added].max(initial=0) / np.sqrt(spread[:, -1].max())

    weights = solution.weights.reshape(len(solution.functionals) * c, -1)
    penalty = (weights * (between(kernel, solution.functionals, solution.functionals) @ weights)).sum()
    by_cost = np.sqrt((miss * pull).sum() + lambda_mean * max(float(penalty), 0.0))
    return float(np.sqrt(spread[:, -1].max()) * min(by_means, by_cost))
