"""Correlation adaptation: equation (11); rewards grow while via-points are kept."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians
from kmp.correlation import Correlation, improve

T = np.linspace(0, 2, 60)[:, None]


def letter(representation="dense"):
    """A planar curve with strongly correlated outputs."""
    mean = np.hstack([np.sin(2 * T), np.cos(3 * T)])
    tied = 0.02 * np.array([[1.0, 0.95], [0.95, 1.0]])
    primitive = KMP.fit(
        T,
        Gaussians(mean, np.tile(tied, (60, 1, 1))),
        kernel=GaussianKernel(2.0),
        lambda_mean=2.0,
        representation=representation,
    )
    return primitive.adapt([[1.0]], Gaussians.of([[1.4, -1.2]], deviation=1e-4), tolerance=0.02)


def basis():
    return Correlation.neutral(np.linspace(0, 2, 5)[:, None], width=0.3, outputs=2)


def roughness(path):
    """Weighted smoothness, as in the paper: the first output costs more than the second."""
    return float(np.exp(-5 * np.linalg.norm(np.diff(path, axis=0) * [3.0, 0.3], axis=1).sum() / 10))


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_neutral_correlation_changes_nothing(representation):
    primitive = letter(representation)
    unchanged = basis().applied(primitive)
    assert unchanged.representation == representation
    np.testing.assert_allclose(unchanged.mean(T), primitive.mean(T), atol=1e-12)
    np.testing.assert_array_equal(unchanged.via_inputs, primitive.via_inputs)


def test_covariances_are_those_of_equation_11():
    correlation = Correlation(
        basis().centres, 0.3, np.random.default_rng(0).uniform(0.5, 2, size=(5, 2))
    )
    primitive = letter()
    covariances = correlation.applied(primitive).base.reference.covariance
    for n in (0, 20, 59):
        phi = np.exp(-0.5 * (T[n] - correlation.centres[:, 0]) ** 2 / 0.3**2)
        factor = np.diag(phi / phi.sum() @ correlation.theta)
        np.testing.assert_allclose(
            covariances[n], factor.T @ primitive.base.reference.covariance[n] @ factor, rtol=1e-9
        )


def test_negative_factor_flips_signs():
    """The covariances stay positive definite where the factor passes 0."""
    primitive = letter()
    before = primitive.base.reference.covariance
    for factor in (-2.0, -0.05, -0.02, 0.0, 0.02, 0.05, 2.0):
        covariances = (
            Correlation([[1.0]], 1.0, [[1.0, factor]]).applied(primitive).base.reference.covariance
        )
        assert np.linalg.eigvalsh(covariances).min() > 1e-3 * 0.05**2 * before.max()
        deviation = np.sqrt(covariances[:, 1, 1] / before[:, 1, 1])
        np.testing.assert_allclose(deviation, max(abs(factor), 0.05), rtol=1e-12)
        coefficient = covariances[:, 0, 1] / np.sqrt(covariances[:, 0, 0] * covariances[:, 1, 1])
        np.testing.assert_allclose(coefficient, 0.95 * np.clip(factor / 0.05, -1, 1), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_rewards_grow_and_via_point_is_met(seed):
    primitive = letter()
    result = improve(
        primitive,
        roughness,
        T,
        correlation=basis(),
        exploration=0.3,
        updates=15,
        rollouts=8,
        seed=seed,
    )
    assert result.rewards[-1] > 1.03 * result.rewards[0]
    assert roughness(result.primitive.mean(T)) >= result.rewards.max()
    np.testing.assert_allclose(result.primitive.mean([[1.0]]), [[1.4, -1.2]], atol=1e-3)
    assert len(result.rewards) == 16


def test_nearest_basis_function_rules_far_away():
    correlation = Correlation([[0.0], [1.0]], 0.01, [[2.0], [3.0]])
    np.testing.assert_allclose(correlation([[50.0], [-50.0]]), [[3], [2]])
