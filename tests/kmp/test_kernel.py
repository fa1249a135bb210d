"""The kernels: their axioms, and what one query asks of them against finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kmp import GaussianKernel, VelocityKernel

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
ells = st.floats(0.05, 10)


class Sum:
    """sum_r k(s, s_r) w_r and its derivatives, as one query makes them."""

    def __init__(self, kernel, centres, weights):
        self.kernel, self.weights = kernel, weights
        self.scale, self.stretch = kernel.coordinates(centres.shape[1])
        self.centres = centres * self.stretch

    def at(self, s):
        offsets = s * self.stretch - self.centres
        return offsets, self.kernel.values(offsets, self.scale), self.scale

    def value(self, s):
        return (self.kernel.row(*self.at(s)) @ self.weights).ravel()

    def jacobian(self, s):
        return self.kernel.jacobian(*self.at(s), self.weights.T) * self.stretch

    def curvature(self, s, v):
        return self.kernel.curvature(*self.at(s), self.weights, v * self.stretch)


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
@given(seeds, st.one_of(ells, st.just([0.5, 2.0, 0.1])))
def test_one_query_has_the_row_of_many_and_the_derivatives_of_finite_differences(seed, ell):
    random, kernel, h = np.random.default_rng(seed), GaussianKernel(ell), 1e-5
    s, v, centres, weights = (random.normal(size=n) for n in (3, 3, (5, 3), (5, 2)))
    expansion = Sum(kernel, centres, weights)
    np.testing.assert_allclose(kernel.row(*expansion.at(s)), kernel(s[None], centres)[0], rtol=1e-9)
    ahead, behind = (np.stack([expansion.value(s + step) for step in t * np.eye(3)], axis=1) for t in (h, -h))
    np.testing.assert_allclose(expansion.jacobian(s), (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-8)
    bend = (expansion.jacobian(s + h * v) - expansion.jacobian(s - h * v)) @ v / (2 * h)
    np.testing.assert_allclose(expansion.curvature(s, v), bend, rtol=1e-5, atol=1e-5)


@properties
@given(seeds)
def test_an_ell_for_each_input_is_the_formula_and_equal_ones_are_the_one(seed):
    random, ell = np.random.default_rng(seed), np.array([0.5, 2.0, 0.1])
    a, b = random.normal(size=(3, 3)), random.normal(size=(4, 3))
    value = np.exp(-(ell * (a[:, None] - b[None]) ** 2).sum(axis=2))
    np.testing.assert_allclose(GaussianKernel(ell)(a, b), value, rtol=1e-12)
    np.testing.assert_allclose(GaussianKernel(np.full(3, 0.7))(a, b), GaussianKernel(0.7)(a, b), rtol=1e-12)


def test_an_ell_for_each_input_goes_with_so_many_inputs_only():
    with pytest.raises(ValueError, match="ell: 2 values given, 1 or 3 needed for 3 inputs"):
        GaussianKernel([1.0, 2.0]).check(3, 1)
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
    mixed = plain(a + h, b + h) - plain(a + h, b - h) - plain(a - h, b + h) + plain(a - h, b - h)
    np.testing.assert_allclose(blocks[:, 1, :, 1], mixed / (4 * h * h), **tolerance)
    np.testing.assert_allclose(k(a[:1], a[:1]), k.prior_variance, atol=1e-12)
    assert np.linalg.eigvalsh(k(a, a))[0] > -1e-9
    np.testing.assert_array_equal(k.row(*Sum(k, b, np.zeros((8, 1))).at(a[0])), k(a[:1], b))


@properties
@given(seeds)
def test_the_velocity_kernels_derivatives_are_those_of_finite_differences(seed):
    random, h = np.random.default_rng(seed), 1e-5
    t, centres, weights = random.normal(size=1), random.normal(size=(4, 1)), random.normal(size=(8, 3))
    expansion = Sum(VelocityKernel(2.0), centres, weights)
    mean, slope = expansion.value, lambda t: expansion.jacobian(t)[:, 0]
    np.testing.assert_allclose(slope(t), (mean(t + h) - mean(t - h)) / (2 * h), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(mean(t)[3:], slope(t)[:3], rtol=1e-12, atol=1e-12)
    bend = expansion.curvature(t, np.array([2.0]))
    np.testing.assert_allclose(bend, 4 * (slope(t + h) - slope(t - h)) / (2 * h), rtol=1e-5, atol=1e-5)


def test_the_velocity_kernel_takes_time_and_values_with_their_rates():
    for inputs, outputs in ((2, 4), (1, 3)):
        with pytest.raises(ValueError, match=f"{inputs} inputs and {outputs} outputs given; value and rate over time"):
            VelocityKernel(1.0).check(inputs, outputs)
