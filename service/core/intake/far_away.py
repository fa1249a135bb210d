"""What is said of a position that is too far from the base plate to be meant."""

from __future__ import annotations

from collections.abc import Sequence

from service.contract.incidents import figures
from service.core.intake.intake import FARTHEST_M, UNIT_M

PLAUSIBLE_M = (0.05, 2.5)  # hands and tool are so far from the base plate, in the unit that was meant


def too_far(position: Sequence[float], unit: str, rule: str = "") -> str:
    """In words: a position as it was told, the unit that it looks to be in, and what is accepted.

    It was taken to be in `unit`; by which `rule`, if not by `[hands] unit`.
    """
    far = sum(v * v for v in position) ** 0.5
    meant = [u for u, m in UNIT_M.items() if u != unit and PLAUSIBLE_M[0] < far * m < PLAUSIBLE_M[1]]
    like = f", which looks like {meant[-1]}" if meant else ""
    rule = rule or f"[hands] unit is {unit!r}"
    return f"at {figures(position)}{like}; {rule}, at most {FARTHEST_M:g} m from the base plate accepted"
