"""The primitive: equations (8) and (9) against a naive solution, covariance, refusals."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kmp import KMP, GaussianKernel, Gaussians, named_arrays
from support.primitives import (
    database,
    kernel,
    naive,
    properties,
    representations,
    same_bits,
    seeds,
    skill,
    via,
)


@properties
@given(seeds, st.sampled_from([1, 2, 3]), st.sampled_from([None, 5.0]), st.booleans())
def test_mean_and_covariance_are_naive_ones(seed, outputs, lambda_covariance, adapted):
    """Predictions equal those of `support.primitives.naive`."""
    prior = np.arange(outputs) + 0.5
    primitive = skill(seed, lambda_covariance=lambda_covariance, prior_mean=prior, outputs=outputs)
    if adapted:
        primitive = primitive.adapt(*via(seed, 3, outputs=outputs, std=0.01), tolerance=1.5)
    queries = np.random.default_rng(seed + 1).normal(size=(4, 4))
    together = primitive.predict(queries)
    mean, joint = naive(primitive, queries)
    for n, query in enumerate(queries):
        alone = primitive.predict(query[None])
        for predicted_mean in (together.mean[n], alone.mean[0], primitive.mean(queries)[n]):
            np.testing.assert_allclose(predicted_mean, mean[n], atol=1e-8)
        for predicted_covariance in (together.covariance[n], alone.covariance[0]):
            np.testing.assert_allclose(predicted_covariance, joint[n, :, n], rtol=1e-6, atol=1e-7)


def test_batches_equal_single_queries():
    queries = np.random.default_rng(0).normal(size=(600, 4))
    primitive = skill()
    prediction = primitive.predict(queries)
    for n in (0, 255, 256, 511, 512, 599):
        np.testing.assert_allclose(
            prediction.covariance[n], primitive.predict(queries[n : n + 1]).covariance[0], rtol=1e-9
        )


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # some via-points are near each other
@properties
@given(seeds, st.sampled_from([0.001, 0.1, 1.0]), representations)
def test_covariance_is_positive_definite(seed, spread, representation):
    """The covariance is symmetric too, also at the data."""
    random = np.random.default_rng(seed)
    inputs = spread * random.normal(size=(20, 2))
    exact = Gaussians(random.normal(size=(20, 2)), np.tile(1e-11 * np.eye(2), (20, 1, 1)))
    primitive = KMP.fit(
        inputs, exact, kernel=kernel, lambda_mean=1.0, representation=representation
    )
    adapted = primitive.adapt(inputs[:3] + 0.01, exact[:3], tolerance=0.1)
    for variant in (primitive, adapted):
        for prediction in (variant.predict(inputs), *(variant.predict(s[None]) for s in inputs)):
            covariance = prediction.covariance
            assert np.array_equal(covariance, covariance.swapaxes(1, 2))
            assert (np.linalg.eigvalsh(covariance) > 0).all()


@pytest.mark.parametrize("lambda_covariance", [1e-2, 1.0])
def test_hidden_covariance_is_refused_with_remedy(lambda_covariance):
    """The remedy in the message works."""
    inputs, reference = database()
    sure = Gaussians(reference.mean, np.tile(1e-9 * np.eye(3), (30, 1, 1)))
    primitive = KMP.fit(
        inputs, sure, kernel=kernel, lambda_mean=1.0, lambda_covariance=lambda_covariance
    )
    assert primitive.predict(inputs).covariance.shape == (30, 3, 3)
    points = via(0, 1, std=1e-8)
    says = (
        rf"point 30 .* lambda Sigma is {1e-16 * lambda_covariance:.3g} .* lambda_covariance of at "
        r"least 1e\+05"
    )
    with pytest.raises(ValueError, match=says):
        primitive.adapt(*points, tolerance=0)
    remedied = KMP.fit(inputs, sure, kernel=kernel, lambda_mean=1.0, lambda_covariance=1e5)
    np.testing.assert_allclose(
        remedied.adapt(*points, tolerance=0).mean(points[0]), points[1].mean, atol=1e-6
    )


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_far_away_is_the_prior(representation):
    """Far from the data, mean and covariance are those of the prior."""
    far = np.full((1, 4), 50.0)
    base = skill(prior_mean=[1, 2, 3], representation=representation)
    for primitive in (base, base.adapt(*via(0, 1), tolerance=0.1)):
        prediction = primitive.predict(far)
        np.testing.assert_array_equal(prediction.mean, [[1, 2, 3]])
        np.testing.assert_allclose(prediction.covariance[0], 30 / 2.0 * np.eye(3))
    np.testing.assert_array_equal(skill().mean(far), [[0, 0, 0]])


@pytest.mark.parametrize("count", [0, 2])
def test_refitted_to_own_reference_is_the_same(count):
    """A primitive fitted again to its own reference is the same bit for bit."""
    primitive = skill(lambda_covariance=5.0).adapt(*via(1, count), tolerance=1.5)
    queries = np.random.default_rng(2).normal(size=(3, 4))
    assert same_bits(primitive.refitted(primitive.base.reference), primitive, queries)
    other = Gaussians(primitive.base.reference.mean + 1, primitive.base.reference.covariance)
    refitted = primitive.refitted(other)
    assert np.array_equal(refitted.via_inputs, primitive.via_inputs)
    assert np.array_equal(refitted.base.reference.mean, other.mean)
    with pytest.raises(ValueError, match="29 normals over 3 outputs given for 30 inputs"):
        primitive.refitted(other.take(slice(0, 29)))


@properties
@given(seeds, st.sampled_from([0.01, 3.0, 1000.0]), representations)
def test_other_units_change_nothing(seed, c, representation):
    inputs, reference = database(seed)
    points, desired = via(seed, 2, std=0.01)
    queries = np.random.default_rng(seed + 1).normal(size=(4, 4))
    unscaled, other = (
        KMP.fit(
            f * inputs,
            Gaussians(f * reference.mean, f**2 * reference.covariance),
            kernel=GaussianKernel(0.5 / f**2),
            lambda_mean=2.0 / f**2,
            representation=representation,
        )
        .base.adapt(
            f * points, Gaussians(f * desired.mean, f**2 * desired.covariance), tolerance=0.1 * f
        )
        .predict(f * queries)
        for f in (1.0, c)
    )
    np.testing.assert_allclose(other.mean / c, unscaled.mean, atol=1e-6)
    np.testing.assert_allclose(other.covariance / c**2, unscaled.covariance, rtol=1e-5, atol=1e-6)


@properties
@given(seeds, representations)
def test_uncertainty_has_two_parts(seed, representation):
    """The uncertainty is the demonstrations' variability plus the distance from them."""
    inputs, reference = database(seed)
    primitive = KMP.fit(
        inputs, reference, kernel=kernel, lambda_mean=2.0, representation=representation
    )
    queries = np.concatenate(
        [inputs[:3], np.random.default_rng(seed).normal(size=(3, 4)), np.full((1, 4), 50.0)]
    )
    parts = primitive.uncertainty(queries)
    total = primitive.predict(queries).covariance
    np.testing.assert_allclose(parts.variability + parts.distance, total, rtol=1e-6, atol=1e-7)
    for part in (parts.variability, parts.distance):
        assert (np.linalg.eigvalsh(part) > -1e-12).all()
    assert np.abs(parts.distance[:3]).max() < 1e-6  # at the data: only variability
    np.testing.assert_allclose(parts.variability[-1], 0, atol=1e-9)  # far away: distance only
    np.testing.assert_allclose(parts.distance[-1], 15 * np.eye(3), rtol=1e-9)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("points", [0, 1])
