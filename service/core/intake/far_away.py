"""Message about a position that is too far from the base plate to be a hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

from service.contract.evidence import figures
from service.core.intake.stage import UNIT_M
from service.core.tuning import TUNING

PLAUSIBLE_DISTANCES_M = (0.05, 2.5)  # distances of hands and tool from the base plate, in the unit that was meant


def too_far(position: Sequence[float], unit: str, rule: str = "") -> str:
    """Message with the reported position, the unit that it is probably in, and the accepted
    distance.

    The position was read in `unit`, which `rule` states (by default, the setting `[hands] unit`).
    Among the other units that give a plausible distance, the message names the one nearest to 1 m.
    """
    far = sum(v * v for v in position) ** 0.5
    meant = [
        u for u, m in UNIT_M.items() if u != unit and PLAUSIBLE_DISTANCES_M[0] < far * m < PLAUSIBLE_DISTANCES_M[1]
    ]
    meant.sort(key=lambda u: abs(math.log(far * UNIT_M[u])))
    like = f", which looks like {meant[0]}" if meant else ""
    rule = rule or f"[hands] unit is {unit!r}"
    most_m = TUNING.intake.max_hand_distance_m
    return f"at {figures(position)}{like}; {rule}, at most {most_m:g} m from the base plate accepted"
