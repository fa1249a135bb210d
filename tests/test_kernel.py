"""The kernel: its axioms, and its derivatives against finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kmp import GaussianKernel

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
