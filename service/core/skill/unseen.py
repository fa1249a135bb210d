"""What a hand that is not seen for a moment means for the tool: how far that may be off."""

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

CHANGES_RATE = float(MODE_SWITCH_RATES_PER_S.max())  # [1/s] at which one moves otherwise than it did: nobody sees it
STANDS = np.zeros((2, 3))  # both hands: how they move makes no difference to where the tool should be


@compiled
def deviation_m(states: Records, side: int, period_s: float) -> float:
    """The standard deviation [m], each axis, of where a hand is, which may have begun to move, or
    to rest, since it was seen.
    """
    state, variance = states[0], 0.0
    stay = math.exp(-CHANGES_RATE * (state.tick - state.hand_ticks[side]) * period_s)
    for mode in range(len(MODE_PRIOR)):
        share = stay * state.mode_probabilities[side, mode] + (1.0 - stay) * MODE_PRIOR[mode]
        variance += share * state.mode_covariances[side, mode, 0, 0]
    return math.sqrt(variance)


def off_m(skill: Skill, state: Record, side: int, period_s: float) -> float:
    """How far the tool may be off [m], as one hand is not seen: 95 % of what that may make of it,
    at once even where the skill is late.
    """
    by_m = math.sqrt(REGION_95) * deviation_m(as_array(state), side, period_s)
    known = state["covariance"], state["orientation_covariance"], float(state["closure"])

    def tool(hands: Vector) -> Vector:
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
        ).position

    hands = state["hands"][:, 0]
    off, here = np.empty((3, 3)), tool(hands)
    for axis in range(3):
        there = hands.copy()
        there[side, axis] += by_m
        off[axis] = tool(there) - here
    return float(np.linalg.norm(off))
