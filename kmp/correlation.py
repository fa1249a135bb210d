"""Correlation-adaptive imitation: covariances between outputs, learned from a reward.

The paper, section II-D: the reference's covariances become Lambda(s)^T Sigma Lambda(s), equation
(11). The diagonal Lambda(s) is found from rollouts, as in section III-B; the caller gives the
reward. Positive factors keep the correlation coefficients and change the variances; a negative
factor changes the signs of its output's correlations.

The search is PI^BB (Stulp and Sigaud 2012, "Policy improvement methods: between black-box
optimization and episodic reinforcement learning"): policy improvement with path integrals (PI^2,
Theodorou, Buchli, Schaal 2010) with noise that is constant over a rollout, and its total reward.
PI^2 weighs each time step by the reward that follows; here each Lambda(s_n) moves the whole
trajectory, so that there is no such order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from kmp.arrays.checks import (
    Array,
    Seed,
    check_kind,
    check_shape,
    numbers,
    positive,
    real,
    seeded,
    squared,
    whole,
)
from kmp.arrays.immutable import Immutable, frozen
from kmp.gaussians import Gaussians
from kmp.primitive import KMP, checked_primitive

Reward = Callable[[Array], float]
"""The reward of a predicted trajectory (M, O); higher is better."""

_SHARPNESS = 10.0  # h in the weights exp(h (R - max R) / (max R - min R)), as usual for PI^2
_LEAST_FACTOR = 0.05  # a deviation is scaled by at least this factor


@dataclass(frozen=True, eq=False, repr=False)
class Correlation(Immutable):
    """Lambda(s) = phi(s)^T theta, with B normalised Gaussian basis functions. Read-only.

    centres (B, I) and width [unit of the inputs] of the basis functions; theta (B, O), a factor for
    each output, of either sign. Lambda = 1 leaves the covariances as they are. Raises ValueError if
    shapes do not agree, a number is not finite, or the width is not above 0.
    """

    centres: Array
    width: float
    theta: Array

    def __post_init__(self) -> None:
        centres = numbers("centres", self.centres, "B", "I")
        width = positive("width", self.width)
        self.__dict__.update(
            centres=centres, width=width, theta=numbers("theta", self.theta, len(centres), "O")
        )

    @classmethod
    def neutral(cls, centres: ArrayLike, *, width: float, outputs: int) -> Correlation:
        """Lambda = 1 everywhere, for O = `outputs`. Raises ValueError as the constructor does."""
        places = numbers("centres", centres, "B", "I")
        return cls(places, width, np.ones((len(places), whole("outputs", outputs))))

    def __call__(self, inputs: ArrayLike) -> Array:
        """The diagonals of Lambda at inputs (N, I): (N, O).

        Raises ValueError if the shape differs or a number is not finite.
        """
        s = numbers("inputs", inputs, "N", self.centres.shape[1])
        exponent = -0.5 * cdist(s, self.centres, "sqeuclidean") / self.width**2
        phi = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        share = phi / phi.sum(axis=1, keepdims=True)
        return np.asarray(share @ self.theta)

    def applied(self, primitive: KMP) -> KMP:
        """The primitive of the cost (11): the base's covariances changed, the via-points kept.

        Lambda^T Sigma Lambda is singular if a factor is 0. So each deviation is at least 0.05 times
        the original: the difference is added to the variance only, and the correlations fall to 0
        with the factor, before their signs change.

        Raises ValueError if the numbers of inputs or outputs differ.
        """
        base = checked_primitive(primitive).base
        if (outputs := self.theta.shape[1]) != base.outputs:
            raise ValueError(f"correlation: {outputs} outputs given, {base.outputs} needed.")
        scale = self(base.inputs)
        sigma = base.reference.covariance
        variances = np.diagonal(sigma, axis1=1, axis2=2)
        lacking = np.maximum(_LEAST_FACTOR**2 - scale**2, 0.0) * variances
        covariance = scale[:, :, None] * sigma * scale[:, None, :] + lacking[:, :, None] * np.eye(
            base.outputs
        )
        return primitive.refitted(Gaussians(base.reference.mean, covariance))


@dataclass(frozen=True, eq=False, repr=False)
class Improvement(Immutable):
    """The result of `improve`."""

    correlation: Correlation
    """The Lambda of the highest reward, of all that were evaluated."""
    primitive: KMP
    """The primitive with it."""
    rewards: Array
    """(U + 1,) the reward without exploration, before the first update and after each."""


def improve(
    primitive: KMP,
    reward: Reward,
    queries: ArrayLike,
    *,
    correlation: Correlation,
    exploration: float,
    updates: int,
    rollouts: int,
    seed: Seed = 0,
) -> Improvement:
    """The Lambda(s) of equation (11) that raises the reward of the trajectory at `queries` (M, I).

    PI^BB: each update draws `rollouts` theta + epsilon, epsilon of standard deviation
    `exploration`, the same in each update (constant exploration); fits and adapts the primitive
    with each; and moves theta by the mean of the epsilons, weighted with exp(h (R - max R) / (max R
    - min R)), h = 10. The via-points of the primitive are kept. The paper, section III-B.

    Raises ValueError if shapes do not agree, a parameter is out of its range, or a reward is not
    finite.
    """
    s = numbers("queries", queries, "M", checked_primitive(primitive).inputs.shape[1])
    check_kind(
        "correlation",
        correlation,
        Correlation,
        "Correlation.neutral(centres, width=..., outputs=...)",
    )
    squared("exploration", exploration)
    if whole("rollouts", rollouts, least=0) < 2 or whole("updates", updates, least=0) < 1:
        raise ValueError(
            f"{rollouts} rollouts and {updates} updates given; at least 2 and 1 are needed."
        )
    if not callable(reward):
        raise ValueError(
            f"reward: {type(reward).__name__} given, a function of a trajectory (M, O) needed."
        )
    random = np.random.default_rng(seeded(seed))

    def tried(theta: Array) -> tuple[float, Correlation]:
        policy = replace(correlation, theta=theta)
        value = real("reward", reward(policy.applied(primitive).mean(s)))
        check_shape("reward", value)
        if not np.isfinite(value):
            raise ValueError(
                f"The reward is {value}, and must be a finite number for any trajectory (M, O)."
            )
        return float(value), policy

    theta = correlation.theta
    best = tried(theta)
    rewards = [best[0]]
    for _ in range(updates):
        epsilon = exploration * random.standard_normal((rollouts, *theta.shape))
        trials = [tried(theta + sample) for sample in epsilon]
        values = np.array([value for value, _ in trials])
        span = max(values.max() - values.min(), np.finfo(np.float64).tiny)
        weights = np.exp(_SHARPNESS * (values - values.max()) / span)
        theta = theta + np.tensordot(weights / weights.sum(), epsilon, axes=1)
        now = tried(theta)
        rewards.append(now[0])
        best = max([best, now, *trials], key=lambda one: one[0])
    return Improvement(best[1], best[1].applied(primitive), frozen(np.array(rewards)))
