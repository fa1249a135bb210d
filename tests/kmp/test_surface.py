"""Features that users of other libraries expect: points by deviation, defaults, files, several
goals.
"""

import re
import subprocess
import sys

import numpy as np
import pytest

import kmp
from kmp import KMP, GaussianKernel, Gaussians, LinearConstraints, VelocityKernel
from support.paths import LIBRARY

# some via-points have neighbours of other deviations
pytestmark = pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")

T = np.linspace(0, 2, 80)[:, None]
VALUES = np.hstack([np.sin(3 * T), np.cos(2 * T)])
RATES = np.hstack([3 * np.cos(3 * T), -2 * np.sin(2 * T)])


def fitted(representation="dense", **options):
    options = {"kernel": GaussianKernel(8.0), "lambda_mean": 0.1} | options
    return KMP.fit(
        T, Gaussians.of(VALUES, deviation=0.05), representation=representation, **options
    )


def with_rates(**options):
    normals = Gaussians.of(np.hstack([VALUES, RATES]), deviation=[0.05, 0.05, 0.5, 0.5])
    return KMP.fit(T, normals, kernel=VelocityKernel(8.0), lambda_mean=0.1, **options)


def test_normals_of_means_and_deviations():
    for deviation in (0.1, [0.1, 0.1], np.full((80, 2), 0.1)):
        normals = Gaussians.of(VALUES, deviation=deviation)
        assert np.array_equal(normals.mean, VALUES)
        np.testing.assert_allclose(normals.covariance, np.tile(0.01 * np.eye(2), (80, 1, 1)))
    normal = Gaussians.of([1.0, 2.0], deviation=[0.1, 0.2])
    assert (len(normal), normal.outputs) == (1, 2)
    np.testing.assert_allclose(normal.covariance, [np.diag([0.01, 0.04])])
    assert not normal.exact.any()
    mixed = Gaussians.of(VALUES, deviation=[0.0, 0.1])
    assert mixed.exact[5].tolist() == [True, False]
    rebuilt = Gaussians(mixed.mean, mixed.covariance)
    assert np.array_equal(rebuilt.exact, mixed.exact)
    with pytest.raises(ValueError, match="not positive definite"):
        Gaussians([[0.0, 0.0]], [[[1.0, 1e-3], [1e-3, 1e-200]]])


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("lambdas", [(0.1, None), (10.0, 0.01), (0.01, 100.0)])
def test_zero_deviation_is_met(representation, lambdas):
    skill = fitted(representation, lambda_mean=lambdas[0], lambda_covariance=lambdas[1])
    place = skill.mean([[1.0]]) + 0.1
    through = skill.adapt([[1.0]], Gaussians.of(place, deviation=0))
    np.testing.assert_allclose(through.mean([[1.0]]), place, atol=1e-3)
    assert (np.linalg.eigvalsh(through.predict([[1.0]]).covariance) > 0).all()


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("lambda_covariance", [None, 1e-4])
def test_named_least_variance_is_accepted(representation, rates, lambda_covariance):
    """The least variance that a refusal names is accepted."""
    skill = (with_rates if rates else fitted)(
        representation=representation, lambda_covariance=lambda_covariance
    )
    place = skill.mean([[1.0]])
    with pytest.raises(ValueError, match="variance of at least") as refused:
        skill.adapt([[1.0]], Gaussians.of(place, deviation=1e-9))
    named = [
        float(number)
        for number in re.findall(
            r"at least (\S+?)(?: of the values)?(?: and (\S+) of their rates)? \(",
            str(refused.value),
        )[0]
        if number
    ]
    assert len(named) == 1 + rates
    deviation = np.repeat(np.sqrt(named), 2)
    np.testing.assert_allclose(
        skill.adapt([[1.0]], Gaussians.of(place, deviation=deviation)).mean([[1.0]]),
        place,
        atol=1e-3,
    )
    with pytest.raises(ValueError, match="lost in rounding"):
        skill.adapt([[1.0]], Gaussians.of(place, deviation=deviation / 1.2))


def test_default_tolerance_replaces_nearest():
    """The reference is evenly spaced."""
    skill = fitted()
    assert skill.spacing == pytest.approx(2 / 79)
    for t in (0.0, 0.5003, 1.01, 2.0):
        through = skill.adapt([[t]], Gaussians.of([0.0, 0.0], deviation=0.3))
        [index] = through.inner.changes.replaced
        assert abs(T[index, 0] - t) <= skill.spacing / 2
    assert (
        len(skill.adapt([[2.1]], Gaussians.of([0.0, 0.0], deviation=0.3)).inner.changes.replaced)
        == 0
    )


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("changed", ["as fitted", "adapted", "constrained"])
def test_other_lambda_keeps_the_mean(representation, changed):
    """Changing lambda_covariance equals fitting with it, and keeps the mean."""

    def made(**options):
        skill = fitted(representation, **options)
        if changed != "as fitted":
            skill = skill.adapt([[1.0]], Gaussians.of([0.3, 0.3], deviation=0.03))
        above = LinearConstraints(T, np.tile([0.0, 1.0], (80, 1)), np.full(80, -0.5))
        return skill.constrained(above) if changed == "constrained" else skill

    updated = made().with_lambda_covariance(7.0)
    expected = made(lambda_covariance=7.0)
    assert updated.lambda_covariance == 7.0
    assert np.array_equal(updated.mean(T), made().mean(T))
    np.testing.assert_allclose(
        updated.predict(T).covariance, expected.predict(T).covariance, rtol=1e-6, atol=1e-9
    )
    place = [[0.5]], Gaussians.of([0.2, 0.2], deviation=0.03)
    np.testing.assert_allclose(
        updated.adapt(*place).mean(T), expected.adapt(*place).mean(T), atol=1e-7
    )
    assert updated.base.lambda_covariance == 7.0


def test_names_and_modules_are_loaded_when_needed():
    """Neither the primitive nor scikit-learn is imported before, and both modules have one name."""
    code = (
        "import sys, kmp; assert not {'scipy', 'sklearn'} & sys.modules.keys(); "
        "kmp.sklearn.KMPRegressor(); assert sys.modules['sklearn'] is not kmp.sklearn; "
        "assert 'KMP' in dir(kmp)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, check=True)
    with pytest.raises(AttributeError, match="no attribute 'Unknown'"):
        _ = kmp.Unknown


def test_blocks_of_queries_have_same_means():
    """Many queries are computed in blocks."""
    skill = with_rates()
    queries = np.linspace(-1, 3, 1001)[:, None]
    whole = skill.mean(queries)
    parts = np.concatenate([skill.mean(queries[a : a + 7]) for a in range(0, 1001, 7)])
    weights = skill.inner.solution.weights
    np.testing.assert_allclose(whole, parts, atol=1e-12 * np.abs(weights).max())
    assert skill.mean(queries[:0]).shape == (0, 4)
    assert skill.jacobians(queries[:0]).shape == (0, 4, 1)
