"""The kernel: its axioms, and its derivatives against finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kmp import GaussianKernel, VelocityKernel

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
ells = st.floats(0.05, 10)


def test_the_kernel_is_the_formula():
    k = GaussianKernel(0.5)(np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([[1.0, 0.0]]))
    np.testing.assert_allclose(k, [[math.exp(-0.5)], [math.exp(-2)]])


@properties
@given(seeds, ells)
def test_the_kernel_is_one_at_home_symmetric_and_positive_semidefinite(seed, ell):
    s = np.random.default_rng(seed).normal(size=(12, 3))
    k = GaussianKernel(ell)(s, s)
    assert (np.diagonal(k) == 1).all()
    assert np.array_equal(k, k.T)
    assert np.linalg.eigvalsh(k)[0] > -1e-12


@properties
@given(seeds, ells)
def test_the_gradient_agrees_with_finite_differences(seed, ell):
    random, kernel, h = np.random.default_rng(seed), GaussianKernel(ell), 1e-6
    a, b = random.normal(size=(3, 2)), random.normal(size=(4, 2))
    gradient = kernel.gradient(a, b)
    assert gradient.shape == (3, 4, 2)
    for i, step in enumerate(h * np.eye(2)):
        np.testing.assert_allclose(gradient[:, :, i], (kernel(a + step, b) - kernel(a - step, b)) / (2 * h), atol=1e-7)


@properties
@given(seeds, ells)
def test_one_query_gives_what_many_give(seed, ell):
    random, kernel = np.random.default_rng(seed), GaussianKernel(ell)
    s, inputs = random.normal(size=2), random.normal(size=(5, 2))
    offsets = s - inputs
    np.testing.assert_allclose(kernel.value_at(offsets), kernel(s[None], inputs)[0], rtol=1e-12)
    np.testing.assert_allclose(kernel.slope_at(offsets)[:, None] * offsets, kernel.gradient(s[None], inputs)[0], rtol=1e-12, atol=1e-300)


@properties
@given(seeds, ells)
def test_the_curvature_agrees_with_finite_differences_of_the_gradient(seed, ell):
    random, kernel, h = np.random.default_rng(seed), GaussianKernel(ell), 1e-5
    s, v, inputs = random.normal(size=3), random.normal(size=3), random.normal(size=(5, 3))
    ahead, behind = (kernel.gradient((s + t * v)[None], inputs)[0] @ v for t in (h, -h))
    np.testing.assert_allclose(kernel.curvature_at(s - inputs, v), (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("ell", [0, -1, math.nan, math.inf])
def test_an_ell_that_is_not_above_zero_is_refused(ell):
    with pytest.raises(ValueError, match=f"ell is {ell:g}, and must be finite and above 0"):
        GaussianKernel(ell)


@properties
@given(seeds)
def test_an_ell_for_each_input_is_the_formula_and_equal_ones_are_the_one(seed):
    random, ell = np.random.default_rng(seed), np.array([0.5, 2.0, 0.1])
    a, b = random.normal(size=(3, 3)), random.normal(size=(4, 3))
    value = np.exp(-(ell * (a[:, None] - b[None]) ** 2).sum(axis=2))
    np.testing.assert_allclose(GaussianKernel(ell)(a, b), value, rtol=1e-12)
    np.testing.assert_allclose(GaussianKernel(np.full(3, 0.7))(a, b), GaussianKernel(0.7)(a, b), rtol=1e-12)


@properties
@given(seeds)
def test_an_ell_for_each_input_has_the_derivatives_of_finite_differences(seed):
    random, kernel, h = np.random.default_rng(seed), GaussianKernel([0.5, 2.0, 0.1]), 1e-5
    s, v, inputs, weights = (random.normal(size=n) for n in (3, 3, (5, 3), (5, 2)))
    mean = lambda s: kernel.value_at(s - inputs) @ weights  # noqa: E731
    slopes = lambda s: kernel.jacobian_of(s - inputs, weights.T)  # noqa: E731
    numeric = np.stack([(mean(s + step) - mean(s - step)) / (2 * h) for step in h * np.eye(3)], axis=1)
    np.testing.assert_allclose(slopes(s), numeric, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(slopes(s)[0], kernel.gradient(s[None], inputs)[0].T @ weights[:, 0], rtol=1e-9)
    bend = kernel.curvature_of(s - inputs, v, weights)
    np.testing.assert_allclose(bend, (slopes(s + h * v) - slopes(s - h * v)) @ v / (2 * h), rtol=1e-5, atol=1e-6)


def test_an_ell_for_each_input_goes_with_so_many_inputs_only():
    with pytest.raises(ValueError, match="ell: 2 values given, 1 or 3 needed for 3 inputs"):
        GaussianKernel([1.0, 2.0]).check(3, 1)
    with pytest.raises(ValueError, match=r"ell\[1\] is -1, and must be finite and above 0"):
        GaussianKernel([1.0, -1.0])
    assert GaussianKernel([1.0, 2.0]) == GaussianKernel(np.array([1.0, 2.0]))
    assert hash(GaussianKernel(1.0)) == hash(GaussianKernel(1))


@properties
@given(seeds, ells)
def test_the_velocity_kernel_is_the_kernel_with_its_derivatives_by_finite_differences(seed, ell):
    random, h = np.random.default_rng(seed), 1e-4
    k, plain = VelocityKernel(ell), GaussianKernel(ell)
    a, b = random.normal(size=(3, 1)), random.normal(size=(4, 1))
    blocks = k(a, b).reshape(3, 2, 4, 2)
    tolerance = {"rtol": 1e-4, "atol": 1e-5 * max(1, ell) ** 2}
    np.testing.assert_allclose(blocks[:, 0, :, 0], plain(a, b), rtol=1e-12)
    np.testing.assert_allclose(blocks[:, 1, :, 0], (plain(a + h, b) - plain(a - h, b)) / (2 * h), **tolerance)
    np.testing.assert_allclose(blocks[:, 0, :, 1], (plain(a, b + h) - plain(a, b - h)) / (2 * h), **tolerance)
    mixed = (plain(a + h, b + h) - plain(a + h, b - h) - plain(a - h, b + h) + plain(a - h, b - h)) / (4 * h * h)
    np.testing.assert_allclose(blocks[:, 1, :, 1], mixed, **tolerance)
    np.testing.assert_allclose(k(a[:1], a[:1]), k.own, atol=1e-12)
    assert np.linalg.eigvalsh(k(a, a))[0] > -1e-9
    np.testing.assert_array_equal(k.row_at(a[0] - b), k(a[:1], b))


@properties
@given(seeds)
def test_the_velocity_kernels_derivatives_are_those_of_finite_differences(seed):
    random, k, h = np.random.default_rng(seed), VelocityKernel(2.0), 1e-5
    t, inputs, weights = random.normal(size=1), random.normal(size=(4, 1)), random.normal(size=(8, 3))
    mean = lambda t: (k.row_at(t - inputs) @ weights).ravel()  # noqa: E731
    slope = lambda t: k.jacobian_of(t - inputs, weights.T)[:, 0]  # noqa: E731
    np.testing.assert_allclose(slope(t), (mean(t + h) - mean(t - h)) / (2 * h), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(mean(t)[3:], slope(t)[:3], rtol=1e-12, atol=1e-12)
    bend = k.curvature_of(t - inputs, np.array([2.0]), weights)
    np.testing.assert_allclose(bend, 4 * (slope(t + h) - slope(t - h)) / (2 * h), rtol=1e-5, atol=1e-5)


def test_the_velocity_kernel_takes_time_and_values_with_their_rates():
    for inputs, outputs in ((2, 4), (1, 3)):
        with pytest.raises(ValueError, match=f"{inputs} inputs and {outputs} outputs given; value and rate over time"):
            VelocityKernel(1.0).check(inputs, outputs)
