"""Points by deviation, defaults, files, several goals: what users of other libraries expect."""

import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

import kmp
from kmp import KMP, GaussianKernel, Gaussians, LinearConstraints, OrientationKMP, PeriodicKernel, VelocityKernel
from kmp.orientation import continuous, log
from support.paths import ROOT

pytestmark = pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # points of other deviations are near

T = np.linspace(0, 2, 80)[:, None]
VALUES = np.hstack([np.sin(3 * T), np.cos(2 * T)])
RATES = np.hstack([3 * np.cos(3 * T), -2 * np.sin(2 * T)])


def fitted(representation="dense", **options):
    options = {"kernel": GaussianKernel(8.0), "lambda_mean": 0.1} | options
    return KMP.fit(T, Gaussians.of(VALUES, deviation=0.05), representation=representation, **options)


def with_rates(**options):
    normals = Gaussians.of(np.hstack([VALUES, RATES]), deviation=[0.05, 0.05, 0.5, 0.5])
    return KMP.fit(T, normals, kernel=VelocityKernel(8.0), lambda_mean=0.1, **options)


def turning(velocity):
    """A learned orientation, whose lambdas are chosen: over time, with its rate or without."""
    takes = []
    for n in range(3):
        half = (0.4 + 0.02 * n) * np.sin(T[:, 0])
        shown = continuous(
            np.stack([0 * half, 0.1 * half, np.sin(half), np.cos(half)], axis=1)
            / np.sqrt(1 + 0.01 * half[:, None] ** 2)
        )
        zeta = log(shown, [0.0, 0.0, 0.0, 1.0])
        rates = np.gradient(zeta, T[:, 0], axis=0)
        takes.append((T, np.hstack([zeta, rates]) if velocity else zeta))
    return OrientationKMP(kmp.learn(takes, components=5, seed=0, velocity=velocity).primitive, [0.0, 0.0, 0.0, 1.0])


def test_normals_of_means_and_deviations():
    for deviation in (0.1, [0.1, 0.1], np.full((80, 2), 0.1)):
        found = Gaussians.of(VALUES, deviation=deviation)
        assert np.array_equal(found.mean, VALUES)
        np.testing.assert_allclose(found.covariance, np.tile(0.01 * np.eye(2), (80, 1, 1)))
    one = Gaussians.of([1.0, 2.0], deviation=[0.1, 0.2])
    assert (len(one), one.outputs) == (1, 2)
    np.testing.assert_allclose(one.covariance, [np.diag([0.01, 0.04])])
    assert not one.exact.any()
    mixed = Gaussians.of(VALUES, deviation=[0.0, 0.1])
    assert mixed.exact[5].tolist() == [True, False]
    again = Gaussians(mixed.mean, mixed.covariance)
    assert np.array_equal(again.exact, mixed.exact)
    with pytest.raises(ValueError, match="not positive definite"):
        Gaussians([[0.0, 0.0]], [[[1.0, 1e-3], [1e-3, 1e-200]]])


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("lambdas", [(0.1, None), (10.0, 0.01), (0.01, 100.0)])
def test_a_deviation_of_0_is_met_as_exactly_as_rounding_allows(representation, lambdas):
    skill = fitted(representation, lambda_mean=lambdas[0], lambda_covariance=lambdas[1])
    place = skill.mean([[1.0]]) + 0.1
    through = skill.adapt([[1.0]], Gaussians.of(place, deviation=0))
    np.testing.assert_allclose(through.mean([[1.0]]), place, atol=1e-3)
    assert (np.linalg.eigvalsh(through.predict([[1.0]]).covariance) > 0).all()
    assert (through.via_points.covariance[0].diagonal() >= skill.least_variance / 1.02).all()


def test_of_an_exact_value_the_rate_may_be_free_and_the_other_way_round():
    skill = with_rates()
    for deviation in ([0, 0, 10, 10], [10, 10, 0, 0]):
        wanted = np.array([[0.5, -0.5, 1.0, 1.0]])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", kmp.ViaPointMissed)  # to a tenth of a millimetre
            through = skill.adapt([[1.0]], Gaussians.of(wanted, deviation=deviation))
        exact = np.array(deviation) == 0
        np.testing.assert_allclose(through.mean([[1.0]])[0, exact], wanted[0, exact], atol=1e-2)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("lambda_covariance", [None, 1e-4])
