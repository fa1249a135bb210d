"""Properties of every solution, dense or low rank."""

import numpy as np
import pytest

from kmp import (
    KMP,
    AffineMean,
    GaussianKernel,
    Gaussians,
    LinearConstraints,
    PeriodicKernel,
    VelocityKernel,
    named_arrays,
)
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


# --- a primitive that grows by points ---


RANDOM = np.random.default_rng(0)


def points(dimensions, outputs, *, alike):
    inputs = RANDOM.uniform(0, 2, (60, dimensions))
    roots = 0.1 * RANDOM.normal(size=(60, outputs, outputs)) + 0.3 * np.eye(outputs)
    covariance = (
        np.tile(0.04 * np.eye(outputs), (60, 1, 1)) if alike else roots @ roots.transpose(0, 2, 1)
    )
    return inputs, Gaussians(np.sin(inputs @ RANDOM.normal(size=(dimensions, outputs))), covariance)


ALIKE_THEN_APART = points(2, 2, alike=False)
ALIKE_THEN_APART[1].covariance.setflags(write=True)
ALIKE_THEN_APART[1].covariance[:40] = 0.04 * np.eye(2)
CASES = {
    "two inputs": (
        points(2, 2, alike=False),
        {"kernel": GaussianKernel([2.0, 1.0]), "lambda_covariance": 3.0},
    ),
    "alike": (points(2, 3, alike=True), {"kernel": GaussianKernel(2.0)}),
    "alike, then apart": (
        ALIKE_THEN_APART,
        {"kernel": GaussianKernel(2.0), "lambda_covariance": 3.0},
    ),
    "velocity": (points(1, 4, alike=False), {"kernel": VelocityKernel(2.0)}),
    "periodic": (points(1, 2, alike=False), {"kernel": PeriodicKernel(2.0, 2.0)}),
    "affine": (
        points(2, 2, alike=False),
        {"kernel": GaussianKernel(2.0), "prior_mean": AffineMean(np.eye(2), np.ones(2))},
    ),
    "low rank": (
        points(2, 2, alike=False),
        {"kernel": GaussianKernel(0.5), "representation": "low_rank"},
    ),
}


def assert_same(one, other, queries):
    for a, b in zip(
        *((p.mean(queries), p.predict(queries).covariance) for p in (one, other)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        one.jacobians(queries), other.jacobians(queries), rtol=1e-9, atol=1e-8
    )


@pytest.mark.parametrize("case", CASES)
def test_extended_is_fit_of_all_points(case):
    """Via-points are kept."""
    (inputs, reference), options = CASES[case]
    options = {"lambda_mean": 0.7} | options
    whole = KMP.fit(inputs, reference, **options)
    first = KMP.fit(inputs[:40], reference[:40], **options)
    queries = np.random.default_rng(1).uniform(0, 2, (9, inputs.shape[1]))
    assert_same(first.extended(inputs[40:], reference[40:]), whole, queries)
    assert_same(
        first.extended(inputs[40:50], reference[40:50]).extended(inputs[50:], reference[50:]),
        whole,
        queries,
    )
    place = Gaussians(0 * reference.mean[:1], 0.5 * np.eye(reference.outputs)[None])
    via = inputs[3:4] + 1e-3, place
    adapted = first.adapt(*via, tolerance=0.01).extended(inputs[40:], reference[40:])
    expected = whole.adapt(*via, tolerance=0.01)
    assert np.array_equal(adapted.inner.changes.replaced, expected.inner.changes.replaced)
    assert_same(adapted, expected, queries)
    assert_same(
        adapted.adapt(queries[:1], place, tolerance=0.0),
        expected.adapt(queries[:1], place, tolerance=0.0),
        queries,
    )
    assert_same(adapted.base, whole, queries)
    assert_same(named_arrays.from_arrays(named_arrays.to_arrays(adapted)), adapted, queries)


def test_extended_keeps_constraints():
    """Derivatives are kept too."""
    (inputs, reference), options = CASES["two inputs"]
    directions = np.zeros((60, 2))
    directions[[5, 50]] = [1.0, 0.5]
    whole = KMP.fit(inputs, reference, directions=directions, lambda_mean=0.7, **options)
    first = KMP.fit(
        inputs[:40], reference[:40], directions=directions[:40], lambda_mean=0.7, **options
    )
    limits = LinearConstraints(
        inputs[:5], np.tile([0.0, 1.0], (5, 1)), whole.mean(inputs[:5])[:, 1] + 0.01
    )
    grown = first.constrained(limits).extended(
        inputs[40:], reference[40:], directions=directions[40:]
    )
    assert_same(grown, whole.constrained(limits), inputs[:9])
    with pytest.raises(ValueError, match="inputs: none given"):
        first.extended(inputs[:0], reference[:0])
