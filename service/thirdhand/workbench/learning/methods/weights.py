"""Weights of new takes against those of a skill that is refined.

A new take shows how the skill's user does the task, an earlier one how other people do it.
In a KMP, a sample that has w times the weight has the w-th part of the covariance Sigma of equation
(8) of Huang et al. 2019. As the noise of the new samples is chosen by held-out errors anyway, they
keep theirs, and that of the earlier samples is multiplied:

    Sigma_n = r S_n (new),   w r S_n (earlier)

`w` is the candidate with the smallest error of new takes that are held out; an infinite one leaves
the earlier takes out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from thirdhand.workbench.learning.records import Weights

WEIGHTS = (1.0, 4.0, 16.0, 64.0, math.inf)  # candidates


def name_of(weight: float) -> str:
    """A weight in a skill's figures."""
    return f"{weight:g}" if math.isfinite(weight) else "yours alone"


def chosen(errors_m: Mapping[float, float]) -> tuple[float, Weights]:
    """The weight with the least error [m], and all errors by name."""
    weight = min(errors_m, key=errors_m.__getitem__)
    return weight, Weights(
        name_of(weight), {name_of(candidate): error_m for candidate, error_m in errors_m.items()}
    )
