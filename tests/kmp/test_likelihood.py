"""Hyper-parameters by the marginal likelihood of the reference."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import kmp
from kmp import GaussianKernel, Gaussians, VelocityKernel
from kmp.criteria.likelihood import negative_log_likelihood, with_ell
from kmp.functionals import Functionals
from kmp.problem.database import Database
from support.shown_skills import driven_by_hands, over_time


def database(dimensions, outputs):
    random = np.random.default_rng(0)
    inputs = random.uniform(0, 2, (20, dimensions))
    roots = 0.1 * random.normal(size=(20, outputs, outputs)) + 0.2 * np.eye(outputs)
    mean = np.sin(inputs @ random.normal(size=(dimensions, outputs)))
    return Database(Functionals(inputs), Gaussians(mean, roots @ roots.transpose(0, 2, 1)))


CASES = [
    (database(3, 2), GaussianKernel([2.0, 0.3, 5.0])),
    (database(3, 2), GaussianKernel(2.0)),
    (database(1, 2), GaussianKernel(2.0)),
    (database(1, 4), VelocityKernel(2.0)),
]


@pytest.mark.parametrize(("points", "kernel"), CASES, ids=["ard", "one ell", "time", "velocity"])
def test_the_gradient_is_the_differences(points, kernel):
    prior, ell = np.zeros(points.reference.outputs), np.atleast_1d(kernel.ell)

    def value(logs):
        scaled = np.exp(logs[:-1]) if np.ndim(kernel.ell) else float(np.exp(logs[0]))
        of = GaussianKernel(scaled) if isinstance(kernel, GaussianKernel) else VelocityKernel(scaled)
        return negative_log_likelihood(points, prior, of, float(np.exp(logs[-1])))[0]

    at, step = np.log([*ell, 0.7]), 1e-5
    gradient = negative_log_likelihood(points, prior, kernel, 0.7)[1]
    differences = [(value(at + step * e) - value(at - step * e)) / (2 * step) for e in np.eye(len(at))]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6)


def test_it_is_the_density_of_the_normal_that_scipy_gives():
    points, kernel = CASES[0]
    value, _, signal = negative_log_likelihood(points, np.zeros(2), kernel, 0.7)
    total = np.kron(kernel(points.inputs, points.inputs), np.eye(2))
    for n, one in enumerate(points.reference.covariance):
        total[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] += 0.7 * one
    densities = [
        multivariate_normal(cov=s * total).logpdf(points.reference.mean.ravel()) for s in (signal, 0.9 * signal)
    ]
    assert value == pytest.approx(-densities[0], rel=1e-9)
    assert densities[1] < densities[0]


def left(learned):
    """The error (rms) at a demonstration that it was not shown."""
    s, xi = driven_by_hands(seed=9, count=1)[0]
    return np.sqrt(((learned.primitive.mean(s) - xi) ** 2).sum(axis=1).mean())


def test_an_input_that_says_nothing_is_found_and_the_prediction_better():
    options = {"components": 16, "seed": 0, "count": 80, "criterion": "likelihood"}
    each, one = (kmp.learn(driven_by_hands(), scales=scales, **options) for scales in ("each", "one"))
    variances = np.var(np.concatenate([s for s, _ in driven_by_hands()]), axis=0)
    relevance, alike = (np.asarray(learned.primitive.kernel.ell) * variances for learned in (each, one))
    assert relevance[1] < 0.1 * relevance[0]
    assert alike[1] == pytest.approx(alike[0], rel=0.3)
    assert left(each) < 0.9 * left(one)


@pytest.mark.parametrize("velocity", [False, True])
def test_one_demonstration_is_enough(velocity):
    shown, options = over_time(velocity), {"components": 8, "seed": 0, "count": 60, "velocity": velocity}
    learned = kmp.learn(shown[:1], criterion="likelihood", **options)
    assert isinstance(learned.primitive.kernel, VelocityKernel if velocity else GaussianKernel)
    miss = learned.primitive.mean(shown[0][0]) - shown[0][1]
    assert np.sqrt(np.mean(miss[:, :2] ** 2)) < 0.03
    assert learned.scores == ()
    assert np.isnan(learned.regression_rmse)


def test_what_is_given_is_kept():
    options = {"components": 6, "seed": 0, "count": 40, "criterion": "likelihood"}
    for kernel in (GaussianKernel(3.0), GaussianKernel([3.0, 2.0])):
        learned = kmp.learn(driven_by_hands(), kernel=kernel, **options)
        assert learned.primitive.kernel == kernel
    learned = kmp.learn(driven_by_hands(), lambda_mean=0.7, lambda_covariance=3.0, **options)
    assert (learned.primitive.lambda_mean, learned.primitive.lambda_covariance) == (0.7, 3.0)


def test_the_choice_follows_the_units():
    c, options = 100.0, {"components": 6, "seed": 0, "count": 40, "criterion": "likelihood"}
    one = kmp.learn(driven_by_hands(), **options).primitive
    scaled = [(c * s, c * xi) for s, xi in driven_by_hands()]
    other = kmp.learn(scaled, regularization=1e-6 * c**2, **options).primitive
    np.testing.assert_allclose(other.kernel.ell[0], one.kernel.ell[0] / c**2, rtol=1e-2)
    np.testing.assert_allclose(other.lambda_mean, one.lambda_mean / c**2, rtol=1e-2)


def test_other_ell_of_the_same_kind():
    assert with_ell(VelocityKernel(1.0), np.array([3.0])) == VelocityKernel(3.0)
    assert with_ell(GaussianKernel(1.0), np.array([3.0, 2.0])) == GaussianKernel([3.0, 2.0])
