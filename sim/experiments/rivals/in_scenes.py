"""What the skill is compared with, each as a skill that the service's core can run:

GMR, a Gaussian process, a ProMP, the paper's own numbers.

All learn from the same demonstrations, are told the same places if they can be, and share the core:
only the prediction differs. None is ever held back for being far from its data.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians, ViaPointMissed
from service.contract.requests import TOLERANCE_M
from service.core.skill.skill import Skill
from service.core.skill.tuning import MOTION_STEP_S
from service.core.skill.via_points import neighbourhoods
from service.learning.demonstration import Demonstration
from service.learning.skill_file import StoredSkill
from service.learning.via_points import adapted
from sim.bench import Bench
from sim.experiments.catalogue import EXPERIMENTS
from sim.experiments.open_loop import Law, Said, by_law, differences, rival
from sim.experiments.people.trials import Model
from sim.experiments.results import Array, ExperimentError
from sim.people import Places
from sim.scene import Scene

COMPONENTS, POINTS, SEED = 10, 200, EXPERIMENTS["statistics"].seeds.method
PAPER_ELL, PAPER_LAMBDA, PAPER_VIA_STD_M = 0.5, 2.0, 0.001
VIA_STD_M, EXACT_STD_M = 0.001, 0.0001
BASES = 20  # of the ProMP, for each of x, y and z
# Times the mean variance of a ProMP's weights: of 0 to 100, about where it leaves the rest of a
# letter as well alone as KMP does.
RIDGE = 10.0

Adapt: TypeAlias = Callable[[Scene], Callable[[Bench], Skill]]
"""From a scene to the skill that is told its places, once there is a bench."""


def ours(skill: StoredSkill) -> Adapt:
    """The service's own: the shipped skill, taught the three places as the demo teaches them."""

    def adapt(scene: Scene) -> Callable[[Bench], Skill]:
        taught = adapted(skill, scene.via_points(), tolerance=TOLERANCE_M)
        return lambda bench: taught

    return adapt


def gmr(skill: Skill, demonstrations: Sequence[Demonstration]) -> Adapt:
    """Gaussian mixture regression alone, which cannot be told of places."""
    mixture = GaussianMixture.fit(samples_of(demonstrations), components=COMPONENTS, seed=SEED)
    law = regression_of(mixture)
    return lambda scene: lambda bench: by_law(skill, law)


def paper(skill: Skill, demonstrations: Sequence[Demonstration]) -> Adapt:
    """KMP with the paper's ell = 0.5 and lambda = 2 (in metres), and each place a bare point of
    variance 1e-6 m².
    """
    samples = samples_of(demonstrations)
    mixture = GaussianMixture.fit(samples, components=COMPONENTS, seed=SEED)
    inputs = mixture.sample_inputs(POINTS, dimensions=6, seed=SEED)
    base = KMP.fit(
        inputs,
        mixture.regress(inputs),
        kernel=GaussianKernel(PAPER_ELL),
        lambda_mean=PAPER_LAMBDA,
        prior_mean=samples[:, 6:].mean(axis=0),
    )

    def adapt(scene: Scene) -> Callable[[Bench], Skill]:
        points = scene.via_points()
        hands = [[*point.left, *point.right] for point in points]
        desired = Gaussians(
            np.array([point.tool for point in points]), np.tile(PAPER_VIA_STD_M**2 * np.eye(3), (len(points), 1, 1))
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ViaPointMissed)  # that is what is found out here
            primitive = base.adapt(hands, desired, tolerance=TOLERANCE_M)
        return lambda bench: by_law(skill, primitive.mean)

    return adapt


def of_model(skill: Skill, model: Model) -> Adapt:
    """A model of `people`, told a scene's places and its start, exactly."""

    def adapt(scene: Scene) -> Callable[[Bench], Skill]:
        s = scene
        points = (s.left_start, s.right_start, s.handover, s.glass, s.soldering, s.iron, s.robot_start)
        placed = model.place(Places._make([*(np.array(point) for point in points), 0.0]))
        if isinstance(placed, Skill):
            return lambda bench: placed
        return lambda bench: by_law(skill, lambda hands: placed.mean(hands, np.zeros_like(hands)))

    return adapt


