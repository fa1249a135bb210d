"""Uncertainty of the tool's target because a hand is not seen at the moment."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Record, Records, Vector, as_array
from service.core.intake.tuning import MODE_PRIOR, MODE_SWITCH_RATES_PER_S
from service.core.skill.model import REGION_95

if TYPE_CHECKING:
    from service.core.skill.skill import Skill

STANDS = np.zeros((2, 3))  # velocities and accelerations of both hands: not needed for the position


@compiled
def deviation_m(states: Records, side: int, period_s: float) -> float:
    """Standard deviation [m] on each axis of the position of a hand that is not seen, τ after its
    newest sample:

        σ² = Σ_j (s μ_j + (1 - s) ρ_j) P_j[0, 0],   s = exp(-λ τ)

    μ_j and P_j are probability and covariance of mode j, ρ is MODE_PRIOR, and λ the largest of
    MODE_SWITCH_RATES_PER_S, at which an unseen hand changes its motion: since it was seen, the
    hand may have begun to move, or to rest.
    """
    state, variance = states[0], 0.0
    stay = math.exp(-MODE_SWITCH_RATES_PER_S.max() * (state.tick - state.hand_ticks[side]) * period_s)
    for mode in range(len(MODE_PRIOR)):
        share = stay * state.mode_probabilities[side, mode] + (1.0 - stay) * MODE_PRIOR[mode]
        variance += share * state.mode_covariances[side, mode, 0, 0]
    return math.sqrt(variance)


def off_m(skill: Skill, state: Record, side: int, period_s: float) -> float:
    """Possible error [m] of the target because one hand is not seen.

    With d = sqrt(REGION_95) * `deviation_m`, the prediction is repeated with that hand moved by d
    along each axis; the result is the norm of the three differences (3, 3). The skill's delay is
    left out.
    """
    by_m = math.sqrt(REGION_95) * deviation_m(as_array(state), side, period_s)
    known = state["covariance"], state["orientation_covariance"], float(state["closure"]), float(state["known_gate_m"])

    def tool(hands: Vector) -> Vector:
        """Predicted position (3,) [m] of the tool for hands (2, 3) [m] at rest."""
        return skill.predict(
            hands,
            STANDS,
            STANDS,
            state["hand_stillness"],
            before=known,
            past=state["memory"],
            turns=state["turns"],
            belief=state["stage_belief"],
            lead_s=skill.model.delay_s,
            clock=state["task_clock"],
        ).position

    hands = state["hands"][:, 0]
    off, here = np.empty((3, 3)), tool(hands)
    for axis in range(3):
        there = hands.copy()
        there[side, axis] += by_m
        off[axis] = tool(there) - here
    return float(np.linalg.norm(off))
