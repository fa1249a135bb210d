"""The primitive as a scikit-learn estimator: for pipelines, searches and cross-validation."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from kmp.arrays.checks import Array, brief, squared, whole
from kmp.gaussians import Gaussians
from kmp.mixture import GaussianMixture, deviations, varies
from kmp.primitive import KMP
from kmp.radial import GaussianKernel


class KMPRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A `KMP` of samples X (N, I) and y (N,) or (N, O), by scikit-learn's rules.

    `ell` [1 / (unit of X)^2] is one number, one for each input (I,), or "scale": 1 / (I x the
    variance of X). `noise` is the deviation of a sample of y over the deviation of y. With
    `components` None, each sample is a reference point of that noise; with a number, the reference
    is the regression of a mixture of that many components at each sample (the paper, section II-A),
    with the seed `random_state`. `lambda_mean` and `lambda_covariance` are those of `KMP.fit`. Far
    from the samples, the mean returns to the mean of y.

    Each output is standardised, so that none depends on the unit of another: its variance is its
    `prior_covariance`. After `fit`: the `KMP` as `primitive_`, and `n_features_in_`.
    """

    def __init__(
        self,
        *,
        ell: float | ArrayLike | str = "scale",
        lambda_mean: float = 1.0,
        lambda_covariance: float | None = None,
        noise: float = 0.1,
        components: int | None = None,
        random_state: int = 0,
    ) -> None:
        self.ell = ell
        self.lambda_mean = lambda_mean
        self.lambda_covariance = lambda_covariance
        self.noise = noise
        self.components = components
        self.random_state = random_state

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:  # noqa: N803
        """Fit the primitive to samples X (N, I) and y (N,) or (N, O).

        Raises ValueError as `KMP.fit` and scikit-learn's checks do.
        """
        inputs, outputs = validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64
        )
        self._one_output = outputs.ndim == 1
        outputs = np.asarray(outputs, dtype=np.float64).reshape(len(inputs), -1)
        mean = outputs.mean(axis=0)
        deviation = deviations(outputs)
        noise = squared("noise", self.noise) * np.diag(deviation**2)
        if self.components is None:
            reference = Gaussians(outputs, np.tile(noise, (len(inputs), 1, 1)))
        else:
            samples = np.hstack([inputs, (outputs - mean) / deviation])
            seed = whole("random_state", self.random_state, least=0, most=2**32 - 1)
            mixture = GaussianMixture.fit(samples, components=self.components, seed=seed)
            reference = mixture.regress(inputs).affine(np.diag(deviation), mean)
        self.primitive_ = KMP.fit(
            inputs,
            reference,
            kernel=GaussianKernel(self._ell(inputs)),
            lambda_mean=self.lambda_mean,
            lambda_covariance=self.lambda_covariance,
            prior_mean=mean,
            prior_covariance=deviation**2,
        )
        return self

    def predict(self, X: ArrayLike, return_std: bool = False) -> Any:  # noqa: N803
        """The mean at X (M, I), of y's shape (M,) or (M, O); with `return_std` also the deviations.

        Raises NotFittedError before `fit`, and ValueError as `KMP.predict` does.
        """
        check_is_fitted(self)
        inputs = validate_data(self, X, reset=False, dtype=np.float64)
        if not return_std:
            return self._shaped(self.primitive_.mean(inputs))
        prediction = self.primitive_.predict(inputs)
        deviations = np.sqrt(np.diagonal(prediction.covariance, axis1=1, axis2=2))
        return self._shaped(prediction.mean), self._shaped(deviations)

    def _shaped(self, outputs: Array) -> Array:
        return outputs[:, 0] if self._one_output else outputs

    def _ell(self, inputs: Array) -> Any:
        if not isinstance(self.ell, str):
            return self.ell
        if self.ell != "scale":
            raise ValueError(
                f'ell: {brief(self.ell)} given, a number, one for each input, or "scale" needed.'
            )
        columns = inputs.reshape(-1, 1)
        variance = float(inputs.var()) if varies(columns)[0] else 1.0
        return 1.0 / (inputs.shape[1] * variance)