def gaussian_process(
    skill: Skill, demonstrations: Sequence[Demonstration], *, every: int = 20, ell: float | None = None
) -> Adapt:
    """A Gaussian process of the demonstrations' samples, its lengths and noise by maximum
    likelihood, or with one length for all, as `ell` [1/m²] says.

    It is told the same neighbourhoods of places as our skill, as data with 1 mm of noise that
    replace the samples near them.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    samples = samples_of(demonstrations)[::every]
    inputs, outputs, centre = samples[:, :6], samples[:, 6:], samples[:, 6:].mean(axis=0)
    kernel = ConstantKernel(0.05, (1e-4, 1e2)) * RBF(np.full(6, 0.3), (0.03, 10.0)) + WhiteKernel(1e-4, (1e-6, 1e-2))
    if ell is not None:
        kernel = ConstantKernel(0.05) * RBF(np.full(6, (2 * ell) ** -0.5), "fixed") + WhiteKernel(1e-4, "fixed")
    found = GaussianProcessRegressor(kernel, random_state=SEED).fit(inputs, outputs - centre).kernel_
    size, lengths, noise = (
        float(found.k1.k1.constant_value),
        np.asarray(found.k1.k2.length_scale),
        float(found.k2.noise_level),
    )

    def covariance(a: Array, b: Array) -> Array:
        return np.asarray(size * np.exp(-0.5 * cdist(a / lengths, b / lengths, "sqeuclidean")))

    def adapt(scene: Scene) -> Callable[[Bench], Skill]:
        at, wanted, _ = neighbourhoods(scene.via_points())
        kept = cdist(inputs, at).min(axis=1) >= TOLERANCE_M
        s = np.concatenate([inputs[kept], at])
        y = np.concatenate([outputs[kept], wanted]) - centre
        variance = np.concatenate([np.full(int(kept.sum()), noise), np.full(len(at), VIA_STD_M**2)])
        weights = cho_solve(cho_factor(covariance(s, s) + np.diag(variance)), y)
        return lambda bench: by_law(skill, lambda q: np.asarray(covariance(q, s) @ weights + centre))

    return adapt


def promp(skill: Skill, demonstrations: Sequence[Demonstration]) -> Adapt:
    """A ProMP over time (movement_primitives), conditioned on the places at their nominal times and
    replayed at nominal speed.
    """
    length = min(len(d.tool) for d in demonstrations)
    lasts_s = (length - 1) * demonstrations[0].period_s
    times = np.linspace(0.0, lasts_s, length)[::4]
    learned = learned_promp([times] * len(demonstrations), [d.tool[:length:4, :3] for d in demonstrations], bases=BASES)

    def adapt(scene: Scene) -> Callable[[Bench], Skill]:
        conditioned = learned
        for (begin, end), place in zip(scene.dwells, (scene.offer, scene.glass, scene.carry), strict=True):
            conditioned = conditioned.condition_position(
                np.array(place), EXACT_STD_M**2 * np.eye(3), t=(begin + end) / 2, t_max=lasts_s
            )

        grid = np.linspace(0.0, lasts_s, 1001)
        spline = CubicSpline(grid, conditioned.mean_trajectory(grid.copy()))

        def says(bench: Bench) -> Said:
            """Its tool now; it is told when the hands begin."""
            rows = (spline(np.clip(bench.time_s + way * MOTION_STEP_S, 0.0, lasts_s)) for way in (-1, 0, 1))
            return Said(differences(*rows))

        return lambda bench: rival(skill, lambda *moving: says(bench))

    return adapt


def learned_promp(times: Sequence[Array], trajectories: Sequence[Array], *, bases: int, ridge: float = RIDGE) -> Any:
    """The ProMP (of movement_primitives) of trajectories (T, O) at times (T,) [s], from 0.

    Raises ExperimentError.

    H demonstrations leave its weights' covariance with a rank of H - 1, which can meet that many
    numbers and no more, and not where wanted: three places in space are nine. So `ridge` times the
    mean variance is added to its diagonal, with which ProMP meets via-points as it does in the
    paper.
    """
    try:
        from movement_primitives.promp import ProMP
    except ImportError:
        raise ExperimentError(
            "ProMPs need movement_primitives, which is not installed: pip install 'thirdhand[experiments]'"
        ) from None
    primitive = ProMP(n_dims=trajectories[0].shape[1], n_weights_per_dim=bases)
    primitive.imitate([t.copy() for t in times], list(trajectories))  # it divides the times that it is given
    variance = ridge * np.trace(primitive.weight_cov) / len(primitive.weight_cov)
    return primitive.from_weight_distribution(
        primitive.weight_mean, primitive.weight_cov + variance * np.eye(len(primitive.weight_cov))
    )


def regression_of(mixture: GaussianMixture) -> Law:
    """The mean of the mixture's regression, as `regress` gives it, with all that does not depend on
    the query made once.
    """
    covariances = mixture.covariances
    precisions = np.linalg.inv(covariances[:, :6, :6])
    gains = precisions @ covariances[:, :6, 6:]  # (K, 6, 3)
    shares = np.log(mixture.weights) - 0.5 * np.linalg.slogdet(covariances[:, :6, :6])[1]

    def law(s: Array) -> Array:
        offsets = s[:, None, :] - mixture.means[:, :6]  # (M, K, 6)
        log_share = shares - 0.5 * np.einsum("mki,kij,mkj->mk", offsets, precisions, offsets)
        share = np.exp(log_share - log_share.max(axis=1, keepdims=True))
        means = mixture.means[:, 6:] + np.einsum("mki,kio->mko", offsets, gains)
        return np.asarray(np.einsum("mk,mko->mo", share / share.sum(axis=1, keepdims=True), means))

    return law


def samples_of(demonstrations: Sequence[Demonstration]) -> Array:
    return np.concatenate([np.hstack([d.hands, d.tool[:, :3]]) for d in demonstrations])
