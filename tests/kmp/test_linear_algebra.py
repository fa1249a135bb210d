"""Stacks of small matrices, and products with the inverse of a Cholesky factor."""

import numpy as np
import pytest

from kmp.arrays.inverse_cholesky import InverseCholeskyFactor
from kmp.arrays.linear_algebra import nearest_positive_semidefinite, symmetric


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("unit", [1.0, 2.0**-40])
def test_nearest_positive_semidefinite(count, unit):
    """A positive definite matrix is unchanged; any other one gets a Cholesky factor."""
    random = np.random.default_rng(0)
    root = random.normal(size=(count, 3, 3))
    good = symmetric(root @ root.swapaxes(1, 2) + np.eye(3)) * unit**2
    deviations = np.full(3, unit)
    assert np.array_equal(nearest_positive_semidefinite(good, deviations), good)
    values, vectors = np.linalg.eigh(good)
    bad = good.copy()
    bad[-1] = symmetric((vectors[-1] * [-0.5 * unit**2, *values[-1, 1:]]) @ vectors[-1].T)
    nearest = nearest_positive_semidefinite(bad, deviations)
    assert np.array_equal(nearest[:-1], good[:-1])
    np.linalg.cholesky(nearest)
    raised = (vectors[-1] * [0, *values[-1, 1:]]) @ vectors[-1].T
    np.testing.assert_allclose(nearest[-1], raised, atol=1e-12 * unit**2)


@pytest.mark.parametrize(("n", "copies"), [(1, 3), (3, 2), (21, 3), (40, 1)])
@pytest.mark.parametrize("channels", [1, 2])
def test_products_with_inverse_factor(n, copies, channels):
    """Products with the inverse factor are those of a solution."""
    random = np.random.default_rng(0)
    root = random.normal(size=(n * copies, n * copies))
    factor = np.asfortranarray(np.linalg.cholesky(root @ root.T + n * np.eye(n * copies)))
    x = random.normal(size=(n, 4 * channels))
    inverse = InverseCholeskyFactor.of(factor, copies)
    many = inverse.times(x, channels)
    for m, columns in enumerate(np.split(x, 4, axis=1)):
        expected = np.linalg.solve(factor, np.kron(columns, np.eye(copies)))
        np.testing.assert_allclose(many[m], expected, atol=1e-12)
