"""A fold shares work among hyper-parameters, and predicts as a primitive with each of them."""

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians, VelocityKernel
from kmp.criteria.errors import preferred
from kmp.criteria.folds import Fold


def fold(dimensions, outputs, rates=False):
    random = np.random.default_rng(0)
    inputs, held = (random.uniform(0, 2, (n, dimensions)) for n in (60, 25))
    ways = random.normal(size=(dimensions, outputs))

    def shown(s):
        path = np.sin(2 * s @ ways)
        return np.hstack([path, 2 * np.cos(2 * s @ ways) * ways]) if rates else path

    mean = shown(inputs)
    roots = 0.1 * random.normal(size=(60, mean.shape[1], mean.shape[1])) + 0.2 * np.eye(
        mean.shape[1]
    )
    prior = np.full(mean.shape[1], 0.3)
    prior[outputs:] = 0
    return Fold(
        inputs,
        Gaussians(mean, roots @ roots.transpose(0, 2, 1)),
        prior,
        held,
        shown(held) + 0.1,
        0.0,
    )


CASES = [
    (fold(1, 3), GaussianKernel(3.0)),
    (fold(1, 2), GaussianKernel(900.0)),  # a kernel with too many features
    (fold(2, 2), GaussianKernel([3.0, 0.5])),
    (fold(1, 2, rates=True), VelocityKernel(2.0)),
    (fold(1, 1, rates=True), VelocityKernel(300.0)),
]


def fitted(fold, kernel, lambda_mean, lambda_covariance):
    return KMP.fit(
        fold.inputs,
        fold.reference,
        kernel=kernel,
        lambda_mean=lambda_mean,
        lambda_covariance=lambda_covariance,
        prior_mean=fold.prior_mean,
    )


@pytest.mark.parametrize(("held", "kernel"), CASES, ids=[str(i) for i in range(len(CASES))])
def test_errors_and_likelihoods_are_those_of_a_fit(held, kernel):
    outputs = held.held_outputs.shape[1] // kernel.channels
    penalties = [1e-2, 0.3, 10.0]
    rmses = held.rmses(kernel, penalties, outputs)
    likelihoods = held.negative_log_likelihoods(kernel, 0.3, penalties, outputs)
    for penalty, rmse, likelihood in zip(penalties, rmses, likelihoods, strict=True):
        miss = (fitted(held, kernel, penalty, None).mean(held.held_inputs) - held.held_outputs)[
            :, :outputs
        ]
        assert rmse == pytest.approx(np.sqrt((miss**2).sum(axis=1).mean()), rel=1e-7)
        prediction = fitted(held, kernel, 0.3, penalty).predict(held.held_inputs)
        residual = (held.held_outputs - prediction.mean)[:, :outputs]
        log_densities = []
        for r, covariance in zip(
            residual, prediction.covariance[:, :outputs, :outputs], strict=True
        ):
            log_det = np.linalg.slogdet(2 * np.pi * covariance)[1]
            log_densities.append(-0.5 * (log_det + r @ np.linalg.solve(covariance, r)))
        assert likelihood == pytest.approx(-np.mean(log_densities), rel=1e-6)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_what_rounding_hides_is_no_candidate(dimensions):
    held = fold(dimensions, 1)
    kernel = GaussianKernel(1.0)
    assert held.rmses(kernel, [1e-13, 1.0], 1)[0] == np.inf
    assert held.rmses(kernel, [1e-13, 1.0], 1)[1] < np.inf
    assert held.negative_log_likelihoods(kernel, 1.0, [1e-13], 1) == [np.inf]
    assert held.negative_log_likelihoods(kernel, 1e-13, [1.0], 1) == [np.inf]


def test_first_good_candidate_is_preferred():
    assert preferred("abc", [3.0, 1.1, 1.0], 1.2) == "b"
    with pytest.raises(ValueError, match="at least the least score, 1"):
        preferred("abc", [3.0, 1.1, 1.0], 0.9)
