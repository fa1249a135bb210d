"""Gaussian mixture of the demonstrations, and the reference by mixture regression.

P(s, xi) = sum_l pi_l N([s, xi]; mu_l, Sigma_l). The reference at s has the mean and the covariance
of P(xi | s). The paper, section II-A; Cohn, Ghahramani, Jordan 1996 for the regression.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp.arrays.checks import (
    Array,
    Seed,
    brief,
    check_finite,
    check_some,
    numbers,
    positive,
    seeded,
    whole,
)
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import symmetric
from kmp.gaussians import Gaussians, covariances

_TOLERANCE = 1e-5  # change of the mean log-likelihood [nat] at which EM stops
_ITERATIONS = 1000  # EM stops after this many steps
_CONSTANT = 1e-12  # a deviation of this share of the largest number is rounding
_NO_SAMPLES = 1e-15  # added to the number of samples of a component, which may be 0

_Parts: TypeAlias = tuple[Array, Array, Array]
"""Weights (K,), means (K, D) and covariances (K, D, D)."""


@dataclass(frozen=True, eq=False, repr=False)
class GaussianMixture(Immutable):
    """P(s, xi) = sum_l pi_l N(mu_l, Sigma_l), K components over I + O dimensions. Read-only.

    weights pi (K,), means mu (K, I+O) [unit], covariances Sigma (K, I+O, I+O) [unit^2]. Raises
    ValueError if the sum of the weights is not 1 or one is below 0, and as `Gaussians` does.
    """

    weights: Array
    means: Array
    covariances: Array

    def __repr__(self) -> str:
        return (
            f"GaussianMixture({len(self.weights)} components over {self.means.shape[1]} dimensions)"
        )

    def __post_init__(self) -> None:
        weights = numbers("weights", self.weights, "K")
        if not ((weights >= 0).all() and abs(weights.sum() - 1) < 1e-6):
            raise ValueError(
                f"weights: {brief(weights)} given; needed are numbers of sum 1, none below 0."
            )
        means = numbers("means", self.means, len(weights), "I+O")
        checked = covariances("covariances", self.covariances, *means.shape)
        self.__dict__.update(weights=weights, means=means, covariances=checked)

    @classmethod
    def fit(
        cls, samples: ArrayLike, *, components: int, seed: Seed = 0, regularization: float = 1e-6
    ) -> GaussianMixture:
        """The mixture that EM finds from a k-means start: samples (M, I+O), the inputs first.

        `regularization` [unit^2] is added to the diagonal of each covariance: 1e-6 is (1 mm)^2
        where the unit is the metre. `seed`, a whole number or a numpy Generator, is that of
        k-means. The same seed gives the same mixture, whatever the number of threads.

        Raises ValueError if the shape differs, a number is not finite, there are fewer samples than
        components, or a parameter is out of its range.
        """
        return mixture_of(samples, components=components, seed=seed, regularization=regularization)

    def regress(self, inputs: ArrayLike) -> Gaussians:
        """xi | s at each input (N, I): N normals, by Gaussian mixture regression.

        With the shares h_l = pi_l N(s; mu_l^s, Sigma_l^ss) / sum_j pi_j N(s; mu_j^s, Sigma_j^ss),
        the means m_l = mu_l^xi + Sigma_l^xis (Sigma_l^ss)^-1 (s - mu_l^s) and the covariances
        C_l = Sigma_l^xixi - Sigma_l^xis (Sigma_l^ss)^-1 Sigma_l^sxi of the components given s:
        mu = sum_l h_l m_l, Sigma = sum_l h_l (C_l + (m_l - mu)(m_l - mu)^T).

        Raises ValueError if the shape differs, a number is not finite, or no output remains.
        """
        s = numbers("inputs", inputs, "N", "I")
        i = self._checked_dimensions(s.shape[1])
        to_input = s[:, None, :] - self.means[:, :i]  # (N, K, I)
        share = _shares(self.weights, to_input.transpose(1, 2, 0), self.covariances[:, :i, :i])[0].T

        across = self.covariances[:, :i, i:]  # (K, I, O)
        gain = np.linalg.solve(self.covariances[:, :i, :i], across)  # (K, I, O)
        means = self.means[:, i:] + np.einsum("nki,kio->nko", to_input, gain)
        within = self.covariances[:, i:, i:] - across.transpose(0, 2, 1) @ gain  # (K, O, O)
        mean = np.einsum("nk,nko->no", share, means)
        offsets = means - mean[:, None, :]
        covariance = np.einsum("nk,kop->nop", share, within)
        covariance = covariance + np.einsum("nk,nko,nkp->nop", share, offsets, offsets)
        check_finite("inputs", mean, "far outside the mixture: its mean there")
        return Gaussians(mean, symmetric(covariance))

    def sample_inputs(self, count: int, *, dimensions: int, seed: Seed = 0) -> Array:
        """Inputs (count, I) of a reference, drawn from the marginal P(s), with I = `dimensions`.

        Raises ValueError if the count is below 1, or no output remains.
        """
        whole("count", count)
        i = self._checked_dimensions(whole("dimensions", dimensions, least=0))
        random = np.random.default_rng(seeded(seed))
        component = random.choice(
            len(self.weights), size=count, p=self.weights / self.weights.sum()
        )
        root = np.linalg.cholesky(self.covariances[:, :i, :i])[component]  # (count, I, I)
        drawn = self.means[component, :i] + (root @ random.standard_normal((count, i, 1)))[:, :, 0]
        return frozen(np.asarray(drawn))

    def _checked_dimensions(self, inputs: int) -> int:
        total = self.means.shape[1]
        if not 1 <= inputs < total:
            takes = f"this mixture of {total} dimensions in all takes 1 to {total - 1}"
            raise ValueError(f"inputs: {inputs} input dimensions given; {takes}.")
        return inputs


def mixture_of(
    samples: ArrayLike,
    *,
    components: int,
    seed: Seed,
    regularization: float,
    start: GaussianMixture | None = None,
) -> GaussianMixture:
    """`GaussianMixture.fit`, whose EM begins at `start` instead of k-means if that is given."""
    data = numbers("samples", samples, "M", "I+O")
    check_some("samples", data.T)
    added = positive("regularization", regularization)
    whole("components", components)
    seed = seeded(seed)
    if len(data) < components:
        shortage = f"{len(data)} samples given for {components} components"
        raise ValueError(f"{shortage}: give at least {components} samples, or fewer components.")
    # scikit-learn loads slowly, and predictions do not need it.
    from sklearn.cluster import KMeans

    try:
        # k-means sums its threads' results in the order in which they finish
        with one_thread():
            if start is None:
                k_means = KMeans(components, n_init=1, random_state=seed).fit(data)
                share = (k_means.labels_ == np.arange(components)[:, None]).astype(float)
                parts = _maximised(data, share, added)
            else:
                parts = start.weights, start.means, start.covariances
            weights, means, covariances = _likeliest(data, parts, added)
        return GaussianMixture(weights, means, symmetric(covariances))
    except ValueError:  # a covariance is not positive definite
        raise ValueError(
            f"samples: with regularization {added:g} no mixture of {components} components was "
            "found, as one of their covariances is singular. Give a larger regularization, or "
            "fewer components."
        ) from None


def deviations(columns: Array) -> Array:
    """The deviation of each column; 1 of one that never changes."""
    deviation = columns.std(axis=0)
    return np.where(varies(columns), deviation, 1.0)


def varies(columns: Array) -> NDArray[np.bool_]:
    """True for each column that changes, by more than rounding."""
    return np.asarray(columns.std(axis=0) > _CONSTANT * np.abs(columns).max(axis=0))


def one_thread() -> AbstractContextManager[Any]:
    """A context in which matrices and k-means are computed by one thread.

    More threads gain nothing on small matrices, and lose much where other programs compute.
    """
    return _thread_pools().limit(limits=1)  # type: ignore[no-any-return]


@cache
def _thread_pools() -> Any:
    # loaded first, so that its threads are found
    import sklearn.cluster  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _likeliest(data: Array, parts: _Parts, added: float) -> _Parts:
    """The weights, means and covariances to which EM converges from these, for data (M, D)."""
    log_likelihood = -np.inf
    for _ in range(_ITERATIONS):
        weights, means, covariances = parts
        share, log_density = _shares(weights, data.T - means[:, :, None], covariances)
        parts = _maximised(data, share, added)
        before = log_likelihood
        log_likelihood = log_density.mean()
        if abs(log_likelihood - before) < _TOLERANCE:
            break
    return parts


def _maximised(data: Array, share: Array, added: float) -> _Parts:
    """The M step: weights, means and covariances of data (M, D), of which each component has a
    share (K, M).
    """
    total = share.sum(axis=1) + _NO_SAMPLES
    means = share @ data / total[:, None]
    offsets = data.T - means[:, :, None]
    scatter = (share[:, None] * offsets) @ offsets.mT
    covariances = scatter / total[:, None, None] + added * np.eye(data.shape[1])
    return total / total.sum(), means, covariances


def _shares(weights: Array, offsets: Array, covariances: Array) -> tuple[Array, Array]:
    """Each component's share (K, M) of points, and the points' log densities (M,), plus a constant.

    The offsets (K, D, M) of the points are from the means.
    """
    root = np.linalg.cholesky(covariances)
    white = np.linalg.inv(root) @ offsets
    log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    with np.errstate(divide="ignore"):  # log 0 of a component of weight 0: its share is 0
        log_factor = np.log(weights) - 0.5 * log_det
    log_share = log_factor[:, None] - 0.5 * (white**2).sum(axis=1)
    largest = log_share.max(axis=0)
    share = np.exp(log_share - largest)
    total = share.sum(axis=0)
    return share / total, largest + np.log(total)
