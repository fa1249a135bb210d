"""Message about a position that is too far from the base plate to be a hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

from thirdhand.contract.evidence import figures
from thirdhand.core.intake.stage import UNIT_M
from thirdhand.core.tuning import TUNING

# distances of hands and tool from the tracker's origin, in the unit that was meant
PLAUSIBLE_DISTANCES_M = (0.05, 2.5)


def unit_meant(position: Sequence[float], unit: str) -> str:
    """The unit in which a position was probably reported, if that is not `unit`; empty otherwise.

    A `unit` is wrong if no hand is as far from the origin (PLAUSIBLE_DISTANCES_M). Of the units in
    which a hand may be, the one is returned that puts it nearest to 1 m.
    """
    distance = math.hypot(*position)
    nearest_m, farthest_m = PLAUSIBLE_DISTANCES_M
    if nearest_m < distance * UNIT_M[unit] < farthest_m:
        return ""
    meant = [name for name, size_m in UNIT_M.items() if nearest_m < distance * size_m < farthest_m]
    return min(meant, key=lambda name: abs(math.log(distance * UNIT_M[name])), default="")


def too_far(position: Sequence[float], unit: str, rule: str = "") -> str:
    """Message with the reported position, the unit that it is probably in, and the accepted
    distance.

    The position was read in `unit`, which `rule` states (by default, the setting `[hands] unit`).
    """
    meant = unit_meant(position, unit)
    like = f", which looks like {meant}" if meant else ""
    rule = rule or f"[hands] unit is {unit!r}"
    most_m = TUNING.intake.max_hand_distance_m
    return (
        f"at {figures(position)}{like}; {rule}, at most {most_m:g} m from the base plate accepted"
    )
