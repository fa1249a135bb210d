"""Upper bounds of the distance between the low rank mean and the dense mean."""

from __future__ import annotations

import numpy as np

from kmp.kernel import between, variances
from kmp.low_rank.features import BLOCK, Features
from kmp.solution import ErrorBounds, Solution, mean_of


def error_bounds(solution: Solution, features: Features, *, added: int = 0) -> ErrorBounds:
    """Upper bounds of the distance between this mean and the dense solution's.

    The last `added` reference points are via-points. Let K = Z^T Z + E, where E is positive
    semidefinite and has the known diagonal e. Let alpha = Sigma^-1 (mu - xi) / lambda, with the
    prior mean subtracted.

    At any query: the gradient of the cost (4) at the mean xi is 2 lambda h with h = xi - sum_n
    k(., s_n) alpha_n, and its Hessian is at least 2 lambda. So the mean is at most |h| from that of
    least cost in the norm of the kernel, and at most sqrt(k(s, s)) |h| at a query s. |h|^2 is at
    most |g|^2 + (sum_n sqrt(e_n) |alpha_n|)^2, where g = Z alpha - w is the residual of the low
    rank equations.

    At the reference points: the lesser of two bounds. The low rank solution is the dense one for
    means moved by delta = K alpha - xi, and off by (I - S) delta, where S smooths: |Sigma^-1/2 (I -
    S) delta| is at most |Sigma^-1/2 delta|, and sqrt(lambda) / 2 |g| where delta = Z^T g. The
    first bound is the sum of that of E alpha, whose element n is at most sqrt(e_n) sum_m sqrt(e_m)
    |alpha_m|, and that of g. It is the lower one if the rank suffices. The second bound: the cost
    (4) is quadratic and least at the dense solution, so |Sigma^-1/2 df|^2 is at most the cost (4).
    """
    kernel = features.kernel
    lambda_mean = solution.hyperparameters.lambda_mean
    points = solution.database.functionals
    reference = solution.database.reference
    functionals = solution.functionals
    c = kernel.channels
    count = len(points)
    rank = len(features.pivots)
    blocks = [points.take(slice(i, i + BLOCK)) for i in range(0, count, BLOCK)]
    error = reference.mean - np.concatenate([mean_of(solution, block) for block in blocks])
    pull = np.linalg.solve(reference.covariance, error[:, :, None])[:, :, 0]
    spread = np.linalg.eigvalsh(reference.covariance)

    alpha = pull.reshape(count, c, -1) / lambda_mean  # (N, C, D)
    weights = solution.weights.reshape(len(functionals), c, -1)
    neglected = alpha.copy()
    neglected[count - added :] = 0  # to via-points, the residual is included
    alpha[count - added :] -= weights[rank:]
    residual = np.concatenate([features.residual(block) for block in blocks])
    root = np.sqrt(residual * variances(kernel, points))[:, :, None]  # (N, C, 1)
    outside = (root * np.abs(neglected)).sum(axis=(0, 1))  # (D,)
    moved = root * outside
    unsolved = -features.root.T @ weights[np.arange(rank), features.channels]  # g (r, D)
    for i, block in zip(range(0, count, BLOCK), blocks, strict=True):
        part = alpha[i : i + BLOCK]
        unsolved += features(block) @ part.reshape(-1, part.shape[2])
    via = points.take(slice(count - added, None))
    via_alpha = alpha[count - added :].reshape(added * c, alpha.shape[2])
    z = features(via)
    via_residual = between(kernel, via, via) - z.T @ z
    between_via = np.sqrt(np.maximum((via_alpha * (via_residual @ via_alpha)).sum(axis=0), 0.0))
    distance = np.sqrt((unsolved**2).sum() + ((outside + between_via) ** 2).sum())  # |h|
    squared = (unsolved**2).sum() + (between_via**2).sum()
    by_means = (
        np.sqrt(((moved**2).sum(axis=(1, 2)) / spread[:, 0]).sum())
        + np.sqrt(lambda_mean * squared) / 2
    )

    flat = weights.reshape(len(functionals) * c, -1)
    penalty = (flat * (between(kernel, functionals, functionals) @ flat)).sum()
    by_cost = np.sqrt((error * pull).sum() + lambda_mean * max(float(penalty), 0.0))
    at_points = float(np.sqrt(spread[:, -1].max()) * min(by_means, by_cost))
    return ErrorBounds(at_points, float(np.sqrt(kernel.prior_variance.max()) * distance))