def test_the_least_variance_that_a_refusal_names_is_accepted(representation, rates, lambda_covariance):
    skill = (with_rates if rates else fitted)(representation=representation, lambda_covariance=lambda_covariance)
    place = skill.mean([[1.0]])
    with pytest.raises(ValueError, match="variance of at least") as refused:
        skill.adapt([[1.0]], Gaussians.of(place, deviation=1e-9))
    named = [
        float(one)
        for one in re.findall(
            r"at least (\S+?)(?: of the values)?(?: and (\S+) of their rates)? \(", str(refused.value)
        )[0]
        if one
    ]
    assert len(named) == 1 + rates
    deviation = np.repeat(np.sqrt(named), 2)
    np.testing.assert_allclose(
        skill.adapt([[1.0]], Gaussians.of(place, deviation=deviation)).mean([[1.0]]), place, atol=1e-3
    )
    with pytest.raises(ValueError, match="lost in rounding"):
        skill.adapt([[1.0]], Gaussians.of(place, deviation=deviation / 1.2))
    np.testing.assert_allclose(skill.least_variance, named[0], rtol=0.05)


@pytest.mark.parametrize("velocity", [False, True])
def test_a_learned_orientation_names_the_least_variance_of_a_rotation_or_takes_0(velocity):
    skill, upright = turning(velocity), [[0.0, 0.0, 0.0, 1.0]]
    with pytest.raises(ValueError, match=r"covariance\[0\] would be lost .* is enough") as refused:
        skill.adapt([[1.0]], upright, 1e-16 * np.eye(3))
    enough = float(re.search(r"and (\S+) is enough", str(refused.value))[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kmp.ViaPointMissed)  # by a tenth of a degree
        for covariance in (enough * np.eye(3), np.zeros((3, 3))):
            found = skill.adapt([[1.0]], upright, covariance).mean([[1.0]])
            assert abs(found[0, 3]) > 1 - 1e-5


def test_in_frames_too_a_place_is_exact():
    takes = [(T, VALUES + 0.1 * n) for n in range(3)]
    frames = [(kmp.CoordinateFrame.at(one[0]), kmp.CoordinateFrame.at(one[-1])) for _, one in takes]
    options = {"kernel": GaussianKernel(8.0), "lambda_mean": 0.1, "components": 5, "seed": 0}
    skill = kmp.LocalKMP.learn(takes, frames, T, **options)
    through = skill.adapt([[1.0]], Gaussians.of([0.5, 0.5], deviation=0))
    np.testing.assert_allclose(through.mean([[1.0]]), [[0.5, 0.5]], atol=1e-3)


def test_the_default_tolerance_replaces_the_nearest_point_of_an_even_reference():
    skill = fitted()
    assert skill.spacing == pytest.approx(2 / 79)
    for t in (0.0, 0.5003, 1.01, 2.0):
        through = skill.adapt([[t]], Gaussians.of([0.0, 0.0], deviation=0.3))
        [gone] = through.inner.changes.replaced
        assert abs(T[gone, 0] - t) <= skill.spacing / 2
    assert len(skill.adapt([[2.1]], Gaussians.of([0.0, 0.0], deviation=0.3)).inner.changes.replaced) == 0


def test_the_spacing_of_repeated_periodic_and_single_points():
    phase = np.linspace(0, 1, 10, endpoint=False)[:, None]
    normals = Gaussians.of(np.sin(2 * np.pi * phase), deviation=0.1)
    round_once = KMP.fit(phase + 3, normals, kernel=PeriodicKernel(8.0, 1.0), lambda_mean=0.1)
    assert round_once.spacing == pytest.approx(0.1)
    twice = KMP.fit(
        np.tile(phase, (2, 1)), normals[[*range(10), *range(10)]], kernel=GaussianKernel(8.0), lambda_mean=0.1
    )
    assert twice.spacing == pytest.approx(0.1)
    alone = KMP.fit([[1.0]], Gaussians.of([1.0], deviation=0.1), kernel=GaussianKernel(8.0), lambda_mean=0.1)
    assert alone.spacing == 0
    assert len(alone.adapt([[1.0]], Gaussians.of([2.0], deviation=0.1)).inputs) == 2


def test_each_of_several_goals_has_a_primitive_of_its_own():
    skill = fitted()
    goals = [([[2.0]], Gaussians.of([x, 0.5], deviation=1e-3)) for x in (0.0, 0.5)]
    for (at, desired), one in zip(goals, skill.adapt_many(goals, tolerance=0.01), strict=True):
        assert np.array_equal(one.mean(T), skill.adapt(at, desired, tolerance=0.01).mean(T))
    with pytest.raises(ValueError, match=r"points\[0\]: .* a pair of inputs"):
        skill.adapt_many([[2.0]])


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("changed", ["as fitted", "adapted", "constrained"])
def test_another_lambda_of_the_covariance_is_as_fitted_with_it_and_keeps_the_mean(representation, changed):
    def made(**options):
        one = fitted(representation, **options)
        if changed != "as fitted":
            one = one.adapt([[1.0]], Gaussians.of([0.3, 0.3], deviation=0.03))
        above = LinearConstraints(T, np.tile([0.0, 1.0], (80, 1)), np.full(80, -0.5))
        return one.constrained(above) if changed == "constrained" else one

    one, wanted = made().with_lambda_covariance(7.0), made(lambda_covariance=7.0)
    assert one.lambda_covariance == 7.0
    assert np.array_equal(one.mean(T), made().mean(T))
    np.testing.assert_allclose(one.predict(T).covariance, wanted.predict(T).covariance, rtol=1e-6, atol=1e-9)
    place = [[0.5]], Gaussians.of([0.2, 0.2], deviation=0.03)
    np.testing.assert_allclose(one.adapt(*place).mean(T), wanted.adapt(*place).mean(T), atol=1e-7)
    assert one.base.lambda_covariance == 7.0


def test_a_primitive_saves_and_loads_itself(tmp_path):
    skill = fitted().adapt([[1.0]], Gaussians.of([0.3, 0.3], deviation=0.01))
    skill.save(tmp_path / "skill.npz", input_unit="s", output_unit="m")
    assert np.array_equal(KMP.load(tmp_path / "skill.npz").mean(T), skill.mean(T))
    assert kmp.load(tmp_path / "skill.npz")[1:] == ("s", "m")
    kmp.save(tmp_path / "kernel.npz", skill.kernel)
    with pytest.raises(ValueError, match="KMP needed"):
        KMP.load(tmp_path / "kernel.npz")


def test_the_estimator_is_found_when_it_is_needed_and_not_before():
    code = "import sys, kmp; assert 'sklearn' not in sys.modules; kmp.KMPRegressor(); assert 'sklearn' in sys.modules"
    subprocess.run([sys.executable, "-c", code + "; assert 'KMPRegressor' in dir(kmp)"], cwd=ROOT, check=True)
    with pytest.raises(AttributeError, match="no attribute 'Unknown'"):
        _ = kmp.Unknown


@pytest.mark.parametrize("one", [GaussianKernel(8.0), GaussianKernel([2.0, 30.0, 5.0]), VelocityKernel(8.0)], ids=repr)
@pytest.mark.parametrize("affine", [False, True])
def test_jacobians_are_those_of_each_query(one, affine):
    random = np.random.default_rng(0)
    s = random.uniform(-1, 1, (60, 1 if one.channels == 2 or np.ndim(one.ell) == 0 else 3))
    values = np.hstack([np.sin(s.sum(axis=1, keepdims=True)), np.cos(s[:, :1])])
    prior = kmp.AffineMean(0.1 * np.ones((2, s.shape[1])), [0.0, 0.1]) if affine else None
    if affine and one.channels == 2:
        prior = kmp.AffineMean([[0.1], [0.0]], [0.0, 0.1])
    skill = KMP.fit(s, Gaussians.of(values, deviation=0.1), kernel=one, lambda_mean=0.1, prior_mean=prior)
    queries = random.uniform(-3, 3, (700, s.shape[1])) + 0.1
    each = np.array([skill.jacobian(query) for query in queries])
    np.testing.assert_allclose(skill.jacobians(queries), each, atol=1e-10 * np.abs(skill.weights).max())
    known = skill.adapt(s[:1], Gaussians.of([0.3, 0.3], deviation=0.1), directions=np.ones_like(s[:1]))
    each = np.array([known.jacobian(query) for query in queries[:20]])
    np.testing.assert_allclose(known.jacobians(queries[:20]), each, atol=1e-10 * np.abs(known.weights).max())


def test_means_of_many_queries_are_the_same_in_blocks():
    skill, queries = with_rates(), np.linspace(-1, 3, 1001)[:, None]
    whole = skill.mean(queries)
    parts = np.concatenate([skill.mean(queries[a : a + 7]) for a in range(0, 1001, 7)])
    np.testing.assert_allclose(whole, parts, atol=1e-12 * np.abs(skill.weights).max())
    assert skill.mean(queries[:0]).shape == (0, 4)
    assert skill.jacobians(queries[:0]).shape == (0, 4, 1)
