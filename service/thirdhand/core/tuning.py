"""Tuned numbers of the core as data: each stage takes them when it is constructed.

A test or an experiment varies one number so:
`Controller(..., tuning=TUNING._replace(setpoint=TUNING.setpoint._replace(jerk_weight=1e-9)))`.
"""

from __future__ import annotations

from typing import NamedTuple

from thirdhand.core.arm.tuning import ArmTuning
from thirdhand.core.decision.tuning import DecisionTuning
from thirdhand.core.intake.tuning import IntakeTuning
from thirdhand.core.separation.tuning import SeparationTuning
from thirdhand.core.setpoint.tuning import SetpointTuning
from thirdhand.core.wish.tuning import WishTuning


class Tuning(NamedTuple):
    """Tuned numbers of each stage. Those of the skill are constants: it is learned with them."""

    intake: IntakeTuning = IntakeTuning()
    decision: DecisionTuning = DecisionTuning()
    separation: SeparationTuning = SeparationTuning()
    setpoint: SetpointTuning = SetpointTuning()
    arm: ArmTuning = ArmTuning()
    wish: WishTuning = WishTuning()


TUNING = Tuning()
