"""Linear inequality constraints: obeyed to 1e-9, at the least cost, and kept thereafter."""

import numpy as np
import pytest
from scipy.optimize import minimize

from kmp import KMP, GaussianKernel, Gaussians, LinearConstraints, VelocityKernel

T = np.linspace(0, 2, 50)[:, None]
PATH = np.hstack([np.sin(3 * T), np.cos(2 * T)])
REFERENCE = Gaussians.of(PATH, deviation=0.03)
WHERE = np.linspace(0, 2, 41)[:, None]
LOW = LinearConstraints(WHERE, np.tile([0.0, 1.0], (41, 1)), np.full(41, -0.2))  # output 1 >= -0.2
SIDE = LinearConstraints(WHERE, np.tile([-2.0, 0.5], (41, 1)), np.full(41, -1.6))


def base(representation="dense", **options):
    options = {"kernel": GaussianKernel(5.0), "lambda_mean": 1.0} | options
    return KMP.fit(T, REFERENCE, representation=representation, **options)


def many():
    inputs = np.linspace(0, 2, 3001)[:, None]
    reference = Gaussians.of(np.hstack([np.sin(3 * inputs), np.cos(2 * inputs)]), deviation=0.03)
    return KMP.fit(inputs, reference, kernel=GaussianKernel(5.0), lambda_mean=1.0)


def violation(skill, constraints=LOW):
    slack = (skill.mean(constraints.inputs) * constraints.normals).sum(axis=1) - constraints.bounds
    return max(-slack.min(), 0.0)


def test_constraints_are_obeyed():
    """The unconstrained mean violates them."""
    assert violation(base()) > 0.3
    skill = base().constrained(LOW)
    assert violation(skill) < 1e-9
    alone = np.array([skill.mean(s[None])[0] for s in WHERE])
    assert alone[:, 1].min() > -0.2 - 1e-9
    confined = skill.constrained(SIDE)
    assert violation(confined) < 1e-9
    assert violation(confined, SIDE) < 1e-9
    for queries in (T, T[9:10]):
        np.testing.assert_allclose(
            skill.predict(queries).covariance, base().predict(queries).covariance, atol=1e-12
        )


def test_constraint_is_no_data():
    """Beyond the data, a constraint does not make a skill more certain."""
    far = LinearConstraints([[4.0]], [[1.0, 0.0]], [2.0])
    expected = base().uncertainty([4.0]).distance
    np.testing.assert_allclose(base().constrained(far).uncertainty([4.0]).distance, expected)


def test_mean_has_least_cost():
    """The mean has the least cost among those that satisfy the constraints."""
    few = LinearConstraints(WHERE[::5], np.tile([0.0, 1.0], (9, 1)), np.full(9, -0.2))
    t = T[::4]
    path = PATH[::4]
    reference = Gaussians(path, np.tile(0.05 * np.eye(2), (len(t), 1, 1)))
    skill = KMP.fit(t, reference, kernel=GaussianKernel(5.0), lambda_mean=1.0).constrained(few)
    points = np.concatenate([t, few.inputs + 1e-9])
    k = skill.kernel(points, points) + 1e-10 * np.eye(len(points))

    def cost(w):
        f = k @ w
        return ((f[: len(t)] - path[:, 1]) ** 2).sum() / 0.05 / 2 + w @ k @ w / 2

    def slope(w):
        return k[: len(t)].T @ (k[: len(t)] @ w - path[:, 1]) / 0.05 + k @ w

    obeyed = {
        "type": "ineq",
        "fun": lambda w: (k @ w)[len(t) :] + 0.2,
        "jac": lambda w: k[len(t) :],
    }
    start = np.zeros(len(points))
    optimum = minimize(
        cost, start, jac=slope, constraints=[obeyed], method="SLSQP", options={"maxiter": 500}
    )
    np.testing.assert_allclose(skill.mean(points)[:, 1], k @ optimum.x, atol=2e-3)
    found_by_us = np.linalg.solve(k, skill.mean(points)[:, 1])
    assert cost(found_by_us) <= cost(optimum.x) * (1 + 1e-3)


def test_speed_and_rates_can_be_limited():
    """Limits apply to the speed of values, and to rates among the outputs."""
    slow = LinearConstraints(
        WHERE, np.tile([-1.0, 0.0], (41, 1)), np.full(41, -1.5), np.ones((41, 1))
    )
    skill = base().constrained(slow)
    assert base().jacobians(WHERE)[:, 0, 0].max() > 2.9
    assert skill.jacobians(WHERE)[:, 0, 0].max() < 1.5 + 1e-9
    rates = Gaussians.of(np.hstack([PATH[:, :1], 3 * np.cos(3 * T)]), deviation=0.03)
    primitive = KMP.fit(T, rates, kernel=VelocityKernel(5.0), lambda_mean=1.0)
    limits = LinearConstraints(WHERE, np.tile([0.0, -1.0], (41, 1)), np.full(41, -2.0))
    assert violation(primitive, limits) > 0.9
    assert violation(primitive.constrained(limits), limits) < 1e-9


def test_via_points_and_constraints_in_any_order():
    """Via-points and constraints are met together, in any order."""
    via = Gaussians.of([[0.5, 0.1]], deviation=1e-4)
    first = base().constrained(LOW).adapt([[1.3]], via, tolerance=0.03)
    second = base().adapt([[1.3]], via, tolerance=0.03).constrained(LOW)
    for skill in (first, second):
        np.testing.assert_allclose(skill.mean([[1.3]]), via.mean, atol=1e-4)
        assert violation(skill) < 1e-9
    np.testing.assert_allclose(first.mean(T), second.mean(T), atol=1e-9)
    assert violation(first.base) > 0.3
    moved = second.refitted(Gaussians(PATH - 0.1, REFERENCE.covariance))
    assert violation(moved) < 1e-9


def test_low_rank_is_solved_anew():
    """The new solution is dense."""
    via = [[0.1]], Gaussians.of([0.3, 0.9], deviation=0.01)
    dense, low = (
        base(representation).adapt(*via, tolerance=0) for representation in ("dense", "low_rank")
    )
    assert low.representation == "low_rank"
    constrained = low.constrained(LOW)
    assert violation(constrained) < 1e-9
    np.testing.assert_allclose(constrained.mean(T), dense.constrained(LOW).mean(T), atol=1e-9)
    assert np.array_equal(constrained.via_inputs, low.via_inputs)


CONTRADICTION = LinearConstraints([[1.0], [1.0]], [[0, 1], [0, -1]], [0.5, 0.5])


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (
            lambda: base().constrained(CONTRADICTION),
            r"The constraints cannot be met together: \d is missed by",
        ),
        (
            lambda: many().constrained(LOW),
            "low rank primitive of 6002 numbers given, at most 6000 or the dense",
        ),
        (
            lambda: base().constrained(LinearConstraints([[1.0]], [[1.0]], [0.0])),
            "1 outputs given, 2 needed",
        ),
        (
            lambda: base().constrained(LinearConstraints([[1.0, 2.0]], [[1.0, 0]], [0.0])),
            "2 inputs given, 1 needed",
        ),
        (
            lambda: LinearConstraints([[1.0]], [[0.0, 0.0]], [0.0]),
            r"normals\[0\] is 0, and must have a direction",
        ),
    ],
)
def test_impossible_constraints_are_refused(call, says):
    """Constraints that cannot be satisfied are refused, with a feasible alternative."""
    with pytest.raises(ValueError, match=says):
        call()
