"""The numbers of kmp are those of the paper's equations, written here in plain NumPy."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel

ELL = 6.0
LAMBDA_MEAN = 1.0
LAMBDA_COVARIANCE = 60.0
TOLERANCE_S = 0.0005
T = np.linspace(0, 2, 60)
QUERIES = np.linspace(-0.2, 2.2, 31)
POSITIONS = np.stack([np.sin(3 * T), np.cos(2 * T)], axis=1)
RATES = np.stack([3 * np.cos(3 * T), -2 * np.sin(2 * T)], axis=1)


def kernel_matrix(a, b, channels):
    """The blocks of all pairs of times: of positions, or of positions and their rates."""
    r = a[:, None] - b
    k = np.exp(-ELL * r**2)
    if channels == 1:
        return np.kron(k, np.eye(2))
    blocks = [[k, 2 * ELL * r * k], [-2 * ELL * r * k, (2 * ELL - 4 * ELL**2 * r**2) * k]]
    return sum(
        np.kron(blocks[i][j], np.kron(np.outer(np.eye(2)[i], np.eye(2)[j]), np.eye(2)))
        for i in range(2)
        for j in range(2)
    )


def predicted(t, mean, covariance, channels):
    """Means and covariances at QUERIES: k (K + lambda Sigma)^-1 mu, N / lambda_c (...)."""
    n, outputs = mean.shape
    k = kernel_matrix(t, t, channels)
    rows = kernel_matrix(QUERIES, t, channels)
    sigma = block_diag(*covariance)
    means = rows @ np.linalg.solve(k + LAMBDA_MEAN * sigma, mean.ravel())
    gain = rows @ np.linalg.solve(k + LAMBDA_COVARIANCE * sigma, rows.T)
    whole = (kernel_matrix(QUERIES, QUERIES, channels) - gain) * n / LAMBDA_COVARIANCE
    blocks = whole.reshape(len(QUERIES), outputs, len(QUERIES), outputs)
    return means.reshape(-1, outputs), np.einsum("mimj->mij", blocks)


def inserted(t, mean, covariance, time, desired, variance):
    """Algorithm 1: the desired point replaces one within the tolerance, or is appended."""
    nearest = np.abs(t - time).argmin()
    index = nearest if abs(t[nearest] - time) < TOLERANCE_S else len(t)
    return [
        np.concatenate([old[:index], [new], old[index + 1 :]])
        for old, new in ((t, time), (mean, desired), (covariance, variance))
    ]


def check(prediction, expected):
    for ours, theirs in zip((prediction.mean, prediction.covariance), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("time", [T[20] + 1e-4, 0.7123], ids=["replaced", "appended"])
def test_numbers_are_those_of_the_equations(channels, time):
    """Before a via-point and after, with the N of the base or of all points."""
    mean = POSITIONS if channels == 1 else np.hstack([POSITIONS, RATES])
    root = 0.1 * np.random.default_rng(0).normal(size=(len(T), 2 * channels, 2 * channels))
    covariance = root @ root.mT + 0.01 * np.eye(2 * channels)
    parameters = {
        "kernel": GaussianKernel(ELL) if channels == 1 else VelocityKernel(ELL),
        "lambda_mean": LAMBDA_MEAN,
        "lambda_covariance": LAMBDA_COVARIANCE,
        "representation": "dense",
    }
    skill = KMP.fit(T[:, None], Gaussians(mean, covariance), **parameters)
    check(skill.predict(QUERIES[:, None]), predicted(T, mean, covariance, channels))

    desired = mean[20] + 0.05
    variance = 1e-2 * np.eye(2 * channels)
    database = inserted(T, mean, covariance, time, desired, variance)
    adapted = skill.adapt([[time]], Gaussians([desired], [variance]), tolerance=TOLERANCE_S)
    means, covariances = predicted(*database, channels)
    count = len(database[0])
    check(adapted.predict(QUERIES[:, None]), (means, covariances * len(T) / count))

    anew = KMP.fit(database[0][:, None], Gaussians(*database[1:]), **parameters)
    check(anew.predict(QUERIES[:, None]), (means, covariances))
