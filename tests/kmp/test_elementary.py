"""Elementary functions have the accuracy that their module states."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kmp.elementary import acos, atan2, exp, log, sin_cos, tanh

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("ours", "theirs", "arguments"),
    [
        (exp, math.exp, RANDOM.uniform(-700.0, 700.0, (500, 1))),
        (log, math.log, 10.0 ** RANDOM.uniform(-300.0, 300.0, (500, 1))),
        (lambda x: sin_cos(x)[0], math.sin, RANDOM.uniform(-1.5, 1.5, (500, 1))),
        (lambda x: sin_cos(x)[1], math.cos, RANDOM.uniform(-1.5, 1.5, (500, 1))),
        (atan2, math.atan2, RANDOM.normal(size=(500, 2))),
    ],
    ids=["exp", "log", "sin", "cos", "atan2"],
)
def test_errors_are_a_few_units_in_last_place(ours, theirs, arguments):
    for row in arguments.tolist():
        assert ours(*row) == pytest.approx(theirs(*row), rel=4 * 2.0**-52, abs=0.0)


@pytest.mark.parametrize(
    ("ours", "theirs"), [(tanh, math.tanh), (acos, math.acos)], ids=["tanh", "acos"]
)
def test_their_errors_are_below_1e_15(ours, theirs):
    for x in np.linspace(-1.0, 1.0, 501).tolist():
        assert ours(x) == pytest.approx(theirs(x), rel=0.0, abs=1e-15)


def test_values_at_ends():
    """Values at the ends of the ranges equal those of the true functions."""
    assert (exp(0.0), exp(-math.inf), exp(math.inf), log(1.0)) == (1.0, 0.0, math.inf, 0.0)
    assert math.isnan(exp(math.nan))
    assert [atan2(y, x) for y, x in ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0))] == [
        0.0,
        math.pi / 2,
        math.pi,
    ]
    for quarter in range(-8, 9):
        angle = quarter * math.pi / 2
        assert sin_cos(angle) == pytest.approx((math.sin(angle), math.cos(angle)), abs=1e-14)