def test_threads_may_share_a_primitive(representation, points):
    primitive, fresh = (
        skill(count=60, representation=representation).adapt(*via(0, points), tolerance=0.1)
        for _ in range(2)
    )
    queries = np.random.default_rng(2).normal(size=(64, 1, 4))
    with ThreadPoolExecutor(4) as pool:
        predictions = list(pool.map(primitive.predict, queries))
    assert all(
        np.array_equal(p.covariance, fresh.predict(q).covariance)
        for p, q in zip(predictions, queries, strict=True)
    )


INPUTS, REFERENCE = database(count=3)
TWINS = Gaussians(np.zeros((2, 1)), np.full((2, 1, 1), 1e-20))
ARRAYS = named_arrays.to_arrays(skill().adapt(*via(0, 2), tolerance=1.5))


def fit(inputs=INPUTS, reference=REFERENCE):
    return KMP.fit(inputs, reference, kernel=kernel, lambda_mean=1.0)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: fit(INPUTS[:2]), "3 normals over 3 outputs given for 2 inputs; 2 over 3 needed"),
        (
            lambda: fit([[1.0], [1.0]], TWINS),
            "not positive definite to working precision at point 1, with lambda 1",
        ),
        (
            lambda: fit().adapt(*via(0, 1, inputs=2), tolerance=1),
            r"inputs: shape \(1, 2\) given, \(V, 4\) needed",
        ),
        (
            lambda: fit().adapt(*via(0, 1, outputs=2), tolerance=1),
            "1 normals over 2 outputs given for 1 inputs",
        ),
        (
            lambda: named_arrays.from_arrays({"ell": np.array(1.0)}),
            "arrays lack base_inputs, base_mean, .* Needed are",
        ),
        (
            lambda: named_arrays.from_arrays(ARRAYS | {"weights": np.ones((2, 3))}),
            r"weights: shape \(2, 3\) given",
        ),
        (
            lambda: named_arrays.from_arrays(ARRAYS | {"replaced": np.array([99])}),
            r"replaced: \[99\] given, ascending",
        ),
    ],
)
def test_impossible_calls_are_refused(call, says):
    """Impossible requests are refused, with what is possible."""
    with pytest.raises(ValueError, match=says):
        call()


# --- against a solution in extended precision ---


wide = np.longdouble
extended = pytest.mark.skipif(
    np.finfo(wide).eps > 1e-18, reason="this machine has no extended precision"
)


