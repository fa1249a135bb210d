"""The estimator passes scikit-learn's own checks, and works in its pipelines and searches."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import SkipTestWarning
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from kmp.sklearn import KMPRegressor

RANDOM = np.random.default_rng(0)
X = RANDOM.uniform(-2, 2, size=(150, 2))
Y = np.stack([np.sin(2 * X[:, 0]) * X[:, 1], 100 + 50 * np.cos(X[:, 1])], axis=1)


@pytest.mark.parametrize("components", [None, 2])
def test_scikit_learns_own_checks_pass(components):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SkipTestWarning)  # some checks need other packages
        check_estimator(KMPRegressor(components=components))


def test_learns_any_unit_with_deviation():
    """The regressor learns outputs of any unit, with their uncertainty."""
    noisy = Y + [0.02, 1.0] * RANDOM.normal(size=Y.shape)
    regressor = KMPRegressor().fit(X[:120], noisy[:120])
    assert regressor.score(X[120:], Y[120:]) > 0.95
    mean, deviation = regressor.predict(np.array([X[0], [9.0, 9.0]]), return_std=True)
    assert mean.shape == deviation.shape == (2, 2)
    assert (deviation[1] > 3 * deviation[0]).all()
    np.testing.assert_allclose(mean[1], noisy[:120].mean(axis=0), rtol=1e-3, atol=1e-3)
    assert regressor.primitive_.jacobian(X[0]).shape == (2, 2)


@pytest.mark.parametrize("components", [None, 2])
@pytest.mark.parametrize("unit", [(1.0, 0.0), (1e9, 1e-3)])
def test_learns_constant_output_and_any_unit(components, unit):
    outputs = unit * np.sin(X[:, :1]) + [0.0, 0.1]
    regressor = KMPRegressor(ell=0.3, components=components).fit(X, outputs)
    mean, deviation = regressor.predict(X, return_std=True)
    assert np.isfinite(deviation).all()
    assert (np.abs(mean - outputs) <= 0.6 * np.maximum(unit, 1e-9)).all()


def test_works_in_pipelines_and_searches():
    pipeline = make_pipeline(StandardScaler(), KMPRegressor(ell=1.0))
    assert cross_val_score(pipeline, X, Y[:, 0], cv=3).min() > 0.9
    search = GridSearchCV(KMPRegressor(), {"ell": [0.001, 0.5], "noise": [0.05, 0.2]}, cv=3).fit(
        X, Y[:, 0]
    )
    assert search.best_params_["ell"] == 0.5
