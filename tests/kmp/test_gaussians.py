"""Normal distributions as values: refusals, affine maps and products."""

import pickle
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kmp
from kmp import Gaussians

properties = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def some(count, outputs, seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(count, outputs, outputs))
    return Gaussians(
        random.normal(size=(count, outputs)), root @ root.swapaxes(1, 2) + 0.1 * np.eye(outputs)
    )


def test_the_package_exports_what_it_names():
    modules = {name for name, value in vars(kmp).items() if isinstance(value, ModuleType)}
    public = {name for name in vars(kmp) if not name.startswith("_")} - modules
    assert set(kmp.__all__) == public
    assert len(kmp.__all__) == len(public)


def test_the_arrays_are_read_only_copies():
    mean = np.zeros((2, 3))
    value = Gaussians(mean, np.tile(np.eye(3), (2, 1, 1)))
    mean[0, 0] = 9
    assert value.mean[0, 0] == 0
    for array in (
        value.mean,
        value.covariance,
        value.take(slice(1)).mean,
        pickle.loads(pickle.dumps(value)).covariance,
    ):
        assert not array.flags.writeable


@pytest.mark.parametrize(
    ("second", "says"),
    [
        (
            [[1, 0.5], [0.25, 1]],
            r"covariance\[1\] is not symmetric: .* by up to 0\.25\. Give \(C \+ C\^T\) / 2",
        ),
        (
            np.diag([1, -0.5]),
            r"covariance\[1\] is not positive definite: .* is -0\.5, .* Add a small variance",
        ),
        (
            np.zeros((2, 2)),
            r"covariance\[1\] is not positive definite: its smallest eigenvalue is 0,",
        ),
    ],
)
def test_invalid_covariance_is_refused(second, says):
    """A matrix that is no covariance is refused with its index and the remedy."""
    with pytest.raises(ValueError, match=says):
        Gaussians(np.zeros((2, 2)), [np.eye(2), second])


def test_any_sizes_of_outputs_are_allowed():
    """Correlations decide whether a covariance is positive definite."""
    sizes = np.array([1e9, 1.0, 1e-9])
    covariance = np.outer(sizes, sizes) * (np.eye(3) + 0.5)
    checked = Gaussians(np.zeros((1, 3)), covariance[None]).covariance[0]
    np.testing.assert_array_equal(checked, covariance)


@properties
@given(seeds)
def test_affine_map_and_inverse_cancel(seed):
    value = some(4, 3, seed)
    random = np.random.default_rng(seed)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    offset = random.normal(size=3)
    back = value.affine(rotation, offset).affine(rotation.T, -rotation.T @ offset)
    np.testing.assert_allclose(back.mean, value.mean, atol=1e-12)
    np.testing.assert_allclose(back.covariance, value.covariance, atol=1e-12)


@properties
@given(seeds)
def test_product_is_commutative_and_surer(seed):
    """A product does not depend on the order, and has less variance than its factors."""
    a = some(3, 2, seed)
    b = some(3, 2, seed + 1)
    c = some(3, 2, seed + 2)
    product = a.product(b, c)
    other = c.product(a).product(b)
    np.testing.assert_allclose(product.mean, other.mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(product.covariance, other.covariance, rtol=1e-7, atol=1e-9)
    assert (np.linalg.eigvalsh(a.covariance - product.covariance) > 0).all()