def solved(matrix, right):
    """matrix^-1 `right`, by a Cholesky factor in extended precision, refined once."""
    n = len(matrix)
    factor = matrix.copy()
    for j in range(n):
        factor[j, j] = np.sqrt(factor[j, j])
        factor[j + 1 :, j] /= factor[j, j]
        factor[j + 1 :, j + 1 :] -= np.outer(factor[j + 1 :, j], factor[j + 1 :, j])

    def once(b):
        x = b.copy()
        for j in range(n):
            x[j] = (x[j] - factor[j, :j] @ x[:j]) / factor[j, j]
        for j in reversed(range(n)):
            x[j] = (x[j] - factor[j + 1 :, j] @ x[j + 1 :]) / factor[j, j]
        return x

    solution = once(right)
    return solution + once(right - matrix @ solution)


def blocks(kernel, a, b):
    """The kernel in extended precision: (A, B)."""
    return np.exp(-(np.asarray(kernel.ell, dtype=wide) * (a[:, None] - b[None]) ** 2).sum(axis=2))


def exact(primitive, queries):
    """Equations (8), (9) and the covariance of IJRR 2019 by definition, in extended precision."""
    s = primitive.inputs.astype(wide)
    kernel = primitive.kernel
    n, o = primitive.reference.mean.shape
    unit = np.eye(o, dtype=wide)
    k = np.kron(blocks(kernel, s, s), unit)
    rows = np.kron(blocks(kernel, queries.astype(wide), s), unit)
    sigma = np.zeros((n, o, n, o), dtype=wide)
    sigma[np.arange(n), :, np.arange(n)] = primitive.reference.covariance
    sigma = sigma.reshape(n * o, n * o)
    right = (primitive.reference.mean - primitive.prior_mean).astype(wide).ravel()
    mean = (rows @ solved(k + wide(primitive.lambda_mean) * sigma, right)).reshape(
        -1, o
    ) + primitive.prior_mean
    gain = solved(k + wide(primitive.lambda_covariance) * sigma, rows.T)
    covariances = [unit - rows[i : i + o] @ gain[:, i : i + o] for i in range(0, len(rows), o)]
    return mean, np.array(covariances) * n / wide(primitive.lambda_covariance)


def hands():
    random = np.random.default_rng(0)
    t = np.linspace(0, 1, 70)
    path = np.stack(
        [0.4 * t, 0.2 * np.sin(5 * t), 0.1 * t, 0.3 * np.cos(3 * t), t**2, 0.1 - 0.1 * t], axis=1
    )
    root = 0.02 * random.normal(size=(70, 3, 3))
    tool = np.stack([np.sin(3 * t), np.cos(4 * t), t - t**2], axis=1) * 0.5
    inputs = path + 0.01 * random.normal(size=path.shape)
    inputs[10:14] = inputs[9]  # the hands rest
    return inputs, Gaussians(tool, root @ root.swapaxes(1, 2) + 1e-5 * np.eye(3))


@extended
@pytest.mark.parametrize("lambda_covariance", [None, 20.0])
@pytest.mark.parametrize("ell", [0.5, 20.0, np.array([0.5, 1, 2, 0.5, 1, 2])])
@pytest.mark.parametrize("adapted", [False, True])
def test_nine_digits_in_extended_precision(lambda_covariance, ell, adapted):
    """Mean and covariance have nine right digits."""
    inputs, reference = hands()
    primitive = KMP.fit(
        inputs,
        reference,
        kernel=GaussianKernel(ell),
        lambda_mean=2.0,
        lambda_covariance=lambda_covariance,
        prior_mean=[0.1, 0.2, 0.3],
    )
    queries = np.concatenate([inputs[::10] + 0.01, inputs[30:31] + 0.5, inputs[:1]])
    if adapted:
        via = Gaussians.of(reference.mean[[20, 40]] + 0.05, deviation=1e-4)
        primitive = primitive.adapt(inputs[[20, 40]] + 0.01, via, tolerance=0.05)
        queries = np.concatenate([queries, primitive.via_inputs])
    check(primitive, queries)


def check(primitive, queries):
    mean, covariance = exact(primitive, queries)
    together = primitive.predict(queries)
    singly = [primitive.predict(query[None]) for query in queries]
    for predicted_mean in (
        together.mean,
        np.concatenate([prediction.mean for prediction in singly]),
    ):
        assert np.linalg.norm((predicted_mean - mean).astype(float)) <= 1e-9 * np.linalg.norm(
            mean.astype(float)
        )
    for predicted_covariance in (
        together.covariance,
        np.concatenate([prediction.covariance for prediction in singly]),
    ):
        assert np.linalg.norm(
            (predicted_covariance - covariance).astype(float)
        ) <= 1e-9 * np.linalg.norm(covariance.astype(float))
    near = slice(0, -3)  # relative to the covariance where that is small
    error = np.linalg.norm((together.covariance - covariance)[near].astype(float))
    assert error <= 1e-9 * np.linalg.norm(covariance[near].astype(float))
