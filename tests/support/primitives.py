"""Primitives and via-points from a seed, and the naive solution for comparison."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

import kmp
from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel
from kmp.functionals import Functionals
from kmp.kernel import between

properties = settings(max_examples=15, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
representations = st.sampled_from(["dense", "low_rank"])
kernel = GaussianKernel(0.5)
OF_MODULES = {
    "correlation": ("Correlation", "Improvement", "improve"),
    "reference": ("gaussian_process_reference",),
    "results": ("MotionPrediction", "Stored", "Uncertainty"),
    "selection": ("Learned", "Score"),
}
KERNELS = {
    "one length": GaussianKernel(0.5),
    "a length an input": GaussianKernel([0.5, 1.0, 2.0]),
    "velocity": VelocityKernel(2.0),
}


def offered():
    """All names that the package offers, and their values."""
    members = {name: getattr(kmp, name) for name in kmp.__all__}
    for module, names in OF_MODULES.items():
        members |= {name: getattr(getattr(kmp, module), name) for name in names}
    return members


def curve(kernel):
    """Inputs (60, I) and normals along a path: over three inputs, or over time with its rates."""
    t = np.linspace(0, 2, 60)[:, None]
    has_rates = kernel.channels == 2
    rates = [2 * np.cos(2 * t), -3 * np.sin(3 * t)] if has_rates else []
    mean = np.hstack([np.sin(2 * t), np.cos(3 * t), *rates])
    inputs = t if has_rates else np.hstack([t, np.sin(3 * t), np.cos(2 * t)])
    outputs = mean.shape[1]
    root = 0.05 * np.random.default_rng(0).normal(size=(60, outputs, outputs))
    return inputs, Gaussians(mean, root @ root.swapaxes(1, 2) + 1e-3 * np.eye(outputs))


def database(seed=0, count=30, inputs=4, outputs=3):
    random = np.random.default_rng(seed)
    root = 0.1 * random.normal(size=(count, outputs, outputs))
    covariance = root @ root.swapaxes(1, 2) + 1e-4 * np.eye(outputs)
    return random.normal(size=(count, inputs)), Gaussians(
        random.normal(size=(count, outputs)), covariance
    )


def skill(seed=0, *, lambda_covariance=None, prior_mean=None, representation="dense", **size):
    inputs, reference = database(seed, **size)
    options = {
        "lambda_covariance": lambda_covariance,
        "prior_mean": prior_mean,
        "representation": representation,
    }
    return KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2.0, **options)


def via(seed, count, inputs=4, outputs=3, std=1e-4):
    random = np.random.default_rng(seed)
    points = Gaussians.of(random.normal(size=(count, outputs)), deviation=std)
    return random.normal(size=(count, inputs)), points


def naive(one, queries):
    """Mean (M, O) and joint covariance (M, O, M, O) by equations (8), (9) and that of IJRR 2019 for
    values and derivatives, by definition.
    """
    functionals = one.inner.solution.database.functionals
    outputs = one.reference.outputs
    unit = np.eye(outputs // one.kernel.channels)
    sigma = block_diag(*one.reference.covariance)
    big = np.kron(between(one.kernel, functionals, functionals), unit)
    row = np.kron(between(one.kernel, Functionals(queries), functionals), unit)
    prior = np.kron(one.kernel(queries, queries), unit)
    right = one.reference.mean - functionals.values[:, None] * one.prior_mean
    alpha = np.linalg.solve(big + one.lambda_mean * sigma, right.ravel())
    explained = row @ np.linalg.solve(big + one.lambda_covariance * sigma, row.T)
    covariance = (prior - explained) * len(one.base.inputs) / one.lambda_covariance
    return (row @ alpha).reshape(-1, outputs) + one.prior_mean, covariance.reshape(
        2 * (len(queries), outputs)
    )


def same_bits(a, b, queries):
    query = queries[0]
    moving = query, np.ones(queries.shape[1]), np.zeros(queries.shape[1])
    return all(
        np.array_equal(x, y)
        for x, y in [
            (a.mean(queries), b.mean(queries)),
            (a.mean(queries[:1]), b.mean(queries[:1])),
            (a.jacobian(query), b.jacobian(query)),
            (a.predict_motion(*moving).curvature, b.predict_motion(*moving).curvature),
            (a.predict(queries[:1]).covariance, b.predict(queries[:1]).covariance),
            (a.predict(queries).covariance, b.predict(queries).covariance),
        ]
    )
