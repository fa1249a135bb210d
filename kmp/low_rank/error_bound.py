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
    the low rank solution is the dense one for means moved by delta = K alpha - xi, the prior mean
    subtracted, and off by (I - S) delta, where S smooths: |Sigma^-1/2 (I - S) delta| is at most
    |Sigma^-1/2 delta|, and sqrt(lambda) / 2 |g| where delta = Z^T g. So count E alpha, of which
    element n is at most sqrt(e_n) sum_m sqrt(e_m) |alpha_m|, and g = Z alpha - w, by which the low
    rank equations are not solved. This is the lower where the rank suffices.

    The cost (4) is quadratic and least at the dense solution: |Sigma^-1/2 df|^2 is at most what (4)
    is.
    """
    kernel, lambda_mean = features.kernel, solution.hyperparameters.lambda_mean
    points, reference, known = solution.database.functionals, solution.database.reference, solution.functionals
    c, count, rank = kernel.channels, len(points), len(features.pivots)
    blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
    miss = reference.mean - np.concatenate([mean_of(solution, block) for block in blocks])
    pull = np.linalg.solve(reference.covariance, miss[:, :, None])[:, :, 0]
    spread = np.linalg.eigvalsh(reference.covariance)

    alpha = pull.reshape(count, c, -1) / lambda_mean  # (N, C, D)
    weights = solution.weights.reshape(len(known), c, -1)
    neglected = alpha.copy()
    neglected[count - added :] = 0  # to via-points nothing is neglected
    alpha[count - added :] -= weights[rank:]
    residual = np.concatenate([features.residual(block) for block in blocks])
    root = np.sqrt(residual * variances(kernel, points))[:, :, None]  # (N, C, 1)
    moved = root * (root * np.abs(neglected)).sum(axis=(0, 1))
    unsolved = -features.root.T @ weights[:rank, 0]  # g (r, D)
    for i, block in zip(range(0, count, BLOCK), blocks, strict=True):
        part = alpha[i : i + BLOCK]
        unsolved += features(block) @ part.reshape(-1, part.shape[2])
    via = points.take(slice(count - added, None))
    apart = alpha[count - added :].reshape(added * c, alpha.shape[2])
    z = features(via)
    squared = (unsolved**2).sum() + (apart * ((between(kernel, via, via) - z.T @ z) @ apart)).sum()
    by_means = np.sqrt(((moved**2).sum(axis=(1, 2)) / spread[:, 0]).sum()) + np.sqrt(lambda_mean * squared) / 2

    flat = weights.reshape(len(known) * c, -1)
    penalty = (flat * (between(kernel, known, known) @ flat)).sum()
    by_cost = np.sqrt((miss * pull).sum() + lambda_mean * max(float(penalty), 0.0))
    return float(np.sqrt(spread[:, -1].max()) * min(by_means, by_cost))
