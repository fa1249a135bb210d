"""The low rank solution against the dense one, and the warning when the rank is reached."""

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
    named_arrays,
)

properties = settings(max_examples=10, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
kernel = GaussianKernel(0.5)
STD = 0.02


def tube(seed, count):
    """Hands that move along a path with scatter, and a tool that follows them."""
    random = np.random.default_rng(seed)
    t = random.uniform(size=count)
    path = np.stack(
        [0.4 * t, 0.2 * np.sin(5 * t), 0.1 * t, 0.3 * np.cos(3 * t), t**2, 0.1 - 0.1 * t], axis=1
    )
    inputs = path + 0.02 * random.normal(size=path.shape)
    tool = np.stack([np.sin(3 * t), 0.5 * np.cos(4 * t), t - t**2], axis=1) * 0.5
    root = STD * random.normal(size=(count, 3, 3))
    covariance = root @ root.swapaxes(1, 2) + 1e-5 * np.eye(3)
    return inputs, Gaussians(tool + 0.01 * random.normal(size=tool.shape), covariance)


def both(seed, **options):
    inputs, reference = tube(seed, 300)
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
    a = dense.predict(queries)
    b = low.predict(queries)
    scale = np.abs(a.covariance).max()
    np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-5 * scale)
    np.testing.assert_allclose(
        low.predict(queries[:1]).covariance[0], b.covariance[0], atol=1e-9 * scale
    )
    assert np.array_equal(b.mean, low.mean(queries))
    query = queries[0]
    v = np.ones(queries.shape[1])
    np.testing.assert_allclose(low.jacobian(query), dense.jacobian(query), atol=100 * within)
    bends = [skill.predict_motion(query, v, v).curvature for skill in (low, dense)]
    np.testing.assert_allclose(*bends, atol=1e4 * within)


@properties
@given(seeds, st.sampled_from([None, 5.0]))
def test_equals_dense_within_data(seed, lambda_covariance):
    """The difference is a micrometre at most."""
    dense, low = both(seed, lambda_covariance=lambda_covariance)
    assert (dense.representation, low.representation) == ("dense", "low_rank")
    assert len(low.inner.solution.centres) < 300
    agree(dense, low, np.concatenate([dense.inputs[:20], tube(seed + 7, 20)[0]]))


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # some via-points are near each other
@properties
@given(
    seeds,
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 0.05, 1.0]),
    st.sampled_from([None, 5.0]),
)
def test_adapted_equals_dense_adapted(seed, tolerance, spread, lambda_covariance):
    """An adapted low-rank primitive equals the adapted dense one."""
    dense, low = both(seed, lambda_covariance=lambda_covariance)
    inputs, desired = points(seed, 3, std=1e-3, spread=spread)
    dense, low = (
        primitive.adapt(inputs, desired, tolerance=tolerance) for primitive in (dense, low)
    )
    assert np.array_equal(dense.inputs, low.inputs)
    assert np.array_equal(dense.reference.mean, low.reference.mean)
    agree(dense, low, np.concatenate([dense.inputs[:20], inputs]), within=5e-6)


@pytest.mark.parametrize("variance", [1e-12, 1e-16, 1e-19])
@pytest.mark.parametrize("representation", ["dense", "low_rank", "auto"])
def test_hidden_covariance_is_refused(variance, representation):
    """A covariance that rounding would hide is refused."""
    inputs, reference = tube(0, 600)
    options = {"kernel": kernel, "representation": representation}
    hidden = Gaussians(reference.mean, np.tile(variance * np.eye(3), (600, 1, 1)))
    with pytest.raises(
        ValueError, match=r"lost in rounding: .* 1e-11 needed|not positive definite to working"
    ):
        KMP.fit(inputs, hidden, lambda_mean=1.0, **options)
    if representation == "low_rank":
        with pytest.raises(
            ValueError, match=r"at point 0 would be lost .* a lambda_mean of at least"
        ):
            KMP.fit(inputs, hidden, lambda_mean=1.0, lambda_covariance=1e9, **options)
    primitive = KMP.fit(inputs, reference, lambda_mean=1.0, **options)
    point = hidden[:1]
    with pytest.raises(
        ValueError, match=r"at point 600 would be lost in rounding: .* a lambda_\w+ of at least"
    ):
        primitive.adapt(inputs[:1] + 0.1, point, tolerance=0.0)
    with pytest.raises(ValueError, match=r"at point 599 would be lost in rounding"):
        primitive.adapt(inputs[:1], point, tolerance=0.001)
    with pytest.raises(ValueError, match=r"at point 600 would be lost in rounding"):
        KMP.fit(inputs, reference, lambda_mean=1e6, lambda_covariance=1.0, **options).adapt(
            inputs[:1] + 0.1, point, tolerance=0.0
        )


