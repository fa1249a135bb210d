"""The low rank solution against the dense one, and what is said when the rank is reached."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kmp import (
    KMP,
    GaussianKernel,
    Gaussians,
    PeriodicKernel,
    RankReached,
    VelocityKernel,
    ViaPointMissed,
    named_arrays,
)
from kmp.solution import mean_of

properties = settings(max_examples=10, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
kernel = GaussianKernel(0.5)
STD = 0.02


def tube(seed, count):
    """Hands that move along a path, with scatter, and a tool that goes with them."""
    random = np.random.default_rng(seed)
    t = random.uniform(size=count)
    path = np.stack([0.4 * t, 0.2 * np.sin(5 * t), 0.1 * t, 0.3 * np.cos(3 * t), t**2, 0.1 - 0.1 * t], axis=1)
    inputs = path + 0.02 * random.normal(size=path.shape)
    tool = np.stack([np.sin(3 * t), 0.5 * np.cos(4 * t), t - t**2], axis=1) * 0.5
    root = STD * random.normal(size=(count, 3, 3))
    covariance = root @ root.swapaxes(1, 2) + 1e-5 * np.eye(3)
    return inputs, Gaussians(tool + 0.01 * random.normal(size=tool.shape), covariance)


def both(seed, count=300, **options):
    inputs, reference = tube(seed, count)
    options = {"kernel": kernel, "lambda_mean": 2.0, "prior_mean": [0.1, 0.2, 0.3]} | options
    return of_both(inputs, reference, **options)


def of_both(inputs, reference, **options):
    return [KMP.fit(inputs, reference, representation=r, **options) for r in ("dense", "low_rank")]


def points(seed, count, std=1e-4, spread=0.05):
    random = np.random.default_rng(seed)
    inputs = tube(seed + 1, count)[0] + spread * random.normal(size=(count, 6))
    mean = 0.2 * random.normal(size=(count, 3))
    return inputs, Gaussians.of(mean, deviation=std)


def agree(dense, low, queries, within=1e-6):
    np.testing.assert_allclose(low.mean(queries), dense.mean(queries), atol=within)
    np.testing.assert_allclose(low.mean(queries[:1]), dense.mean(queries[:1]), atol=within)
    a, b = dense.predict(queries), low.predict(queries)
    scale = np.abs(a.covariance).max()
    np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-5 * scale)
    np.testing.assert_allclose(low.predict(queries[:1]).covariance[0], b.covariance[0], atol=1e-9 * scale)
    assert np.array_equal(b.mean, low.mean(queries))
    one, v = queries[0], np.ones(queries.shape[1])
    np.testing.assert_allclose(low.jacobian(one), dense.jacobian(one), atol=100 * within)
    np.testing.assert_allclose(low.curvature(one, v), dense.curvature(one, v), atol=1e4 * within)


@properties
@given(seeds, st.sampled_from([None, 5.0]))
def test_within_the_data_it_is_the_dense_solution_to_a_micrometre(seed, lambda_covariance):
    dense, low = both(seed, lambda_covariance=lambda_covariance)
    assert (dense.representation, low.representation) == ("dense", "low_rank")
    assert len(low.inner.solution.centres) < 300
    agree(dense, low, np.concatenate([dense.inputs[:20], tube(seed + 7, 20)[0]]))


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # some are near each other
@properties
@given(seeds, st.sampled_from([0.0, 0.2]), st.sampled_from([0.0, 0.05, 1.0]), st.sampled_from([None, 5.0]))
def test_adapted_it_is_the_dense_solution_adapted(seed, tolerance, spread, lambda_covariance):
    dense, low = both(seed, lambda_covariance=lambda_covariance)
    inputs, desired = points(seed, 3, std=1e-3, spread=spread)
    dense, low = (one.adapt(inputs, desired, tolerance=tolerance) for one in (dense, low))
    assert np.array_equal(dense.inputs, low.inputs)
    assert np.array_equal(dense.reference.mean, low.reference.mean)
    agree(dense, low, np.concatenate([dense.inputs[:20], inputs]), within=5e-6)


@pytest.mark.parametrize("spread", [0.0, 0.05, 2.0])
def test_via_points_are_met_in_the_data_and_far_from_it(spread):
    low = both(0)[1]
    inputs, desired = points(1, 1, std=1e-5, spread=spread)
    np.testing.assert_allclose(low.adapt(inputs, desired, tolerance=0.1).mean(inputs), desired.mean, atol=1e-5)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # the demonstrations scatter
def test_so_many_changes_that_all_points_go_are_solved_anew():
    dense, low = both(0, count=60)
    inputs, desired = dense.inputs + 0.001, Gaussians(dense.reference.mean + 0.1, dense.reference.covariance)
    dense, low = (one.adapt(inputs, desired, tolerance=0.5) for one in (dense, low))
    assert len(low.inner.changes.replaced) > 50
    agree(dense, low, dense.inputs[:10], within=1e-5)


@pytest.mark.parametrize("variance", [1e-12, 1e-16, 1e-19])
@pytest.mark.parametrize("representation", ["dense", "low_rank", "auto"])
def test_a_covariance_that_rounding_would_hide_is_refused(variance, representation):
    inputs, reference = tube(0, 600)
    options = {"kernel": kernel, "representation": representation}
    hidden = Gaussians(reference.mean, np.tile(variance * np.eye(3), (600, 1, 1)))
    with pytest.raises(ValueError, match=r"lost in rounding: .* 1e-11 needed|not positive definite to working"):
        KMP.fit(inputs, hidden, lambda_mean=1.0, **options)
    if representation == "low_rank":
        with pytest.raises(ValueError, match=r"at point 0 would be lost .* a lambda_mean of at least"):
            KMP.fit(inputs, hidden, lambda_mean=1.0, lambda_covariance=1e9, **options)
    one, point = KMP.fit(inputs, reference, lambda_mean=1.0, **options), hidden[:1]
    with pytest.raises(ValueError, match=r"at point 600 would be lost in rounding: .* a lambda_\w+ of at least"):
        one.adapt(inputs[:1] + 0.1, point, tolerance=0.0)
    with pytest.raises(ValueError, match=r"at point 599 would be lost in rounding"):
        one.adapt(inputs[:1], point, tolerance=0.001)
    with pytest.raises(ValueError, match=r"at point 600 would be lost in rounding"):
        KMP.fit(inputs, reference, lambda_mean=1e6, lambda_covariance=1.0, **options).adapt(
            inputs[:1] + 0.1, point, tolerance=0.0
        )


def test_a_tolerance_below_rounding_is_served_as_well_as_rounding_allows():
    inputs, reference = tube(0, 200)
    dense, low = of_both(inputs, reference, kernel=kernel, lambda_mean=2.0, rank_tolerance=1e-18)
    agree(dense, low, inputs[:20])


def test_more_via_points_than_points():
    dense, low = both(0, count=4)
    inputs, desired = points(1, 40, std=0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ViaPointMissed)
        dense, low = (one.adapt(inputs, desired, tolerance=0.0) for one in (dense, low))
    agree(dense, low, inputs[:10], within=1e-5)


def test_what_is_too_much_to_keep_is_made_again_and_gives_the_same(monkeypatch):
    before = both(0)[1].adapt(*points(0, 3), tolerance=0.3)
    monkeypatch.setattr("kmp.low_rank.solution.KEPT", 0)
    monkeypatch.setattr("kmp.low_rank.features.KEPT", 0)
    monkeypatch.setattr("kmp.problem.database.DISTANCES", 1)
    after = both(0)[1].adapt(*points(0, 3), tolerance=0.3)
    assert np.array_equal(before.inner.changes.replaced, after.inner.changes.replaced)
    assert np.array_equal(before.weights, after.weights)


def test_one_point_alone():
    one = KMP.fit([[1.0]], Gaussians([[2.0]], [[[0.5]]]), kernel=kernel, lambda_mean=1, representation="low_rank")
    np.testing.assert_allclose(one.mean([[1.0]]), 2 / 1.5)
    np.testing.assert_allclose(one.predict([[1.0]]).covariance, [[[1 - 1 / 1.5]]])


def correlated(seed, count, outputs, spread):
    """A path over time with its rates, and correlations: deviations of 10 mm to 10 mm / spread."""
    random, t = np.random.default_rng(seed), np.linspace(0, 2, count)[:, None]
    half = np.arange(2, 2 + outputs // 2)
    mean = np.hstack([np.sin(half * t), half * np.cos(half * t)])
    turn = np.linalg.qr(random.normal(size=(count, outputs, outputs)))[0]
    covariance = (turn * np.geomspace(1e-4, 1e-4 / spread**2, outputs)) @ turn.swapaxes(1, 2)
    return t, Gaussians(mean, (covariance + covariance.swapaxes(1, 2)) / 2)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # some are surer than the data is smooth
@pytest.mark.parametrize("one", [GaussianKernel(8.0), PeriodicKernel(2.0, 3.0), VelocityKernel(8.0)], ids=repr)
@pytest.mark.parametrize("outputs", [2, 4, 6])
@pytest.mark.parametrize("spread", [1.0, 30.0, 300.0])
def test_correlations_of_any_outputs_count_with_any_kernel(one, outputs, spread):
    t, reference = correlated(outputs, 150, outputs, spread)
    dense, low = of_both(t, reference, kernel=one, lambda_mean=10.0)
    backward = Gaussians(reference.mean[::-1], reference.covariance[::-1])
    again, _ = of_both(t[::-1], backward, kernel=one, lambda_mean=10.0)
    via = t[50:51] + 0.004, Gaussians(reference.mean[50:51] + 0.01, reference.covariance[70:71])
    for a, b, c in ((dense, low, again), (each.adapt(*via, tolerance=0.02) for each in (dense, low, again))):
        error = np.linalg.norm(b.mean(t) - a.mean(t), axis=1).max()
        # The same points in another order differ by what rounding does to the dense solution.
        rounding = np.linalg.norm(c.mean(t) - a.mean(t), axis=1).max()
        assert error < max(1e-5, 2.0 * rounding)
        assert error <= b.error_bound_at_points
        scale = np.abs(a.predict(t).covariance).max()
        np.testing.assert_allclose(b.predict(t).covariance, a.predict(t).covariance, atol=0.02 * scale)


def test_the_rank_suffices_for_rates_too_also_where_points_are_far_apart():
    for count in (12, 150):
        t, reference = correlated(0, count, 4, 1.0)
        for one in (VelocityKernel(8.0), VelocityKernel(200.0)):
            dense, low = of_both(t, reference, kernel=one, lambda_mean=10.0)
            residual = low.inner.solution.features.residual(low.inner.solution.database.functionals)
            assert residual.max(axis=0) == pytest.approx(0, abs=4e-12)
            np.testing.assert_allclose(low.mean(t), dense.mean(t), atol=1e-8)


def test_the_error_bound_tells_of_equations_that_are_not_solved():
    low = both(0)[1].inner.solution
    wrong = replace(low, w=low.w * (1 + 1e-3))
    error = np.linalg.norm(mean_of(wrong, low.functionals) - mean_of(low, low.functionals), axis=1).max()
    assert error > 1e-4
    right, bounds = low.error_bounds, wrong.error_bounds
    assert right.at_points < 1e-5 < error < bounds.at_points + right.at_points
    assert error < bounds.anywhere + right.anywhere


def test_large_problems_choose_the_low_rank_and_small_ones_the_dense_solution():
    small, large, wide = tube(0, 500), tube(0, 501), GaussianKernel(0.1)
    assert KMP.fit(*small, kernel=wide, lambda_mean=2).representation == "dense"
    assert KMP.fit(*large, kernel=wide, lambda_mean=2).representation == "low_rank"
    assert KMP.fit(*large, kernel=GaussianKernel(500.0), lambda_mean=2).representation == "dense"


@pytest.mark.parametrize("one", [GaussianKernel(8.0), PeriodicKernel(8.0, 2.0), VelocityKernel(8.0)], ids=repr)
def test_over_time_the_rank_decides_and_not_the_number_of_points_alone(one):
    t, reference = correlated(0, 240, 4, 3.0)
    found = KMP.fit(t, reference, kernel=one, lambda_mean=10.0)
    dense = KMP.fit(t, reference, kernel=one, lambda_mean=10.0, representation="dense")
    assert found.representation == "low_rank"
    assert len(found.weights) < 40
    np.testing.assert_allclose(found.mean(t), dense.mean(t), atol=1e-9)
    short = replace(one, ell=4000.0)
    assert KMP.fit(t, reference, kernel=short, lambda_mean=10.0).representation == "dense"
    assert KMP.fit(t[:50], reference[:50], kernel=one, lambda_mean=10.0).representation == "dense"


def test_what_the_low_rank_would_lose_in_rounding_is_solved_densely():
    t, reference = correlated(0, 240, 4, 3.0)
    exact = Gaussians(reference.mean, 1e-13 * reference.covariance)
    options = {"kernel": GaussianKernel(4000.0), "lambda_mean": 10.0, "lambda_covariance": 1e9}
    assert KMP.fit(t, exact, **options).representation == "dense"
    with pytest.raises(ValueError, match="a lambda_mean of at least"):
        KMP.fit(t, exact, representation="low_rank", **options)


@pytest.mark.parametrize("rank", [10, 20, 40])
def test_a_rank_that_is_reached_is_said_and_the_error_is_within_the_bound_that_is_said(rank):
    inputs, reference = tube(0, 300)
    dense = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2, representation="dense")
    says = rf"rank: {rank} features leave up to .* 4e-12 is required: .* Raise the rank"
    with pytest.warns(RankReached, match=says) as said:
        low = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2, representation="low_rank", rank=rank)
    error = np.abs(low.mean(inputs) - dense.mean(inputs)).max()
    assert 1e-6 < error < low.error_bound_at_points
    assert f"{low.error_bound_at_points:.2g} [unit" in str(said[0].message)
    assert said[0].filename == __file__


@properties
@given(seeds, st.sampled_from([1e-6, 1e-9, 1e-12]), st.booleans())
def test_the_error_bound_holds(seed, left, adapted):
    dense, low = both(seed, rank_tolerance=left)
    if adapted:
        inputs, desired = points(seed, 1)
        dense, low = (one.adapt(inputs, desired, tolerance=0.02) for one in (dense, low))
    data = dense.inputs[:300]
    assert np.linalg.norm(low.mean(data) - dense.mean(data), axis=1).max() <= low.error_bound_at_points
    elsewhere = np.concatenate([dense.inputs, 0.5 * np.random.default_rng(seed).normal(size=(500, 6))])
    assert np.linalg.norm(low.mean(elsewhere) - dense.mean(elsewhere), axis=1).max() <= low.error_bound
    assert dense.error_bound == dense.error_bound_at_points == 0


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # the rate wanted is another than the neighbours'
@pytest.mark.parametrize("ell", [2.0, 8.0, 200.0])
@pytest.mark.parametrize("count", [12, 60])
@pytest.mark.parametrize("rank", [14, 400])
def test_derivatives_of_values_and_rates_are_features_too(count, ell, rank):
    t = np.linspace(0, 2, count)[:, None]
    along = np.where(np.arange(count) % 3 == 0, 1.0, 0.0)[:, None]  # of value and rate: rate and acceleration
    values = np.hstack([np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)])
    mean = np.where(along > 0, values[:, 1:], values[:, :2])
    reference = Gaussians(mean, np.tile(np.diag([1e-4, 1e-2]), (count, 1, 1)))
    options = {"kernel": VelocityKernel(ell), "lambda_mean": 0.1, "directions": along}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", RankReached)
        dense, low = of_both(t, reference, rank=rank, **options)
    queries = np.linspace(-1, 3, 301)[:, None]
    error = np.abs(low.mean(queries) - dense.mean(queries)).max()
    assert error <= low.error_bound
    assert error < 1e-4 or said, (error, said)
    if rank == 400:
        np.testing.assert_allclose(low.mean(t), dense.mean(t), atol=1e-9)
        again = named_arrays.from_arrays(named_arrays.to_arrays(low))
        assert np.array_equal(again.mean(queries), low.mean(queries))
        via = [[0.77]], Gaussians.of([[2.0, 0.0]], deviation=0.03)
        a, b = (one.adapt(*via, tolerance=0.0, directions=[[1.0]]) for one in (dense, low))
        np.testing.assert_allclose(b.mean(t), a.mean(t), atol=1e-5)


def test_as_many_via_points_with_rates_as_features_are_solved_anew():
    t = np.linspace(0, 2, 8)[:, None]
    mean = np.hstack([np.sin(3 * t), 3 * np.cos(3 * t)])
    reference = Gaussians.of(mean, deviation=0.03)
    dense, low = of_both(t, reference, kernel=VelocityKernel(200.0), lambda_mean=0.1)
    s = np.linspace(0.05, 1.95, 240)[:, None]
    wish = Gaussians.of(np.hstack([np.sin(3 * s), 3 * np.cos(3 * s)]), deviation=0.03)
    dense, low = (one.adapt(s, wish, tolerance=0.0) for one in (dense, low))
    np.testing.assert_allclose(low.mean(s), dense.mean(s), atol=1e-6)
