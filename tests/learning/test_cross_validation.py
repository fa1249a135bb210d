"""Predictions of held-out groups in closed form equal those of a regression on the other points."""

import numpy as np
import pytest

from thirdhand.workbench.learning.cross_validation import (
    held_out_covariances,
    held_out_residuals,
    mahalanobis,
    squared_distances,
)

RANDOM = np.random.default_rng(0)
POINTS = RANDOM.normal(size=(20, 2))
TARGETS = RANDOM.normal(size=(20, 3))
GROUP = RANDOM.integers(0, 4, 20)
KERNEL = np.exp(-0.5 * ((POINTS[:, None] - POINTS) ** 2).sum(axis=2))
RATIOS = np.array([0.01, 0.3])


def test_residuals_are_those_without_the_group():
    assert squared_distances(POINTS) == pytest.approx(
        ((POINTS[:, None] - POINTS) ** 2).sum(axis=2), abs=1e-12
    )
    shifted = {number: TARGETS - number for number in range(4)}
    by_ratio = held_out_residuals(KERNEL, RATIOS, GROUP, shifted.__getitem__)
    for ratio, residuals in zip(RATIOS, by_ratio, strict=True):
        for number in range(4):
            training = number != GROUP
            mine = ~training
            noisy = KERNEL[np.ix_(training, training)] + ratio * np.eye(training.sum())
            mean = KERNEL[np.ix_(mine, training)] @ np.linalg.solve(
                noisy, shifted[number][training]
            )
            np.testing.assert_allclose(residuals[mine], shifted[number][mine] - mean, atol=1e-9)


def test_covariances_are_those_without_the_group():
    """A point's own noise is not in them."""
    roots = 0.3 * RANDOM.normal(size=(20, 3, 3)) + np.eye(3)
    scatter = roots @ roots.transpose(0, 2, 1)
    by_ratio = held_out_covariances(KERNEL, scatter, RATIOS, GROUP)
    for ratio, covariances in zip(RATIOS, by_ratio, strict=True):
        for i in range(20):
            own_group = GROUP[i]
            training = own_group != GROUP
            noisy = np.kron(KERNEL[np.ix_(training, training)], np.eye(3))
            for j, block in enumerate(scatter[training]):
                noisy[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] += ratio * block
            across = np.kron(KERNEL[i, training][None], np.eye(3))
            expected = np.eye(3) - across @ np.linalg.solve(noisy, across.T)
            np.testing.assert_allclose(covariances[i], expected, atol=1e-9)


def test_mahalanobis_distance_is_in_deviations():
    assert mahalanobis(np.array([[2.0, 0.0]]), np.diag([4.0, 1.0])[None]) == pytest.approx([1.0])
