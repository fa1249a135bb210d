"""Adapting a primitive: replaced points, unchanged predictions, and warnings of misses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed, named_arrays
from support.primitives import (
    database,
    kernel,
    properties,
    representations,
    same_bits,
    seeds,
    skill,
    via,
)


def test_near_point_is_replaced_and_far_one_inserted():
    """A near desired point replaces its nearest and a far one is inserted."""
    primitive = skill()
    inputs = np.stack([primitive.inputs[7] + 0.01, np.full(4, 9.0)])
    adapted = primitive.adapt(inputs, via(0, 2)[1], tolerance=0.1)
    assert list(adapted.inner.changes.replaced) == [7]
    assert len(adapted.inputs) == 31
    np.testing.assert_array_equal(
        adapted.inputs, np.concatenate([np.delete(primitive.inputs, 7, axis=0), inputs])
    )
    np.testing.assert_array_equal(adapted.via_inputs, inputs)
    assert adapted.base is primitive
    assert primitive.base is primitive
    assert len(primitive.via_points) == 0


def test_tolerance_is_exclusive_and_takes_nearest():
    """A distance equal to the tolerance does not replace."""
    primitive = KMP.fit(
        [[0.0], [1.0]], Gaussians([[0.0], [1.0]], np.ones((2, 1, 1))), kernel=kernel, lambda_mean=1
    )
    point = Gaussians([[5.0]], [[[1e-6]]])
    assert len(primitive.adapt([[0.25]], point, tolerance=0.25).inner.changes.replaced) == 0
    assert list(primitive.adapt([[0.25]], point, tolerance=0.26).inner.changes.replaced) == [0]
    assert list(primitive.adapt([[0.5]], point, tolerance=1).inner.changes.replaced) == [0, 1]
    assert list(primitive.adapt([[0.49]], point, tolerance=2).inner.changes.replaced) == [0]


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # two via-points are near each other
@properties
@given(seeds, st.floats(0, 3), representations)
def test_order_of_via_points_does_not_matter(seed, tolerance, representation):
    """The order of via-points does not matter, nor whether they are inserted one by one, unless a
    later one replaces an earlier one.
    """
    primitive = skill(seed, representation=representation)
    inputs, points = via(seed, 5, std=0.01)
    inputs[4] = inputs[3] + 0.05
    order = np.random.default_rng(seed).permutation(5)
    together = primitive.adapt(inputs, points, tolerance=tolerance)
    shuffled = primitive.adapt(inputs[order], points.take(order), tolerance=tolerance)
    singly = primitive
    for n in range(5):
        singly = singly.adapt(inputs[n : n + 1], points.take(slice(n, n + 1)), tolerance=tolerance)
    queries = np.random.default_rng(seed + 1).normal(size=(3, 4))
    assert np.array_equal(together.inner.changes.replaced, shuffled.inner.changes.replaced)
    np.testing.assert_allclose(shuffled.mean(queries), together.mean(queries), atol=1e-8)
    covariance = shuffled.predict(queries).covariance
    expected = together.predict(queries).covariance
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-7)
    assert same_bits(singly, together, queries) == (pdist(inputs).min() >= tolerance)
    assert primitive.adapt(*via(0, 0), tolerance=1) is together.base is primitive


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_a_goal_can_be_moved_a_thousand_times(representation):
    """Each move replaces the one before: it is met, and the primitive does not grow."""
    times = np.linspace(0.0, 2.0, 100)[:, None]
    reference = Gaussians.of(np.hstack([np.sin(3 * times), np.cos(2 * times)]), deviation=0.05)
    first = KMP.fit(
        times,
        reference,
        kernel=GaussianKernel(8.0),
        lambda_mean=1.0,
        representation=representation,
    )
    beside = first.adapt([[0.5]], Gaussians.of([0.9, 0.1], deviation=1e-5))
    moved = beside
    for k in range(1000):
        goal = np.array([0.3 + 0.001 * k, -0.4])
        at = [[2.0 - 1e-5 * (k % 7)]]
        moved = moved.adapt(at, Gaussians.of(goal, deviation=1e-5))
    np.testing.assert_allclose(moved.mean(at)[0], goal, atol=1e-5)
    np.testing.assert_allclose(moved.mean([[0.5]])[0], [0.9, 0.1], atol=1e-5)
    assert len(moved.via_inputs) == 2
    assert len(moved.inputs) == 100
    back = moved.without_via_points(at)
    assert same_bits(back, beside, times[::9])
    assert same_bits(back.without_via_points([[0.5]]), first, times[::9])


def test_via_points_that_are_not_there_are_named():
    adapted = skill(0).adapt(*via(0, 2, std=0.01), tolerance=0.1)
    with pytest.raises(ValueError, match=r"inputs\[0\]: .* given, the input of a via-point"):
        adapted.without_via_points([np.zeros(4)])
    with pytest.raises(ValueError, match="they are at no input"):
        skill(0).without_via_points([np.zeros(4)])


@properties
@given(seeds, st.sampled_from([None, 7.0]), st.sampled_from([0.0, 1.0, 100.0]))
def test_adapting_is_fitting_changed_database(seed, lambda_covariance, tolerance):
    adapted = skill(seed, lambda_covariance=lambda_covariance).adapt(
        *via(seed, 4, std=0.01), tolerance=tolerance
    )
    lambdas = {"lambda_mean": 2.0, "lambda_covariance": lambda_covariance}
    fitted = KMP.fit(adapted.inputs, adapted.reference, kernel=kernel, **lambdas)
    queries = np.random.default_rng(seed + 1).normal(size=(3, 4))
    np.testing.assert_allclose(adapted.mean(queries), fitted.mean(queries), atol=1e-7)
    covariance = adapted.predict(queries).covariance
    expected = fitted.predict(queries).covariance
    of_base = len(adapted.base.inputs) / len(fitted.inputs)  # N stays the base's
    np.testing.assert_allclose(covariance, expected * of_base, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_teaching_elsewhere_keeps_covariance(representation):
    """A via-point elsewhere does not change the covariance here."""
    inputs, reference = database()
    primitive = KMP.fit(
        inputs, reference, kernel=kernel, lambda_mean=2.0, representation=representation
    )
    points = Gaussians.of(np.zeros((80, 3)), deviation=0.01)
    elsewhere = 40.0 + 3 * np.random.default_rng(0).normal(size=(80, 4))
    adapted = primitive.adapt(elsewhere, points, tolerance=0.1)
    assert len(adapted.inputs) == 110
    queries = np.concatenate([inputs[:5], np.full((1, 4), -50.0)])
    before = primitive.predict(queries).covariance
    for variant in (
        adapted,
        named_arrays.from_arrays(named_arrays.to_arrays(adapted)),
        adapted.refitted(reference),
    ):
        np.testing.assert_allclose(
            variant.predict(queries).covariance, before, rtol=1e-6, atol=1e-9
        )
        np.testing.assert_allclose(
            variant.predict(queries[:1]).covariance, before[:1], rtol=1e-6, atol=1e-9
        )


def test_missed_via_point_is_named():
    """A via-point that is missed is named, with the numbers."""
    primitive = skill()
    near = np.array([[0.0, 0, 0, 0], [0.01, 0, 0, 0], [0, 3.0, 0, 0]])
    points = Gaussians.of([[0.0, 0, 0], [0.3, 0, 0], [0.1, 0, 0]], deviation=0.01)
    says = r"missed .*: 0 by 0\.1\d* \(1\d\.?\d* deviations\), 1 by .* larger ell"
    with pytest.warns(ViaPointMissed, match=says) as caught:
        adapted = primitive.adapt(near, points, tolerance=0)
    assert caught[0].filename == __file__
    miss = np.linalg.norm(adapted.mean(near) - points.mean, axis=1)
    assert f"1 by {miss[1]:.3g} ({miss[1] / 0.01:.3g} deviations)" in str(caught[0].message)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_miss_is_over_the_prior_deviation(unit):
    times = np.linspace(0, 1, 20)[:, None]
    primitive = KMP.fit(
        times,
        Gaussians.of(unit * times, deviation=0.1 * unit),
        kernel=GaussianKernel(1.0),
        lambda_mean=1.0,
        prior_covariance=[unit**2],
    )
    with pytest.warns(ViaPointMissed, match="0 by .* deviations"):
        primitive.adapt([0.5, 0.501], Gaussians.of([[unit], [-unit]], deviation=0.01 * unit))


def test_small_miss_is_not_named():
    """A via-point that may be missed, or is missed by less than a millimetre, is not named."""
    near = np.array([[0.0, 0, 0, 0], [0.01, 0, 0, 0]])
    for offset, std in ((0.3, 0.2), (0.0015, 1e-5)):
        points = Gaussians.of([[0.0, 0, 0], [offset, 0, 0]], deviation=std)
        skill().adapt(near, points, tolerance=0)
