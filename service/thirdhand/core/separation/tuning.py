"""Tuned numbers of separation.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do.
"""

from __future__ import annotations

from typing import NamedTuple


class SeparationTuning(NamedTuple):
    """Tuned numbers of separation."""

    # Planning keeps more distance than the rule requires, so that the rule is not reached.
    # 0 to 0.05. More: the arm stays farther away. Less: the rule itself limits the arm.
    planned_margin_m: float = 0.01  # distance kept beyond the clearance
    # 0.4 to 1. More: the arm comes faster. Less: ramps are never too short.
    # share of braking and of contact speed that is planned with; ramps need the rest
    planned_brake_share: float = 0.8
    # 0.2 to 1. More: the arm comes faster. Less: braking is gentle.
    # largest planned deceleration / the tool's: people, things, arm
    planned_brake_limits: tuple[float, ...] = (1.0, 0.5, 0.5)
    # 5e-3 to 0.1. More: the arm slows down early. Less: joints oscillate.
    # smallest reaction time that is planned with; joints oscillate with a shorter one
    planned_reaction_s: float = 0.02

    # Inside of a clearance.
    # 1 to 20. More: the arm returns faster. Less: the arm returns softly.
    # [1/s] planned speed / distance left to the clearance; negative inside
    clearance_gain_per_s: float = 5.0
    # 2e-3 to 0.05. More: the rule is exceeded more. Less: the arm stops for rounding.
    # tolerated excess, as joints do not all reach their velocities at the same time
    slip_speed_mps: float = 0.01

    # Speeds of hands.
    # 0.5 to 3. More: the arm keeps farther away from a hand that appears. Less: it reacts later.
    unknown_speed_mps: float = 1.6  # assumed speed of a hand that was only just seen

    # Hands: what may happen until the arm reacts.
    # 0.03 to 0.2. More: the arm slows down earlier. Less: ramps are too short.
    # time until a deceleration has built up, and until a hand's new velocity is measured
    brake_ramp_s: float = 0.08
    # 5e-3 to 0.1. More: contact is allowed wider. Less: a reached via-point blocks the tool.
    # a hand may be touched this far beyond a via-point's radius, on each axis
    contact_margin_m: float = 0.02
