"""The paper's method: a mixture of Gaussians, its regression as reference, and a KMP of that.

Huang et al. 2019, sections II-A and II-B: inputs are drawn from the mixture's marginal, and
`spread_m` is added to the reference's standard deviation: Sigma_n + spread_m² I.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.gate import CEILING_M
from thirdhand.workbench.learning.methods.held_out import gate_of, held_out_takes
from thirdhand.workbench.learning.records import (
    Fitted,
    HeldOut,
    Options,
    Progress,
    Take,
    Taught,
    folds_of,
)

# the kernel's ell and lambda, unless they are given
ELL_PER_M2 = 5.0
PENALTY = 2.0


@dataclass(frozen=True)
class Mixture:
    """The method with its options."""

    options: Options
    components: int

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self | None:
        """The method, if a number of components is given."""
        return None if options.components is None else cls(options, options.components)

    def fit(self, taught: Taught, progress: Progress) -> Fitted:
        """The model of positions; its gate's ceiling is scaled as its covariance is too large."""
        takes = taught.new
        inputs = [take.hands for take in takes]
        progress(f"learning from all {len(takes)}")
        primitive = self._primitive(takes)
        folds = folds_of(takes)
        held_out = held_out_takes(
            takes,
            inputs,
            lambda fold: self._primitive(
                [take for take, number in zip(takes, folds, strict=True) if number != fold]
            ),
            progress,
        )
        ceiling_m = CEILING_M * _calibration(held_out)
        return Fitted(HandsKMP(primitive), held_out, gate_of(primitive, held_out, 0, ceiling_m))

    def _primitive(self, takes: Sequence[Take]) -> KMP:
        points = self.options.points
        seed = self.options.seed
        samples = np.concatenate([np.hstack([take.hands, take.position]) for take in takes])
        mixture = GaussianMixture.fit(samples, components=self.components, seed=seed)
        inputs = mixture.sample_inputs(points, dimensions=6, seed=seed)
        reference = mixture.regress(inputs)
        return KMP.fit(
            inputs,
            Gaussians(reference.mean, reference.covariance + self.options.spread_m**2 * np.eye(3)),
            kernel=GaussianKernel(self.options.ell or ELL_PER_M2),
            lambda_mean=self.options.penalty or PENALTY,
            prior_mean=samples[:, 6:].mean(axis=0),
        )


def _calibration(held_out: Sequence[HeldOut]) -> float:
    """The root mean square of predicted deviations over that of the errors, at least 1."""
    errors = np.concatenate([result.errors for result in held_out])
    predicted = np.concatenate([result.gate_m for result in held_out])
    return max(1.0, float(np.sqrt((predicted**2).mean() / max(float((errors**2).mean()), 1e-12))))
