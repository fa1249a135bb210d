"""Primitives and via-points from a seed, and what they are compared with."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from kmp import KMP, GaussianKernel, Gaussians

properties = settings(max_examples=15, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
kernel = GaussianKernel(0.5)


def database(seed=0, count=30, inputs=4, outputs=3):
    random = np.random.default_rng(seed)
    root = 0.1 * random.normal(size=(count, outputs, outputs))
    covariance = root @ root.swapaxes(1, 2) + 1e-4 * np.eye(outputs)
    return random.normal(size=(count, inputs)), Gaussians(random.normal(size=(count, outputs)), covariance)


def skill(seed=0, lambda_mean=2.0, lambda_covariance=None, prior_mean=None, **size):
    inputs, reference = database(seed, **size)
    return KMP.fit(
        inputs,
        reference,
        kernel=kernel,
        lambda_mean=lambda_mean,
        lambda_covariance=lambda_covariance,
        prior_mean=prior_mean,
    )


def via(seed, count, inputs=4, outputs=3, std=1e-4):
    random = np.random.default_rng(seed)
    points = Gaussians(random.normal(size=(count, outputs)), np.tile(std**2 * np.eye(outputs), (count, 1, 1)))
    return random.normal(size=(count, inputs)), points


def naive(inputs, reference, query, *, lambda_mean, lambda_covariance, prior_mean, count):
    """Equations (8), (9) and the covariance of the IJRR paper, written down as they stand."""
    o = reference.mean.shape[1]
    unit = np.eye(o)
    big = np.kron(np.exp(-kernel.ell * ((inputs[:, None] - inputs) ** 2).sum(axis=2)), unit)
    row = np.kron(np.exp(-kernel.ell * ((query - inputs) ** 2).sum(axis=1))[None], unit)
    sigma = block_diag(*reference.covariance)
    alpha = np.linalg.solve(big + lambda_mean * sigma, (reference.mean - prior_mean).ravel())
    explained = row @ np.linalg.solve(big + lambda_covariance * sigma, row.T)
    return prior_mean + row @ alpha, count / lambda_covariance * (unit - explained)


def same_bits(a, b, queries):
    one, direction = queries[0], np.ones(queries.shape[1])
    return all(
        np.array_equal(x, y)
        for x, y in [
            (a.mean(queries), b.mean(queries)),
            (a.mean(queries[:1]), b.mean(queries[:1])),
            (a.jacobian(one), b.jacobian(one)),
            (a.curvature(one, direction), b.curvature(one, direction)),
            (a.predict(queries[:1]).covariance, b.predict(queries[:1]).covariance),
            (a.predict(queries).covariance, b.predict(queries).covariance),
        ]
    )