def correlated(seed, count, outputs, spread):
    """A path over time with its rates and correlated outputs; deviations are 10 mm to 10 mm /
    spread.
    """
    random = np.random.default_rng(seed)
    t = np.linspace(0, 2, count)[:, None]
    half = np.arange(2, 2 + outputs // 2)
    mean = np.hstack([np.sin(half * t), half * np.cos(half * t)])
    turn = np.linalg.qr(random.normal(size=(count, outputs, outputs)))[0]
    covariance = (turn * np.geomspace(1e-4, 1e-4 / spread**2, outputs)) @ turn.swapaxes(1, 2)
    return t, Gaussians(mean, (covariance + covariance.swapaxes(1, 2)) / 2)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # some deviations are too small
@pytest.mark.parametrize(
    "one", [GaussianKernel(8.0), PeriodicKernel(2.0, 3.0), VelocityKernel(8.0)], ids=repr
)
@pytest.mark.parametrize("outputs", [2, 4, 6])
@pytest.mark.parametrize("spread", [1.0, 30.0, 300.0])
def test_correlated_outputs_with_any_kernel(one, outputs, spread):
    t, reference = correlated(outputs, 150, outputs, spread)
    dense, low = of_both(t, reference, kernel=one, lambda_mean=10.0)
    backward = Gaussians(reference.mean[::-1], reference.covariance[::-1])
    reordered, _ = of_both(t[::-1], backward, kernel=one, lambda_mean=10.0)
    via = t[50:51] + 0.004, Gaussians(reference.mean[50:51] + 0.01, reference.covariance[70:71])
    for a, b, c in (
        (dense, low, reordered),
        (primitive.adapt(*via, tolerance=0.02) for primitive in (dense, low, reordered)),
    ):
        error = np.linalg.norm(b.mean(t) - a.mean(t), axis=1).max()
        # The order of the points changes the dense solution by rounding only.
        rounding = np.linalg.norm(c.mean(t) - a.mean(t), axis=1).max()
        assert error < max(1e-5, 2.0 * rounding)
        scale = np.abs(a.predict(t).covariance).max()
        np.testing.assert_allclose(
            b.predict(t).covariance, a.predict(t).covariance, atol=0.02 * scale
        )


@pytest.mark.parametrize(
    "one", [GaussianKernel(8.0), PeriodicKernel(8.0, 2.0), VelocityKernel(8.0)], ids=repr
)
def test_rank_decides_over_time(one):
    """Over time, the rank decides on the representation, not only the number of points."""
    t, reference = correlated(0, 240, 4, 3.0)
    automatic = KMP.fit(t, reference, kernel=one, lambda_mean=10.0)
    dense = KMP.fit(t, reference, kernel=one, lambda_mean=10.0, representation="dense")
    assert automatic.representation == "low_rank"
    assert len(automatic.inner.solution.weights) < 40
    np.testing.assert_allclose(automatic.mean(t), dense.mean(t), atol=1e-9)
    short = replace(one, ell=4000.0)
    assert KMP.fit(t, reference, kernel=short, lambda_mean=10.0).representation == "dense"
    assert KMP.fit(t[:50], reference[:50], kernel=one, lambda_mean=10.0).representation == "dense"


def test_dense_where_rounding_would_hide():
    """A problem in which the low rank would lose digits is solved densely."""
    t, reference = correlated(0, 240, 4, 3.0)
    exact = Gaussians(reference.mean, 1e-13 * reference.covariance)
    options = {"kernel": GaussianKernel(4000.0), "lambda_mean": 10.0, "lambda_covariance": 1e9}
    assert KMP.fit(t, exact, **options).representation == "dense"
    with pytest.raises(ValueError, match="a lambda_mean of at least"):
        KMP.fit(t, exact, representation="low_rank", **options)


def test_few_points_are_solved_exactly():
    """Near to each other, each has a feature of its own."""
    times = np.array([[0.01], [0.08], [0.11]])
    reference = Gaussians.of(np.array([[1.4, 5.0], [-0.3, -3.0], [1.2, -9.0]]), deviation=0.2)
    dense, low = of_both(times, reference, kernel=VelocityKernel(2.6), lambda_mean=0.5)
    queries = np.linspace(-0.2, 1.2, 30)
    np.testing.assert_allclose(low.mean(queries), dense.mean(queries), atol=1e-6)


@pytest.mark.parametrize("rank", [10, 20, 40])
def test_reached_rank_is_reported(rank):
    """And the mean differs from the dense one."""
    inputs, reference = tube(0, 300)
    dense = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2, representation="dense")
    says = rf"rank: {rank} features leave up to .* 4e-12 is required: .* Raise the rank"
    with pytest.warns(RankReached, match=says) as caught:
        low = KMP.fit(
            inputs, reference, kernel=kernel, lambda_mean=2, representation="low_rank", rank=rank
        )
    error = np.abs(low.mean(inputs) - dense.mean(inputs)).max()
    assert error > 1e-6
    assert caught[0].filename == __file__


