"""Derivatives as observations: a via-point that carries its Jacobian, and velocities."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, PeriodicKernel, VelocityKernel, ViaPointMissed
from kmp.functionals import Functionals
from kmp.kernel import between, variances
from support.primitives import naive

RANDOM = np.random.default_rng(0)
S = RANDOM.normal(size=(60, 4))
TRUTH = lambda s: np.stack([np.sin(s[:, 0]), s[:, 1] * s[:, 2], np.cos(s[:, 3])], axis=1)  # noqa: E731
REFERENCE = Gaussians.of(TRUTH(S), deviation=0.03)
PLACE = S[:1] + 0.1
FOLLOW = np.eye(3, 4)[None]  # the output follows the first three inputs
KERNELS = {
    "one length": GaussianKernel(0.3),
    "a length an input": GaussianKernel([0.3, 0.5, 0.2, 0.4]),
    "periodic": PeriodicKernel(0.5, 2.5),
    "velocity": VelocityKernel(0.7),
}


def base(representation="dense", kernel="a length an input", **options):
    options = {"lambda_mean": 1.0, "prior_mean": [0.1, 0.2, 0.3]} | options
    return KMP.fit(S, REFERENCE, kernel=KERNELS[kernel], representation=representation, **options)


def placed(one):
    return one.adapt(PLACE, Gaussians.of(TRUTH(S[:1]), deviation=1e-4), tolerance=0.3)


def taught(one, deviation=1e-4):
    return placed(one).adapt_jacobian(PLACE, FOLLOW, deviation=deviation)


@pytest.mark.parametrize("name", KERNELS)
def test_kernel_of_derivatives(name):
    kernel = KERNELS[name]
    h = 1e-5
    i = 4 if name in {"one length", "a length an input"} else 1
    a, u, b, v = (0.5 * RANDOM.normal(size=(n, i)) for n in (5, 5, 4, 4))
    u[1] = 0
    v[2] = 0
    c = kernel.channels

    def at(t, r):
        return kernel(a + t * u, b + r * v).reshape(5, c, 4, c)

    once_a = (at(h, 0) - at(-h, 0)) / (2 * h)
    once_b = (at(0, h) - at(0, -h)) / (2 * h)
    twice = (at(h, h) - at(h, -h) - at(-h, h) + at(-h, -h)) / (4 * h * h)
    is_a = u.any(axis=1)[:, None, None, None]
    is_b = v.any(axis=1)[None, None, :, None]
    expected = np.where(
        is_a & is_b, twice, np.where(is_a, once_a, np.where(is_b, once_b, at(0, 0)))
    )
    first = Functionals(a, u)
    other = Functionals(b, v)
    gram = between(kernel, first, other)
    np.testing.assert_allclose(gram.reshape(5, c, 4, c), expected, atol=3e-5)
    np.testing.assert_allclose(between(kernel, other, first), gram.T, atol=1e-12)
    np.testing.assert_allclose(
        variances(kernel, first).ravel(), np.diagonal(between(kernel, first, first)), rtol=1e-9
    )
    whole = Functionals.concatenated([first, other])
    assert np.linalg.eigvalsh(between(kernel, whole, whole))[0] > -1e-9


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("kernel", ["one length", "a length an input"])
def test_taught_jacobian_is_met(representation, kernel):
    """The via-point is met too."""
    primitive = taught(base(representation, kernel))
    np.testing.assert_allclose(primitive.jacobian(PLACE[0]), FOLLOW[0], atol=1e-5)
    np.testing.assert_allclose(primitive.mean(PLACE), TRUTH(S[:1]), atol=1e-5)
    step = 0.01 * RANDOM.normal(size=(5, 4))
    follows = TRUTH(S[:1]) + step @ FOLLOW[0].T
    np.testing.assert_allclose(primitive.mean(PLACE + step), follows, atol=1e-3)
    bare = placed(base(representation, kernel))
    assert np.abs(bare.mean(PLACE + step) - follows).max() > 4e-3


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_mean_and_covariance_are_naive_ones(representation):
    """Predictions equal those of `support.primitives.naive`."""
    primitive = taught(base(representation), deviation=0.1)
    queries = np.concatenate([PLACE, PLACE + 0.05, S[5:8] + 0.1])
    mean, joint = naive(primitive, queries)
    covariance = np.array([joint[n, :, n] for n in range(len(queries))])
    prediction = primitive.predict(queries)
    np.testing.assert_allclose(prediction.mean, mean, atol=1e-8)
    np.testing.assert_allclose(prediction.covariance, covariance, rtol=1e-5, atol=1e-8)
    for query, expected in zip(queries, covariance, strict=True):
        np.testing.assert_allclose(
            primitive.predict(query[None]).covariance[0], expected, rtol=1e-5, atol=1e-8
        )
        moving = primitive.predict_motion(query, np.ones(4), np.zeros(4))
        np.testing.assert_allclose(moving.covariance, expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_velocity_is_taught_and_replaces_no_point(representation):
    v = np.array([[0.3, -0.2, 0.1, 0.4]])
    desired = Gaussians.of([[0.1, 0.2, -0.3]], deviation=1e-4)
    primitive = base(representation).adapt(PLACE, desired, tolerance=9.0, directions=v)
    np.testing.assert_allclose(
        primitive.predict_motion(PLACE[0], v[0], np.zeros(4)).velocity, desired.mean[0], atol=1e-5
    )
    assert len(primitive.inputs) == 61  # no reference point gave way


@pytest.mark.parametrize("kernel", ["periodic", "velocity"])
def test_derivative_over_time_is_met(kernel):
    """The input is time."""
    t = np.linspace(0, 2.4, 50)[:, None]
    w = 2 * np.pi / 2.5
    mean = np.hstack([np.sin(w * t), w * np.cos(w * t)])
    reference = Gaussians(mean, np.tile(np.diag([1e-3, 1e-2]), (50, 1, 1)))
    primitive = KMP.fit(t, reference, kernel=KERNELS[kernel], lambda_mean=1.0)
    desired = Gaussians.of([[5.0, 2.0]], deviation=1e-4)
    adapted = primitive.adapt([[0.6]], desired, tolerance=0, directions=[[1.0]])
    h = 1e-5
    ahead = adapted.mean([[0.6 + h]])
    behind = adapted.mean([[0.6 - h]])
    np.testing.assert_allclose((ahead - behind) / (2 * h), desired.mean, atol=1e-3)
    np.testing.assert_allclose(adapted.jacobian([0.6])[:, 0], [5.0, 2.0], atol=1e-3)
    bend = (adapted.jacobian([0.9 + h]) - adapted.jacobian([0.9 - h]))[:, 0] / (2 * h)
    curvature = adapted.predict_motion([0.9], [1.0], [0.0]).curvature
    np.testing.assert_allclose(curvature, bend, rtol=1e-4, atol=1e-4)


def test_jacobians_that_contradict_are_named():
    twice = np.concatenate([PLACE, PLACE])
    with pytest.warns(ViaPointMissed, match=r"0 by .* deviations") as caught:
        primitive = base().adapt_jacobian(twice, np.concatenate([FOLLOW, -FOLLOW]), deviation=1e-2)
    assert caught[0].filename == __file__
    np.testing.assert_array_equal(primitive.via_directions, np.tile(np.eye(4), (2, 1)))
    assert base().via_directions.shape == (0, 4)
