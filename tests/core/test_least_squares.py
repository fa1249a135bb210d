"""Least squares under bounds and inequalities, as another solver has them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from service.core.arm.least_squares import keep_under, least_squares
from service.core.frame import Vector


@pytest.mark.parametrize("seed", range(30))
def test_least_squares_under_inequalities_are_those_of_another_solver(seed: int) -> None:
    random = np.random.default_rng(seed)
    tasks, wanted, posture = random.normal(size=(5, 7)), random.normal(size=5), 0.1 * random.normal(size=7)
    damping, count = 10 ** random.uniform(-4, -1), int(random.integers(1, 12))
    bounds = np.sort(random.normal(size=(2, 7)), axis=0) * 0.5
    bounds[0], bounds[1] = np.minimum(bounds[0], 0), np.maximum(bounds[1], 0)
    rows, limits = random.normal(size=(count, 7)), np.maximum(0.2 * random.normal(size=count), 0)
    if seed % 3 == 0 and count > 1:
        rows[1], limits[1] = 2 * rows[0], 2 * limits[0]  # said twice
    if seed % 5 == 0:
        limits[0] = 0.3 * rows[0] @ np.where(rows[0] > 0, bounds[0], bounds[1])  # it is to be left
        count = min(count, 3)
        rows, limits = rows[:count], limits[:count]
    found = np.empty(7)
    least_squares(tasks, wanted, posture, damping, bounds, found)
    before = found.copy()
    met = keep_under(tasks, wanted, posture, damping, bounds, rows, limits, found)
    assert met == bool((rows @ before > limits + 1e-9).any())
    assert (rows @ found <= limits + 1e-8).all()
    assert ((bounds[0] <= found) & (found <= bounds[1])).all()

    def cost(x: Vector) -> float:
        return float(np.sum((tasks @ x - wanted) ** 2) + damping * np.sum((x - posture) ** 2))

    best = minimize(
        cost,
        0.9 * found,
        bounds=list(zip(*bounds, strict=True)),
        constraints=[{"type": "ineq", "fun": lambda x: limits - rows @ x}],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert cost(found) <= best.fun + 1e-6


def test_between_two_things_that_cannot_both_be_left_the_way_along_them_is_free() -> None:
    tasks, wanted, bounds = np.eye(3), np.array([0.3, 0.1, 0.0]), np.tile([[-1.0], [1.0]], 3)
    rows, found = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), np.empty(3)
    least_squares(tasks, wanted, np.zeros(3), 1e-3, bounds, found)
    assert keep_under(tasks, wanted, np.zeros(3), 1e-3, bounds, rows, np.array([-0.02, -0.02]), found)
    np.testing.assert_allclose(found, [0.3, 0.0, 0.0], atol=1e-3)
