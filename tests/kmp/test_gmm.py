"""The mixture: regression against sampling and the textbook, determinism, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from sklearn.mixture import GaussianMixture as Estimator

from kmp import GaussianMixture

properties = settings(max_examples=15, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def mixture(seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 4, 4))
    weights = random.uniform(0.2, 1, size=3)
    return GaussianMixture(
        weights / weights.sum(),
        random.normal(size=(3, 4)),
        root @ root.swapaxes(1, 2) + 0.1 * np.eye(4),
    )


def demonstrations():
    random = np.random.default_rng(0)
    t = np.tile(np.linspace(0, 2, 100), 5)
    path = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    return np.column_stack([t, path + 0.02 * random.normal(size=path.shape)])


def test_em_finds_two_clusters():
    random = np.random.default_rng(0)
    samples = np.concatenate(
        [random.normal([0, 0], 0.1, (300, 2)), random.normal([5, 1], [0.3, 0.1], (100, 2))]
    )
    model = GaussianMixture.fit(samples, components=2, seed=0)
    left, right = np.argsort(model.means[:, 0])
    np.testing.assert_allclose(model.means[[left, right]], [[0, 0], [5, 1]], atol=0.1)
    np.testing.assert_allclose(model.weights[[left, right]], [0.75, 0.25], atol=1e-3)
    np.testing.assert_allclose(model.covariances[right], np.diag([0.09, 0.01]), atol=0.03)


def test_the_same_seed_gives_the_same_bits():
    a, b = (GaussianMixture.fit(demonstrations(), components=5, seed=3) for _ in range(2))
    assert np.array_equal(a.means, b.means)
    assert np.array_equal(a.covariances, b.covariances)
    assert np.array_equal(
        a.sample_inputs(9, dimensions=1, seed=4), b.sample_inputs(9, dimensions=1, seed=4)
    )
    assert not np.array_equal(
        a.sample_inputs(9, dimensions=1, seed=4), a.sample_inputs(9, dimensions=1, seed=5)
    )


@properties
@given(seeds)
def test_regression_has_conditional_moments(seed):
    """Regression is the first two moments of the conditional mixture."""
    mix = mixture(seed)
    s = np.random.default_rng(seed).normal(size=2)
    components = list(zip(mix.weights, mix.means, mix.covariances, strict=True))
    share = np.array([w * multivariate_normal(m[:2], c[:2, :2]).pdf(s) for w, m, c in components])
    share /= share.sum()
    first = np.zeros(2)
    second = np.zeros((2, 2))
    for h, m, c in zip(share, mix.means, mix.covariances, strict=True):
        gain = c[2:, :2] @ np.linalg.inv(c[:2, :2])
        mean = m[2:] + gain @ (s - m[:2])
        first += h * mean
        second += h * (c[2:, 2:] - gain @ c[:2, 2:] + np.outer(mean, mean))
    reference = mix.regress(s[None])
    np.testing.assert_allclose(reference.mean[0], first, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(
        reference.covariance[0], second - np.outer(first, first), rtol=1e-6, atol=1e-8
    )


def test_regression_far_away_is_finite():
    """Regression far away is still finite and positive definite."""
    reference = mixture(1).regress(np.array([[1e4, -1e4]]))
    assert np.isfinite(reference.mean).all()
    assert (np.linalg.eigvalsh(reference.covariance) > 0).all()


def test_sampled_inputs_have_marginal_moments():
    mix = mixture(5)
    drawn = mix.sample_inputs(40_000, dimensions=2, seed=0)
    mean = mix.weights @ mix.means[:, :2]
    spread = mix.means[:, :2] - mean
    covariance = (
        np.einsum("k,kij->ij", mix.weights, mix.covariances[:, :2, :2])
        + (mix.weights * spread.T) @ spread
    )
    assert drawn.shape == (40_000, 2)
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.05)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, rtol=0.05, atol=0.05)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (
            lambda: GaussianMixture.fit([[0.0, 1.0]], components=5, seed=0),
            "1 samples given for 5 components: give at",
        ),
        (
            lambda: mixture(0).regress(np.zeros((1, 4))),
            "4 input dimensions given; this mixture of 4 .* takes 1 to 3",
        ),
        (
            lambda: GaussianMixture([0.5, 0.4], np.zeros((2, 1)), np.ones((2, 1, 1))),
            "numbers of sum 1, none below 0",
        ),
        (
            lambda: GaussianMixture([1.0], np.zeros((2, 1)), np.ones((2, 1, 1))),
            r"means: shape \(2, 1\) given, \(1, I",
        ),
    ],
)
def test_impossible_mixtures_are_refused(call, says):
    """Impossible requests are refused, with what is possible."""
    with pytest.raises(ValueError, match=says):
        call()


@pytest.mark.parametrize("components", [1, 4, 9])
def test_mixture_is_that_of_scikit_learn(components):
    random = np.random.default_rng(0)
    samples = random.normal(size=(300, 3)) + random.integers(0, 4, size=(300, 1))
    options = {"tol": 1e-5, "max_iter": 1000, "reg_covar": 1e-6, "random_state": 0}
    theirs = Estimator(components, **options).fit(samples)
    ours = GaussianMixture.fit(samples, components=components)
    for own, other in zip(
        (ours.weights, ours.means, ours.covariances),
        (theirs.weights_, theirs.means_, theirs.covariances_),
        strict=True,
    ):
        np.testing.assert_allclose(own, other, rtol=1e-6, atol=1e-9)