# the taught rate differs from the neighbours'
@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("ell", [2.0, 8.0, 200.0])
@pytest.mark.parametrize("count", [12, 60])
def test_derivatives_are_features_too(count, ell):
    """Derivatives of values and rates are features too."""
    t = np.linspace(0, 2, count)[:, None]
    # derivatives of value and rate are rate and acceleration
    along = np.where(np.arange(count) % 3 == 0, 1.0, 0.0)[:, None]
    values = np.hstack([np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)])
    mean = np.where(along > 0, values[:, 1:], values[:, :2])
    reference = Gaussians(mean, np.tile(np.diag([1e-4, 1e-2]), (count, 1, 1)))
    options = {"kernel": VelocityKernel(ell), "lambda_mean": 0.1, "directions": along}
    dense, low = of_both(t, reference, rank=400, **options)
    queries = np.linspace(-1, 3, 301)[:, None]
    np.testing.assert_allclose(low.mean(t), dense.mean(t), atol=1e-9)
    restored = named_arrays.from_arrays(named_arrays.to_arrays(low))
    assert np.array_equal(restored.mean(queries), low.mean(queries))
    via = [[0.77]], Gaussians.of([[2.0, 0.0]], deviation=0.03)
    a, b = (primitive.adapt(*via, tolerance=0.0, directions=[[1.0]]) for primitive in (dense, low))
    np.testing.assert_allclose(b.mean(t), a.mean(t), atol=1e-5)


def test_many_via_points_are_solved_anew():
    """With as many via-points as features, the problem is solved densely."""
    t = np.linspace(0, 2, 8)[:, None]
    mean = np.hstack([np.sin(3 * t), 3 * np.cos(3 * t)])
    reference = Gaussians.of(mean, deviation=0.03)
    dense, low = of_both(t, reference, kernel=VelocityKernel(200.0), lambda_mean=0.1)
    s = np.linspace(0.05, 1.95, 240)[:, None]
    wish = Gaussians.of(np.hstack([np.sin(3 * s), 3 * np.cos(3 * s)]), deviation=0.03)
    dense, low = (primitive.adapt(s, wish, tolerance=0.0) for primitive in (dense, low))
    np.testing.assert_allclose(low.mean(s), dense.mean(s), atol=1e-6)
