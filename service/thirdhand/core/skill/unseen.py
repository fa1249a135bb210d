"""Uncertainty of the tool's target because a hand is not seen at the moment."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from kmp.compiled import compiled
from kmp.elementary import exp
from thirdhand.core.frame import Records, Vector
from thirdhand.core.skill.memory import turn_lag_s
from thirdhand.core.skill.model import REGION_95, Seen


@compiled
def deviation_m(states: Records, rules: Records, side: int) -> float:
    """Standard deviation [m] on each axis of the position of a hand that is not seen, τ after its
    newest sample:

        σ² = Σ_j (s μ_j + (1 - s) ρ_j) P_j[0, 0],   s = exp(-λ τ)

    μ_j and P_j are probability and covariance of mode j, ρ is mode_prior, and λ the largest of
    mode_switch_rates_per_s, at which an unseen hand changes its motion: since it was seen, the
    hand may have begun to move, or to rest.
    """
    state = states[0]
    rule = rules[0]
    variance = 0.0
    stay = exp(-rule.mode_switch_rate * (state.tick - state.hand_ticks[side]) * rule.period_s)
    for mode in range(len(rule.mode_prior)):
        share = stay * state.mode_probabilities[side, mode] + (1.0 - stay) * rule.mode_prior[mode]
        variance += share * state.mode_covariances[side, mode, 0, 0]
    return math.sqrt(variance)


def off_m(
    tool: Callable[[Seen], Vector], seen: Seen, columns: list[int], deviation: float
) -> float:
    """Possible error [m] of the target because one hand is not seen.

    With d = sqrt(REGION_95) * `deviation` [m], the prediction of the `tool` (3,) [m] for the hands
    `seen` is repeated with that hand, whose x, y and z begin at `columns` (a hand that leads alone
    stands for both), moved by d along each axis. The result is the norm of the three differences
    (3, 3). Velocities and the skill's delay are left out.
    """
    if not columns:
        return 0.0
    motion = np.zeros((3, 6))
    differences = np.empty((3, 3))
    resting = seen._replace(moving=motion, now=motion, turn_lag_s=turn_lag_s(0.0), period_s=0.0)
    motion[0] = seen.now[0]
    reference_m = tool(resting)
    for axis in range(3):
        motion[0] = seen.now[0]
        for column in columns:
            motion[0, column + axis] += math.sqrt(REGION_95) * deviation
        differences[axis] = tool(resting) - reference_m
    return float(np.linalg.norm(differences))
