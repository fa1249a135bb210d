"""A primitive that grows by points is the one that is fitted to all of them."""

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

RANDOM = np.random.default_rng(0)


def points(dimensions, outputs, *, alike):
    inputs = RANDOM.uniform(0, 2, (60, dimensions))
    roots = 0.1 * RANDOM.normal(size=(60, outputs, outputs)) + 0.3 * np.eye(outputs)
    covariance = np.tile(0.04 * np.eye(outputs), (60, 1, 1)) if alike else roots @ roots.transpose(0, 2, 1)
    return inputs, Gaussians(np.sin(inputs @ RANDOM.normal(size=(dimensions, outputs))), covariance)


ALIKE_THEN_APART = points(2, 2, alike=False)
ALIKE_THEN_APART[1].covariance.setflags(write=True)
ALIKE_THEN_APART[1].covariance[:40] = 0.04 * np.eye(2)
CASES = {
    "two inputs": (points(2, 2, alike=False), {"kernel": GaussianKernel([2.0, 1.0]), "lambda_covariance": 3.0}),
    "alike": (points(2, 3, alike=True), {"kernel": GaussianKernel(2.0)}),
    "alike, then apart": (ALIKE_THEN_APART, {"kernel": GaussianKernel(2.0), "lambda_covariance": 3.0}),
    "velocity": (points(1, 4, alike=False), {"kernel": VelocityKernel(2.0)}),
    "periodic": (points(1, 2, alike=False), {"kernel": PeriodicKernel(2.0, 2.0)}),
    "affine": (
        points(2, 2, alike=False),
        {"kernel": GaussianKernel(2.0), "prior_mean": AffineMean(np.eye(2), np.ones(2))},
    ),
    "low rank": (points(2, 2, alike=False), {"kernel": GaussianKernel(0.5), "representation": "low_rank"}),
}


def assert_same(one, other, queries):
    for a, b in zip(*((p.mean(queries), p.predict(queries).covariance) for p in (one, other)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.jacobians(queries), other.jacobians(queries), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_fit_of_all_points_and_keeps_its_via_points(case):
    (inputs, reference), options = CASES[case]
    options = {"lambda_mean": 0.7} | options
    whole = KMP.fit(inputs, reference, **options)
    first = KMP.fit(inputs[:40], reference[:40], **options)
    queries = np.random.default_rng(1).uniform(0, 2, (9, inputs.shape[1]))
    assert_same(first.extended(inputs[40:], reference[40:]), whole, queries)
    assert_same(first.extended(inputs[40:50], reference[40:50]).extended(inputs[50:], reference[50:]), whole, queries)
    place = Gaussians(0 * reference.mean[:1], 0.5 * np.eye(reference.outputs)[None])
    via = inputs[3:4] + 1e-3, place
    adapted = first.adapt(*via, tolerance=0.01).extended(inputs[40:], reference[40:])
    wanted = whole.adapt(*via, tolerance=0.01)
    assert np.array_equal(adapted.inner.changes.replaced, wanted.inner.changes.replaced)
    assert_same(adapted, wanted, queries)
    assert_same(
        adapted.adapt(queries[:1], place, tolerance=0.0), wanted.adapt(queries[:1], place, tolerance=0.0), queries
    )
    assert_same(adapted.base, whole, queries)
    assert_same(named_arrays.from_arrays(named_arrays.to_arrays(adapted)), adapted, queries)


def test_derivatives_and_constraints_go_with_it():
    (inputs, reference), options = CASES["two inputs"]
    directions = np.zeros((60, 2))
    directions[[5, 50]] = [1.0, 0.5]
    whole = KMP.fit(inputs, reference, directions=directions, lambda_mean=0.7, **options)
    first = KMP.fit(inputs[:40], reference[:40], directions=directions[:40], lambda_mean=0.7, **options)
    limits = LinearConstraints(inputs[:5], np.tile([0.0, 1.0], (5, 1)), whole.mean(inputs[:5])[:, 1] + 0.01)
    grown = first.constrained(limits).extended(inputs[40:], reference[40:], directions=directions[40:])
    assert_same(grown, whole.constrained(limits), inputs[:9])
    with pytest.raises(ValueError, match="inputs: none given"):
        first.extended(inputs[:0], reference[:0])
