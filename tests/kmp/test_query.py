"""One query: mean, motion and covariance, with every kernel and every solution."""

import numpy as np
import pytest

from kmp import KMP, Gaussians
from kmp.compiled import AVAILABLE
from support.primitives import KERNELS, curve


def primitive(kernel, representation, changed):
    inputs, reference = curve(KERNELS[kernel])
    prior = [0.3, 0.2, 0, 0][: reference.outputs]
    options = {
        "lambda_mean": 1.0,
        "lambda_covariance": 3.0,
        "prior_mean": prior,
        "representation": representation,
    }
    model = KMP.fit(inputs, reference, kernel=KERNELS[kernel], **options)
    if changed != "fitted":
        via = Gaussians.of(reference.mean[20:22] + 0.05, deviation=0.03)
        model = model.adapt(inputs[20:22] + 0.01, via, tolerance=0.02)
    if changed == "with a Jacobian":
        place = inputs[31:32] + 0.01
        model = model.adapt_jacobian(place, model.jacobians(place) + 0.1, deviation=0.1)
    return model


CHANGES = ("fitted", "adapted", "with a Jacobian")


@pytest.fixture(
    params=[(k, r, c) for k in KERNELS for r in ("dense", "low_rank") for c in CHANGES], ids=str
)
def skill(request):
    return primitive(*request.param)


def moving(skill):
    """A query near the data, its velocity and acceleration."""
    random = np.random.default_rng(1)
    inputs = skill.inputs
    return inputs[30] + 0.02, *random.normal(size=(2, inputs.shape[1]))


def test_one_call_equals_the_others(skill, monkeypatch):
    """One call gives the results of the separate calls, bit for bit."""
    monkeypatch.setattr("kmp.loops.query.AVAILABLE", False)  # as without Numba
    s, v, a = moving(skill)
    prediction = skill.predict_motion(s, v, a)
    batch = skill.predict(s[None])
    assert np.array_equal(prediction.mean, skill.mean(s[None])[0])
    assert np.array_equal(prediction.mean, batch.mean[0])
    assert np.array_equal(prediction.covariance, batch.covariance[0])
    assert np.array_equal(prediction.jacobian, skill.jacobian(s))
    assert np.array_equal(prediction.velocity, prediction.jacobian @ v)
    assert np.array_equal(prediction.acceleration, prediction.jacobian @ a + prediction.curvature)
    bare = skill.predict_motion(s, v, a, covariance=False)
    assert bare.covariance is None
    assert np.array_equal(bare.acceleration, prediction.acceleration)


def test_compiled_loops_equal_plain_ones(skill):
    """The difference is rounding."""
    motion = moving(skill)
    prediction = skill.predict_motion(*motion)
    plain = skill.inner.query.motion(*motion, covariance=True)
    assert (skill.inner.compiled_query is None) == (skill.kernel.channels == 2 or not AVAILABLE)
    for name in plain._fields[:3] + plain._fields[4:]:
        size = np.abs(getattr(plain, name)).max()
        np.testing.assert_allclose(
            getattr(prediction, name), getattr(plain, name), rtol=0, atol=1e-11 * size, err_msg=name
        )
    np.testing.assert_allclose(prediction.covariance, plain.covariance, rtol=0, atol=1e-9)
    np.linalg.cholesky(prediction.covariance)


def test_jacobian_and_curvature_are_derivatives(skill):
    """The Jacobian and the curvature agree with finite differences."""
    s, v, _ = moving(skill)
    h = 1e-5
    steps = h * np.eye(len(s))
    numeric = (skill.mean(s + steps) - skill.mean(s - steps)).T / (2 * h)
    np.testing.assert_allclose(skill.jacobian(s), numeric, rtol=1e-5, atol=1e-5)
    bend = (skill.jacobian(s + h * v) - skill.jacobian(s - h * v)) @ v / (2 * h)
    curvature = skill.predict_motion(s, v, v).curvature
    np.testing.assert_allclose(curvature, bend, rtol=1e-5, atol=1e-4)


def test_motion_is_the_derivative_along_path(skill):
    """Velocity and acceleration agree with finite differences along the motion."""
    s, v, a = moving(skill)
    h = 1e-4
    behind, center, ahead = skill.mean([s + t * v + t * t / 2 * a for t in (-h, 0, h)])
    prediction = skill.predict_motion(s, v, a)
    np.testing.assert_allclose(
        prediction.velocity, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(
        prediction.acceleration, (ahead - 2 * center + behind) / h**2, rtol=1e-3, atol=1e-3
    )
