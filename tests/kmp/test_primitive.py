"""The primitive: equations (8) and (9) against a naive solution, covariance, files, refusals."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel, named_arrays
from support.primitives import database, kernel, naive, properties, same_bits, seeds, skill, via


@properties
@given(seeds, st.sampled_from([1, 2, 3]), st.sampled_from([None, 5.0]), st.booleans())
def test_mean_and_covariance_are_those_of_the_naive_solution(seed, outputs, lambda_covariance, adapted):
    prior = np.arange(outputs) + 0.5
    primitive = skill(seed, lambda_covariance=lambda_covariance, prior_mean=prior, outputs=outputs)
    if adapted:
        primitive = primitive.adapt(*via(seed, 3, outputs=outputs, std=0.01), tolerance=1.5)
    queries = np.random.default_rng(seed + 1).normal(size=(4, 4))
    together = primitive.predict(queries)
    for n, query in enumerate(queries):
        mean, covariance = naive(
            primitive.inputs,
            primitive.reference,
            query,
            lambda_mean=2.0,
            lambda_covariance=lambda_covariance or 2.0,
            prior_mean=prior,
            count=len(primitive.base.inputs),
        )
        alone = primitive.predict(query[None])
        for found in (together.mean[n], alone.mean[0], primitive.mean(queries)[n]):
            np.testing.assert_allclose(found, mean, atol=1e-8)
        for found in (together.covariance[n], alone.covariance[0]):
            np.testing.assert_allclose(found, covariance, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_predict_has_the_very_mean_of_mean(count):
    queries = np.random.default_rng(0).normal(size=(count, 4))
    primitive = skill()
    assert np.array_equal(primitive.predict(queries).mean, primitive.mean(queries))
    assert primitive.predict(queries).covariance.shape == (count, 3, 3)


def test_many_queries_are_predicted_in_batches_as_in_one():
    queries = np.random.default_rng(0).normal(size=(600, 4))
    primitive = skill()
    found = primitive.predict(queries)
    for n in (0, 255, 256, 511, 512, 599):
        np.testing.assert_allclose(found.covariance[n], primitive.predict(queries[n : n + 1]).covariance[0], rtol=1e-9)


@properties
@given(seeds, st.sampled_from([0.001, 0.1, 1.0]))
def test_the_covariance_is_symmetric_and_positive_definite_even_where_all_is_known(seed, spread):
    random = np.random.default_rng(seed)
    inputs = spread * random.normal(size=(20, 2))
    primitive = KMP.fit(
        inputs,
        Gaussians(random.normal(size=(20, 2)), np.tile(1e-11 * np.eye(2), (20, 1, 1))),
        kernel=kernel,
        lambda_mean=1.0,
    )
    predictions = [primitive.predict(inputs), *(primitive.predict(s[None]) for s in inputs)]
    for covariance in (p.covariance for p in predictions):
        assert np.array_equal(covariance, covariance.swapaxes(1, 2))
        assert (np.linalg.eigvalsh(covariance) > 0).all()


@pytest.mark.parametrize("lambda_covariance", [1e-2, 1.0])
def test_a_covariance_that_rounding_would_hide_is_refused_and_the_remedy_works(lambda_covariance):
    inputs, reference = database()
    sure = Gaussians(reference.mean, np.tile(1e-9 * np.eye(3), (30, 1, 1)))
    one = KMP.fit(inputs, sure, kernel=kernel, lambda_mean=1.0, lambda_covariance=lambda_covariance)
    assert one.predict(inputs).covariance.shape == (30, 3, 3)
    points = via(0, 1, std=1e-8)
    says = rf"point 30 .* lambda Sigma is {1e-16 * lambda_covariance:.3g} .* lambda_covariance of at least 1e\+05"
    with pytest.raises(ValueError, match=says):
        one.adapt(*points, tolerance=0)
    remedied = KMP.fit(inputs, sure, kernel=kernel, lambda_mean=1.0, lambda_covariance=1e5)
    np.testing.assert_allclose(remedied.adapt(*points, tolerance=0).mean(points[0]), points[1].mean, atol=1e-6)


def test_far_away_the_mean_is_the_prior_and_the_covariance_the_whole():
    far = np.full((1, 4), 50.0)
    prediction = skill(prior_mean=[1, 2, 3]).predict(far)
    np.testing.assert_array_equal(prediction.mean, [[1, 2, 3]])
    np.testing.assert_allclose(prediction.covariance[0], 30 / 2.0 * np.eye(3))
    np.testing.assert_array_equal(skill().mean(far), [[0, 0, 0]])


def test_repeated_inputs_are_legal_and_give_the_same_as_their_mean_with_half_the_covariance():
    inputs, reference = database(count=8)
    means = np.concatenate([reference.mean + 0.1, reference.mean - 0.1])
    doubled = Gaussians(means, np.tile(reference.covariance, (2, 1, 1)))
    twice = KMP.fit(np.tile(inputs, (2, 1)), doubled, kernel=kernel, lambda_mean=2.0)
    once = KMP.fit(inputs, Gaussians(reference.mean, reference.covariance / 2), kernel=kernel, lambda_mean=2.0)
    queries = np.random.default_rng(1).normal(size=(5, 4))
    np.testing.assert_allclose(twice.mean(queries), once.mean(queries), atol=1e-8)


@pytest.mark.parametrize("count", [0, 2])
def test_refitted_to_its_own_reference_it_is_the_same_bit_for_bit(count):
    primitive = skill(lambda_covariance=5.0).adapt(*via(1, count), tolerance=1.5)
    queries = np.random.default_rng(2).normal(size=(3, 4))
    assert same_bits(primitive.refitted(primitive.base.reference), primitive, queries)
    other = Gaussians(primitive.base.reference.mean + 1, primitive.base.reference.covariance)
    again = primitive.refitted(other)
    assert np.array_equal(again.via_inputs, primitive.via_inputs)
    assert np.array_equal(again.base.reference.mean, other.mean)
    with pytest.raises(ValueError, match="29 normals over 3 outputs given for 30 inputs"):
        primitive.refitted(other.take(slice(0, 29)))


@pytest.mark.parametrize("lambda_covariance", [None, 6.0])
@pytest.mark.parametrize("count", [0, 3])
def test_saved_arrays_give_the_primitive_back_bit_for_bit(tmp_path, lambda_covariance, count):
    base = skill(lambda_covariance=lambda_covariance, prior_mean=[0.1, 0.2, 0.3])
    primitive = base.adapt(*via(1, count), tolerance=1.5)
    np.savez(tmp_path / "skill.npz", note=np.array("left alone"), **named_arrays.to_arrays(primitive))
    with np.load(tmp_path / "skill.npz") as arrays:
        again = named_arrays.from_arrays(arrays)
    queries = np.random.default_rng(2).normal(size=(5, 4))
    assert same_bits(primitive, again, queries)
    assert same_bits(primitive.base, again.base, queries)
    more = via(9, 2)
    assert same_bits(primitive.adapt(*more, tolerance=1), again.adapt(*more, tolerance=1), queries)


def test_saved_weights_are_used_and_not_fitted_again():
    saved = named_arrays.to_arrays(skill().adapt(*via(0, 2), tolerance=0))
    again = named_arrays.from_arrays(saved | {"base_weights": np.ones((30, 3)), "weights": np.full((32, 3), 2.0)})
    np.testing.assert_array_equal(again.base.weights, np.ones((30, 3)))
    np.testing.assert_array_equal(again.weights, np.full((32, 3), 2.0))


def test_a_pickled_primitive_is_the_same_bit_for_bit_and_read_only():
    primitive, queries = skill().adapt(*via(1, 2), tolerance=1), np.random.default_rng(2).normal(size=(5, 4))
    primitive.predict(queries)
    again = pickle.loads(pickle.dumps(primitive))
    assert same_bits(primitive, again, queries)
    for one in (primitive, again, again.base):
        arrays = [
            one.inputs,
            one.weights,
            one.inner.changes.replaced,
            one.prior_mean,
            one.reference.mean,
            one.via_inputs,
            *one.inner.solution.inverse_factor.bands,
        ]
        assert not any(array.flags.writeable for array in arrays)


@properties
@given(seeds, st.sampled_from([0.01, 3.0, 1000.0]), st.sampled_from(["dense", "low_rank"]))
def test_other_units_change_nothing(seed, c, representation):
    inputs, reference = database(seed)
    points, desired = via(seed, 2, std=0.01)
    queries = np.random.default_rng(seed + 1).normal(size=(4, 4))
    one, other = (
        KMP.fit(
            f * inputs,
            Gaussians(f * reference.mean, f**2 * reference.covariance),
            kernel=GaussianKernel(0.5 / f**2),
            lambda_mean=2.0 / f**2,
            representation=representation,
        )
        .base.adapt(f * points, Gaussians(f * desired.mean, f**2 * desired.covariance), tolerance=0.1 * f)
        .predict(f * queries)
        for f in (1.0, c)
    )
    np.testing.assert_allclose(other.mean / c, one.mean, atol=1e-6)
    np.testing.assert_allclose(other.covariance / c**2, one.covariance, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_the_covariance_is_small_at_a_via_point_and_not_at_a_query_far_from_the_others(representation):
    inputs, reference = database()
    primitive = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2.0, representation=representation)
    where, points = via(4, 1, std=1e-3)
    before, after = primitive.predict(where), primitive.adapt(where, points, tolerance=0).predict(where)
    assert np.trace(after.covariance[0]) < 0.1 * np.trace(before.covariance[0])
    assert np.linalg.eigvalsh(after.covariance[0])[-1] < 30 * 1e-6 * 1.01  # N times the via-point's own, no more


@properties
@given(seeds, st.sampled_from(["dense", "low_rank"]))
def test_the_uncertainty_is_the_demonstrations_variability_and_the_distance_from_them(seed, representation):
    inputs, reference = database(seed)
    primitive = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2.0, representation=representation)
    queries = np.concatenate([inputs[:3], np.random.default_rng(seed).normal(size=(3, 4)), np.full((1, 4), 50.0)])
    parts = primitive.uncertainty(queries)
    total = primitive.predict(queries).covariance
    np.testing.assert_allclose(parts.variability + parts.distance, total, rtol=1e-6, atol=1e-7)
    for part in (parts.variability, parts.distance):
        assert (np.linalg.eigvalsh(part) > -1e-12).all()
    assert np.abs(parts.distance[:3]).max() < 1e-6  # at the data, all is the demonstrations'
    np.testing.assert_allclose(parts.variability[-1], 0, atol=1e-9)  # far away, nothing is
    np.testing.assert_allclose(parts.distance[-1], 15 * np.eye(3), rtol=1e-9)


def test_without_variability_all_uncertainty_is_distance():
    inputs, reference = database()
    queries = np.random.default_rng(5).normal(size=(4, 4))
    exact = Gaussians(reference.mean, np.tile(1e-9 * np.eye(3), (30, 1, 1)))
    of_exact = KMP.fit(inputs, exact, kernel=kernel, lambda_mean=2.0).predict(queries).covariance
    found = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=2.0).uncertainty(queries).distance
    np.testing.assert_allclose(found, of_exact, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("count", [1, 3, 6])
def test_with_rates_too_all_uncertainty_is_distance_without_variability(count, representation):
    t, queries = np.linspace(0, 2, count)[:, None], np.linspace(-0.5, 2.5, 31)[:, None]
    mean = np.hstack([np.sin(3 * t), 3 * np.cos(3 * t)])
    options = {"kernel": VelocityKernel(20.0), "lambda_mean": 2.0, "representation": representation}

    def fit(variance):
        return KMP.fit(t, Gaussians(mean, np.tile(variance * np.eye(2), (count, 1, 1))), **options)

    found, of_exact = fit(0.01).uncertainty(queries), fit(1e-9).predict(queries).covariance
    np.testing.assert_allclose(found.distance, of_exact, rtol=1e-3, atol=1e-6 * count)
    total = fit(0.01).predict(queries).covariance
    np.testing.assert_allclose(found.variability + found.distance, total, rtol=1e-6, atol=1e-6)


def test_threads_may_share_a_primitive():
    primitive, queries = skill(count=60), np.random.default_rng(2).normal(size=(64, 1, 4))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(primitive.predict, queries))
    fresh = skill(count=60)
    assert all(np.array_equal(p.covariance, fresh.predict(q).covariance) for p, q in zip(found, queries, strict=True))


INPUTS, REFERENCE = database(count=3)
TWINS = Gaussians(np.zeros((2, 1)), np.full((2, 1, 1), 1e-20))
ARRAYS = named_arrays.to_arrays(skill().adapt(*via(0, 2), tolerance=1.5))


def fit(inputs=INPUTS, reference=REFERENCE):
    return KMP.fit(inputs, reference, kernel=kernel, lambda_mean=1.0)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: fit(INPUTS[:2]), "3 normals over 3 outputs given for 2 inputs; 2 over 3 needed"),
        (lambda: fit([[1.0], [1.0]], TWINS), "not positive definite to working precision at point 1, with lambda 1"),
        (lambda: fit().adapt(*via(0, 1, inputs=2), tolerance=1), r"inputs: shape \(1, 2\) given, \(V, 4\) needed"),
        (lambda: fit().adapt(*via(0, 1, outputs=2), tolerance=1), "1 normals over 2 outputs given for 1 inputs"),
        (lambda: named_arrays.from_arrays({"ell": np.array(1.0)}), "arrays lack base_inputs, base_mean, .* Needed are"),
        (lambda: named_arrays.from_arrays(ARRAYS | {"weights": np.ones((2, 3))}), r"weights: shape \(2, 3\) given"),
        (lambda: named_arrays.from_arrays(ARRAYS | {"replaced": np.array([99])}), r"replaced: \[99\] given, ascending"),
    ],
)
def test_what_cannot_be_done_is_refused_with_what_could(call, says):
    with pytest.raises(ValueError, match=says):
        call()
