"""Alternative goals at once, and the derivative of the mean by a goal."""

from __future__ import annotations

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, LinearConstraints, VelocityKernel

pytestmark = pytest.mark.filterwarnings("ignore::kmp.ViaPointMissed")  # goals are far away

INPUTS = np.linspace(0.0, 2.0, 60)[:, None]
QUERIES = np.linspace(0.1, 1.9, 17)[:, None]


def primitive(representation="dense", *, rates=False, shape="full"):
    random = np.random.default_rng(3)
    mean = np.hstack([np.sin(3 * INPUTS), np.cos(2 * INPUTS)])
    if rates:
        mean = np.hstack([mean, 3 * np.cos(3 * INPUTS), -2 * np.sin(2 * INPUTS)])
    roots = 0.05 * random.normal(size=(len(mean), mean.shape[1], mean.shape[1]))
    covariance = roots @ roots.mT + 1e-2 * np.eye(mean.shape[1])
    if shape == "isotropic":
        covariance = np.tile(0.01 * np.eye(mean.shape[1]), (len(mean), 1, 1))
    kernel = VelocityKernel(6.0) if rates else GaussianKernel(6.0)
    return KMP.fit(
        INPUTS,
        Gaussians(mean, covariance),
        kernel=kernel,
        lambda_mean=1.0,
        representation=representation,
    )


def goals(of, inputs, deviation=0.01):
    random = np.random.default_rng(5)
    return [
        (via, Gaussians.of(random.normal(size=(len(via), of.outputs)), deviation=deviation))
        for via in inputs
    ]


SAME = [[[0.5], [1.21]]] * 6
OTHER = np.random.default_rng(8).uniform(0.0, 2.0, (9, 2, 1))


@pytest.mark.parametrize("inputs", [SAME, OTHER, [[[0.5]], [[0.5], [1.2]]]])
@pytest.mark.parametrize("tolerance", [0.0, None])
@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("kind", ["full", "isotropic", "rates", "taught", "prior"])
def test_means_of_alternatives_are_those_of_each(inputs, tolerance, representation, kind):
    of = primitive(
        representation,
        rates=kind == "rates",
        shape="isotropic" if kind == "isotropic" else "full",
    )
    if kind == "taught":
        of = of.adapt([[1.0]], Gaussians.of([0.5, 0.5], deviation=0.01))
    if kind == "prior":
        of = KMP.fit(
            INPUTS,
            of.reference,
            kernel=GaussianKernel(6.0),
            lambda_mean=1.0,
            prior_covariance=[1.0, 4.0],
            representation=representation,
        )
    alternatives = of.adapt_many(goals(of, inputs), tolerance=tolerance)
    assert len(alternatives) == len(inputs)
    expected = [each.mean(QUERIES) for each in alternatives]
    np.testing.assert_allclose(alternatives.mean(QUERIES), expected, atol=1e-8)
    for each, (via, desired) in zip(alternatives[1:], goals(of, inputs)[1:], strict=True):
        np.testing.assert_array_equal(
            each.mean(QUERIES), of.adapt(via, desired, tolerance=tolerance).mean(QUERIES)
        )


def test_goal_jacobian_is_that_of_any_goal():
    of = primitive()
    via = [[0.5], [1.21]]
    (_, one), (_, other) = goals(of, [via, via])
    adapted, moved = (of.adapt(via, goal, tolerance=0.0) for goal in (one, other))
    jacobian = adapted.goal_jacobian(QUERIES)
    assert jacobian.shape == (len(QUERIES), 2, 2, 2)
    predicted = adapted.mean(QUERIES) + np.einsum("movp,vp->mo", jacobian, other.mean - one.mean)
    np.testing.assert_allclose(moved.mean(QUERIES), predicted, atol=1e-10)
    assert of.goal_jacobian(QUERIES).shape == (len(QUERIES), 2, 0, 2)


@pytest.mark.parametrize("representation", ["dense", "low_rank"])
@pytest.mark.parametrize("apart", [0.0, 0.3])
def test_exact_goals_near_each_other(representation, apart):
    of = primitive(representation)
    alternatives = of.adapt_many(
        [
            ([[0.5 + n * apart], [0.501]], Gaussians.of(np.full((2, 2), float(n)), deviation=0))
            for n in range(3)
        ]
    )
    expected = [each.mean(QUERIES) for each in alternatives]
    np.testing.assert_allclose(alternatives.mean(QUERIES), expected, atol=1e-7)


def test_goals_without_via_points_or_lost_in_rounding():
    adapted = primitive().adapt([[1.0]], Gaussians.of([0.5, 0.5], deviation=0.01))
    nothing = np.empty((0, 1)), Gaussians.of(np.empty((0, 2)), deviation=0.1)
    means = adapted.adapt_many([nothing, nothing]).mean(QUERIES)
    np.testing.assert_allclose(means, [adapted.mean(QUERIES)] * 2, atol=1e-12)
    low_rank = KMP.fit(
        INPUTS,
        adapted.base.reference,
        kernel=GaussianKernel(6.0),
        lambda_mean=1e-4,
        lambda_covariance=1.0,
        representation="low_rank",
    )
    for of, deviation in ((adapted, 1e-9), (adapted.base, 1e-9), (low_rank, 1e-4)):
        lost = of.adapt_many(goals(of, OTHER, deviation=deviation))
        with pytest.raises(ValueError, match="would be lost in rounding"):
            lost.mean(QUERIES)


@pytest.mark.parametrize("size", [1e-9, 1e9])
def test_goal_jacobian_of_any_unit(size):
    def jacobian(unit):
        skill = KMP.fit(
            INPUTS,
            Gaussians.of(unit * np.sin(3 * INPUTS), deviation=0.1 * unit),
            kernel=GaussianKernel(6.0),
            lambda_mean=1.0,
            prior_covariance=[unit**2],
        )
        return skill.adapt([0.5], Gaussians.of([unit], deviation=0)).goal_jacobian(QUERIES)

    np.testing.assert_allclose(jacobian(size), jacobian(1.0), atol=1e-10)


def test_goal_jacobian_with_constraints_is_refused():
    bound = LinearConstraints([[1.0]], [[1.0, 0.0]], [0.5])
    with pytest.raises(ValueError, match="goal_jacobian: a primitive with constraints"):
        primitive().constrained(bound).goal_jacobian(QUERIES)


def test_goals_where_rounding_nearly_hides_the_covariance():
    mean = np.hstack([np.sin(3 * INPUTS), np.cos(2 * INPUTS)])
    reference = Gaussians.of(mean, deviation=1e-4)
    of = KMP.fit(INPUTS, reference, kernel=GaussianKernel(8.0), lambda_mean=1.0)
    alternatives = of.adapt_many(
        [
            ([[t]], Gaussians.of(of.mean([[t]]) + 0.1, deviation=1e-3))
            for t in (0.12, 0.51, 0.93, 1.27, 1.75)
        ],
        tolerance=0.0,
    )
    expected = [each.mean(QUERIES) for each in alternatives]
    np.testing.assert_allclose(alternatives.mean(QUERIES), expected, atol=1e-8)
