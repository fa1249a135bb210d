"""The kernels: their axioms, and their derivatives against finite differences."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from kmp import GaussianKernel, VelocityKernel

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)
ells = st.floats(0.05, 10)


@properties
@given(seeds, ells)
def test_kernel_is_symmetric_and_semidefinite(seed, ell):
    """The kernel is 1 at equal inputs, symmetric and positive semidefinite."""
    s = np.random.default_rng(seed).normal(size=(12, 3))
    k = GaussianKernel(ell)(s, s)
    assert (np.diagonal(k) == 1).all()
    assert np.array_equal(k, k.T)
    assert np.linalg.eigvalsh(k)[0] > -1e-12


@properties
@given(seeds)
def test_ell_for_each_input(seed):
    """One ell for each input gives the formula's kernel; equal ones give that of a single ell."""
    random = np.random.default_rng(seed)
    ell = np.array([0.5, 2.0, 0.1])
    a = random.normal(size=(3, 3))
    b = random.normal(size=(4, 3))
    value = np.exp(-(ell * (a[:, None] - b[None]) ** 2).sum(axis=2))
    np.testing.assert_allclose(GaussianKernel(ell)(a, b), value, rtol=1e-12)
    np.testing.assert_allclose(
        GaussianKernel(np.full(3, 0.7))(a, b), GaussianKernel(0.7)(a, b), rtol=1e-12
    )


@properties
@given(seeds, ells)
def test_velocity_kernel_has_derivatives(seed, ell):
    """The derivatives equal finite differences of the kernel."""
    random = np.random.default_rng(seed)
    h = 1e-4
    k = VelocityKernel(ell)
    plain = GaussianKernel(ell)
    a = random.normal(size=(3, 1))
    b = random.normal(size=(4, 1))
    blocks = k(a, b).reshape(3, 2, 4, 2)
    tolerance = {"rtol": 1e-4, "atol": 1e-5 * max(1, ell) ** 2}
    np.testing.assert_allclose(blocks[:, 0, :, 0], plain(a, b), rtol=1e-12)
    np.testing.assert_allclose(
        blocks[:, 1, :, 0], (plain(a + h, b) - plain(a - h, b)) / (2 * h), **tolerance
    )
    np.testing.assert_allclose(
        blocks[:, 0, :, 1], (plain(a, b + h) - plain(a, b - h)) / (2 * h), **tolerance
    )
    mixed = plain(a + h, b + h) - plain(a + h, b - h) - plain(a - h, b + h) + plain(a - h, b - h)
    np.testing.assert_allclose(blocks[:, 1, :, 1], mixed / (4 * h * h), **tolerance)
    np.testing.assert_allclose(k(a[:1], a[:1]), k.prior_variance, atol=1e-12)
    assert np.linalg.eigvalsh(k(a, a))[0] > -1e-9
