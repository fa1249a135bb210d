"""Learning: from demonstrations to a skill.

A mixture by EM, its regression at sampled inputs, a KMP of that reference.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from service.core.frame import Vector
from service.core.skill import Skill
from service.learning.demonstration import Demonstration, in_phase
from service.learning.skill_file import SkillError, with_file

MARGIN_M = 0.25  # by which targets may leave the demonstrated box
GATE = 2.0  # times the largest deviation along a demonstration that was held out is off the data


def learn(
    demonstrations: Sequence[Demonstration],
    *,
    name: str = "skill",
    components: int = 10,
    points: int = 200,
    ell: float = 5.0,
    penalty: float = 2.0,
    spread_m: float = 0.01,
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> Skill:
    """The skill of some demonstrations: a mixture (EM), its regression at sampled inputs, a KMP.

    Raises SkillError.

    ell [1/m²] and penalty (lambda) as in the paper, in metres; `spread_m` is added to the
    reference's standard deviation.
    """
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    pairs = [in_phase(demonstration) for demonstration in demonstrations]

    def fitted(samples: Vector) -> KMP:
        try:
            mixture = GaussianMixture.fit(samples, components=components, seed=seed)
            inputs = mixture.sample_inputs(points, dimensions=6, seed=seed)
            reference = mixture.regress(inputs)
            reference = Gaussians(reference.mean, reference.covariance + spread_m**2 * np.eye(3))
            return KMP.fit(
                inputs,
                reference,
                kernel=GaussianKernel(ell),
                lambda_mean=penalty,
                prior_mean=samples[:, 6:].mean(axis=0),
            )
        except ValueError as error:
            raise SkillError(f"cannot learn from {len(samples)} samples: {error}") from None

    each = [np.hstack([hands, tool[:, :3]]) for hands, tool in pairs]
    samples = np.concatenate(each)
    deviations = []
    for i, held_out in enumerate(each):
        progress(f"holding out demonstration {i + 1} of {len(each)}")
        others = np.concatenate(each[:i] + each[i + 1 :]) if len(each) > 1 else held_out
        covariance = fitted(others).predict(held_out[:, :6]).covariance
        deviations.append(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3).max())
    progress(f"learning from all {len(each)}")
    skill = Skill(
        name=name,
        primitive=fitted(samples),
        orientation=mean_orientation(np.concatenate([tool[:, 3:] for _, tool in pairs])),
        workspace=np.stack([samples[:, 6:].min(axis=0) - MARGIN_M, samples[:, 6:].max(axis=0) + MARGIN_M]),
        threshold=float(GATE * max(deviations)),
        learned_from=hashlib.blake2b(
            b"".join(d.hands.tobytes() + d.tool.tobytes() for d in demonstrations), digest_size=16
        ).hexdigest(),
        components=components,
    )
    return with_file(skill)


def mean_orientation(quaternions: ArrayLike) -> Vector:
    """The mean (4,) of quaternions x y z w (M, 4), whatever their signs: the leading eigenvector of
    their scatter (Markley et al. 2007).
    """
    q = np.asarray(quaternions, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean * (1 if mean[3] >= 0 else -1))
