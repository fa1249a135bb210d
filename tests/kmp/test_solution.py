"""Properties of every solution, dense or low rank."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, named_arrays
from kmp.dense import Dense
from kmp.low_rank import LowRank
from kmp.low_rank.solution import Conditioned

S = np.random.default_rng(0).normal(size=(40, 2))
REFERENCE = Gaussians.of(np.sin(S), deviation=0.1)
VIA = S[:3] + 0.01, REFERENCE.take(slice(0, 3))
MANY = S[:38] + 0.01, REFERENCE.take(slice(0, 38))


def fitted(representation, via=None):
    model = KMP.fit(
        S, REFERENCE, kernel=GaussianKernel(0.05), lambda_mean=1.0, representation=representation
    )
    return model.adapt(*via, tolerance=0.1) if via else model


SOLUTIONS = {
    "dense": (fitted("dense"), Dense),
    "dense adapted": (fitted("dense", VIA), Dense),
    "low rank": (fitted("low_rank"), LowRank),
    "conditioned": (fitted("low_rank", VIA), Conditioned),
    "low rank, fitted anew": (fitted("low_rank", MANY), LowRank),
}


@pytest.fixture(params=SOLUTIONS)
def primitive(request):
    return SOLUTIONS[request.param][0]


def test_solution_is_stored_with_base(primitive):
    """Adapted solutions are stored with the arrays of their base."""
    stored = named_arrays.to_arrays(primitive)
    assert primitive.base.inner.solution.to_arrays().keys() <= stored.keys()
    assert primitive.representation == primitive.base.representation
    restored = named_arrays.from_arrays(stored)
    assert type(restored.inner.solution) is type(primitive.inner.solution)
    assert np.array_equal(restored.mean(S), primitive.mean(S))


@pytest.mark.parametrize("name", ["information", "features"])
def test_missing_array_is_named(name):
    """A missing array of the low-rank solution is named."""
    arrays = named_arrays.to_arrays(fitted("low_rank"))
    del arrays[name]
    with pytest.raises(
        ValueError, match=f"The primitive's arrays lack {name}. Needed are .*pivots"
    ):
        named_arrays.from_arrays(arrays)


def test_equal_pivots_are_refused():
    """Pivots that rounding cannot distinguish are refused."""
    arrays = named_arrays.to_arrays(fitted("low_rank"))
    pivots = arrays["pivots"].copy()
    pivots[-1] = pivots[0]
    says = rf"pivots: {len(pivots)} given, and rounding tells only {len(pivots) - 1} apart"
    with pytest.raises(ValueError, match=says):
        named_arrays.from_arrays(arrays | {"pivots": pivots})


def leaning(count):
    """Covariances that couple the outputs."""
    return np.tile([[0.01, 0.004], [0.004, 0.02]], (count, 1, 1))


def via(count, outputs):
    return Gaussians.of(np.ones((count, outputs)), deviation=0.03)


@pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")
@pytest.mark.parametrize("first", ["alike", "apart"])
def test_outputs_solved_as_one_change(first):
    """Adapting changes whether outputs are solved as one."""
    alike = np.tile(0.01 * np.eye(2), (3, 1, 1))
    tilted = leaning(3)
    mixed = Gaussians(REFERENCE.mean, np.concatenate([alike[:1].repeat(37, axis=0), tilted]))
    options = {"kernel": GaussianKernel(0.05), "lambda_mean": 1.0, "representation": "dense"}
    base = KMP.fit(S, REFERENCE if first == "alike" else mixed, **options)
    points = Gaussians(np.ones((3, 2)), tilted if first == "alike" else alike)
    # these replace the points with coupled outputs
    where = S[:3] + 0.01 if first == "alike" else S[37:]
    adapted = base.adapt(where, points, tolerance=0.0 if first == "alike" else 1e-6)
    assert (base.inner.solution.distinct, adapted.inner.solution.distinct) == (
        (1, 2) if first == "alike" else (2, 1)
    )
    anew = KMP.fit(adapted.inputs, adapted.reference, **options)
    # a small primitive whose points are replaced is fitted again
    assert (adapted.inner.solution.same > 0) == (first == "alike")
    np.testing.assert_allclose(adapted.mean(S), anew.mean(S), atol=1e-9)
    covariance, other = (
        x.predict(S).covariance / n
        for x, n in ((adapted, len(base.inputs)), (anew, len(anew.inputs)))
    )
    np.testing.assert_allclose(covariance, other, atol=1e-10)


def test_lost_point_is_refused_where_replaced():
    """A point that rounding hides is refused, also where it replaces an earlier one."""
    inputs = np.arange(40.0)[:, None]
    base = KMP.fit(
        inputs, REFERENCE, kernel=GaussianKernel(0.5), lambda_mean=1.0, representation="dense"
    )
    twice = Gaussians(np.zeros((2, 2)), np.tile(1e-18 * np.eye(2), (2, 1, 1)))
    with pytest.raises(ValueError, match="at point 39"):
        base.adapt([[3.0], [3.0]], twice, tolerance=0.1)
