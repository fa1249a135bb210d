"""One query: mean, motion and covariance, with every kernel and every solution."""

import numpy as np
import pytest

from kmp import KMP, Gaussians
from kmp.compiled import AVAILABLE
from support.primitives import KERNELS, curve


def primitive(kernel, representation, changed):
    inputs, reference = curve(KERNELS[kernel])
    prior = [0.3, 0.2, 0, 0][: reference.outputs]
    options = {"lambda_mean": 1.0, "lambda_covariance": 3.0, "prior_mean": prior, "representation": representation}
    one = KMP.fit(inputs, reference, kernel=KERNELS[kernel], **options)
    if changed != "fitted":
        via = Gaussians.of(reference.mean[20:22] + 0.05, deviation=0.03)
        one = one.adapt(inputs[20:22] + 0.01, via, tolerance=0.02)
    if changed == "with a Jacobian":
        place = inputs[31:32] + 0.01
        one = one.adapt_jacobian(place, one.jacobians(place) + 0.1, deviation=0.1)
    return one


CHANGES = ("fitted", "adapted", "with a Jacobian")


@pytest.fixture(params=[(k, r, c) for k in KERNELS for r in ("dense", "low_rank") for c in CHANGES], ids=str)
def skill(request):
    return primitive(*request.param)


def moving(skill, seed=1):
    """A query near the data, its velocity and acceleration."""
    random, inputs = np.random.default_rng(seed), skill.inputs
    return inputs[30] + 0.02, *random.normal(size=(2, inputs.shape[1]))


def test_one_call_gives_what_the_others_give_bit_for_bit(skill, monkeypatch):
    monkeypatch.setattr("kmp.loops.query.AVAILABLE", False)  # as where Numba is not installed
    s, v, a = moving(skill)
    found, one = skill.predict_motion(s, v, a), skill.predict(s[None])
    assert np.array_equal(found.mean, skill.mean(s[None])[0])
    assert np.array_equal(found.mean, one.mean[0])
    assert np.array_equal(found.covariance, one.covariance[0])
    assert np.array_equal(found.jacobian, skill.jacobian(s))
    assert np.array_equal(found.curvature, skill.curvature(s, v))
    assert np.array_equal(found.velocity, found.jacobian @ v)
    assert np.array_equal(found.acceleration, found.jacobian @ a + found.curvature)


@pytest.mark.parametrize("seed", range(5))
def test_compiled_loops_give_the_same_but_for_rounding(skill, seed):
    motion = moving(skill, seed)
    found, plain = skill.predict_motion(*motion), skill.inner.query.motion(*motion, covariance=True)
    assert (skill.inner.compiled_query is None) == (skill.kernel.channels == 2 or not AVAILABLE)
    for name in plain._fields[:3] + plain._fields[4:]:
        size = np.abs(getattr(plain, name)).max()
        np.testing.assert_allclose(getattr(found, name), getattr(plain, name), rtol=0, atol=1e-11 * size, err_msg=name)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=0, atol=1e-9)
    np.linalg.cholesky(found.covariance)


@pytest.mark.skipif(not AVAILABLE, reason="needs Numba")
def test_compiled_means_and_jacobians_are_the_plain_ones_to_a_few_units_in_the_last_place(skill):
    """Of the sum of the terms' magnitudes: what cancels is lost either way."""
    queries = np.random.default_rng(3).normal(size=(20, skill.inputs.shape[1]))
    found, one = skill.mean(queries), skill.inner.query
    for query, mean in zip(queries, found, strict=True):
        row = one.row(query)
        size = (np.abs(row.kernel) @ np.abs(one.weights)).ravel() + 1
        assert np.all(np.abs(mean - one.mean(row)) <= 20 * np.spacing(size))
        slope, reach = one.jacobian(row), np.abs(row.offsets).max() + 1
        bound = 20 * np.spacing(4 * one.scale * reach * np.sum(size)) * one.stretch.max()
        assert np.all(np.abs(skill.jacobian(query) - slope) <= bound)
    if skill.kernel.channels == 1:
        assert np.array_equal(found, np.concatenate([skill.mean(query[None]) for query in queries]))


@pytest.mark.parametrize("how", [np.asfortranarray, np.float32, lambda s: s.astype(">f8"), lambda s: s.tolist()])
def test_a_query_may_come_as_any_array(how):
    one = primitive("one length", "dense", "fitted")
    s = np.random.default_rng(3).normal(size=(5, 3)).astype(np.float32).astype(np.float64)
    assert np.array_equal(one.mean(how(s)), one.mean(s))
    assert np.array_equal(one.jacobian(how(s)[0]), one.jacobian(s[0]))


def test_one_query_agrees_with_it_in_a_set(skill):
    s, v, a = moving(skill)
    found, together = skill.predict_motion(s, v, a), skill.predict([s, s])
    np.testing.assert_allclose(found.mean, together.mean[0], atol=1e-9)
    np.testing.assert_allclose(found.covariance, together.covariance[0], rtol=1e-6, atol=1e-9)


def test_the_jacobian_and_the_curvature_agree_with_finite_differences(skill):
    (s, v, _), h = moving(skill), 1e-5
    steps = h * np.eye(len(s))
    numeric = (skill.mean(s + steps) - skill.mean(s - steps)).T / (2 * h)
    np.testing.assert_allclose(skill.jacobian(s), numeric, rtol=1e-5, atol=1e-5)
    bend = (skill.jacobian(s + h * v) - skill.jacobian(s - h * v)) @ v / (2 * h)
    np.testing.assert_allclose(skill.curvature(s, v), bend, rtol=1e-5, atol=1e-4)


def test_velocity_and_acceleration_agree_with_finite_differences_along_the_motion(skill):
    (s, v, a), h = moving(skill), 1e-4
    behind, here, ahead = skill.mean([s + t * v + t * t / 2 * a for t in (-h, 0, h)])
    found = skill.predict_motion(s, v, a)
    np.testing.assert_allclose(found.velocity, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.acceleration, (ahead - 2 * here + behind) / h**2, rtol=1e-3, atol=1e-3)


def test_the_covariance_can_be_left_out_and_changes_nothing_else(skill):
    s, v, a = moving(skill)
    whole, found = skill.predict_motion(s, v, a), skill.predict_motion(s, v, a, covariance=False)
    assert found.covariance is None
    for name in ("mean", "velocity", "acceleration", "jacobian", "curvature"):
        assert np.array_equal(getattr(found, name), getattr(whole, name))


def test_what_one_query_touches_is_contiguous_and_read_only(skill):
    query = skill.inner.query
    for array in (query.centres, query.weights, query.weight_rows, query.stretch, query.prior_mean):
        assert array.flags.c_contiguous
        assert not array.flags.writeable


def test_numbers_too_large_to_square_are_still_finite():
    one = primitive("one length", "dense", "fitted")
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(one.mean([[1e200, 0, 0]]), [one.prior_mean])
