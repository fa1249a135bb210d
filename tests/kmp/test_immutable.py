"""Values stay as they are: read-only arrays, in copies and after pickling too."""

import copy
import pickle
import re

import numpy as np
import pytest

import kmp
from kmp import (
    KMP,
    CoordinateFrame,
    Correlation,
    GaussianKernel,
    GaussianMixture,
    Gaussians,
    LocalKMP,
    OrientationKMP,
    VelocityKernel,
)
from kmp.arrays.immutable import Immutable
from kmp.compiled import AVAILABLE

T = np.linspace(0, 1, 12)[:, None]
REFERENCE = Gaussians(np.hstack([np.sin(T), np.cos(T), T]), np.tile(0.1 * np.eye(3), (12, 1, 1)))


def primitive(representation, kernel=None, reference=REFERENCE):
    kernel = kernel or GaussianKernel(2.0)
    fitted = KMP.fit(T, reference, kernel=kernel, lambda_mean=1.0, lambda_covariance=2.0, representation=representation)
    adapted = fitted.adapt([[0.3]], reference.take(slice(0, 1)), tolerance=0.0)
    for one in (fitted, adapted):
        one.predict(T), one.predict(T[:1]), one.uncertainty(T), one.jacobian(T[0]), one.inputs, one.error_bound
    return adapted


def values():
    value_and_rate = REFERENCE.affine(np.eye(3)[:2], np.zeros(2))
    dense = primitive("dense")
    frame = CoordinateFrame(np.eye(3), np.zeros(3))
    demonstrations = [(T, np.hstack([T, T**2]) + 0.01 * n) for n in range(2)]
    correlation = Correlation.neutral(T[:3], width=0.3, outputs=3)
    velocity = VelocityKernel(2.0)
    velocity.prior_variance  # noqa: B018
    yield from (REFERENCE, GaussianKernel([1.0, 2.0]), velocity, frame, correlation)
    yield GaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)])
    yield from (
        dense,
        primitive("low_rank"),
        primitive("dense", velocity, value_and_rate),
        primitive("low_rank", velocity, value_and_rate),
    )
    yield from (LocalKMP((dense,), (frame,)), OrientationKMP(dense, [0, 0, 0, 1]), dense.uncertainty(T))
    yield kmp.learn(demonstrations, components=1, seed=0, count=5)
    options = {"correlation": correlation, "exploration": 0.1, "updates": 1, "rollouts": 2, "seed": 0}
    yield kmp.improve(dense, lambda path: 1.0, T, **options)


def arrays(value):
    """All arrays in a value, however deep."""
    if isinstance(value, np.ndarray):
        return [value]
    parts = value if isinstance(value, tuple) else list(vars(value).values()) if isinstance(value, Immutable) else []
    return [array for part in parts for array in arrays(part)]


@pytest.mark.parametrize("value", list(values()), ids=lambda value: type(value).__name__)
def test_every_array_is_read_only_before_and_after_a_pickle_or_a_copy(value):
    assert isinstance(value, Immutable)
    for one in (value, pickle.loads(pickle.dumps(value)), copy.copy(value), copy.deepcopy(value)):
        assert arrays(one)
        assert [array.shape for array in arrays(one) if array.flags.writeable] == []


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
def test_a_pickle_leaves_out_the_factors_and_the_copy_makes_them_again(representation):
    one = primitive(representation)
    again = pickle.loads(pickle.dumps(one))
    dropped = {"mean_factor", "covariance_factor"}
    assert dropped & vars(one.base.inner.solution).keys()
    assert not dropped & vars(again.base.inner.solution).keys()
    more = ([[0.7]], REFERENCE.take(slice(3, 4)))
    assert np.array_equal(again.adapt(*more, tolerance=0.0).mean(T), one.adapt(*more, tolerance=0.0).mean(T))


EARLIER = {  # the module of each class in pickles of earlier versions, where it has moved since
    "Inner": "inner",
    "Database": "database",
    "Changes": "database",
    "Hyperparameters": "hyperparameters",
    "AffineMean": "affine_mean",
    "CompiledQuery": "compiled_query",
    "InverseCholeskyFactor": "inverse_cholesky",
    "GaussianMixture": "gmm",
    "Correlation": "correlation",
    "LocalKMP": "references",
}


def test_a_pickle_of_an_earlier_version_loads():
    one = primitive("dense").adapt([[0.5]], REFERENCE[:1], tolerance=0.1)
    one.predict(T), one.predict(T[:1])  # both cache what a pickle then holds
    text = pickle.dumps((one, kmp.AffineMean([[1.0]], [0.0]), GaussianMixture, Correlation, LocalKMP), protocol=0)
    found = set()
    for name, module in EARLIER.items():
        text, count = re.subn(rf"ckmp\.[\w.]+\n{name}\n".encode(), f"ckmp.{module}\n{name}\n".encode(), text)
        found |= {name} if count else set()
    assert found == EARLIER.keys() - (set() if AVAILABLE else {"CompiledQuery"})
    again, *others = pickle.loads(text)
    assert np.array_equal(again.predict(T).covariance, one.predict(T).covariance)
    assert others[1:] == [GaussianMixture, Correlation, LocalKMP]
