"""The experiment `sensitivity`: tuned numbers as data."""

from __future__ import annotations

import re

from support.paths import ROOT
from thirdhand.core.controller import Controller
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.lab import sensitivity

# Values without an effect, as another limit of the shipped cell is reached first.
BOUND_BY_SETTINGS = {"arm.position_gain_rate_share 2", "separation.planned_brake_limits 2"}
CELL = Settings()
SKILL = shipped_skill()
URDF = robot_description(CELL)


def constants(tuning: Tuning) -> dict[str, str]:
    """Digests of the constants of each stage."""
    return Controller(CELL, SKILL, urdf=URDF, tuning=tuning).constants


def test_tuned_number_reaches_constants() -> None:
    """Each tuned number reaches the constants of a stage."""
    tuned = constants(TUNING)
    unread = set()
    for number in sensitivity.numbers().values():
        for factor in sensitivity.FACTORS:
            if constants(number.tuning(factor)) == tuned:
                unread.add(f"{number.key} {factor:g}")
    assert unread == BOUND_BY_SETTINGS


def test_tuned_number_is_read_by_core() -> None:
    """For intake, decision and setpoint the digests do not show this, as their records hold all
    numbers.
    """
    sources = [
        path
        for path in (ROOT / "service" / "thirdhand" / "core").rglob("*.py")
        if path.name != "tuning.py"
    ]
    read = set(
        re.findall(r"\.(\w+)", "".join(path.read_text(encoding="utf-8") for path in sources))
    )
    derived = (ROOT / "service" / "thirdhand" / "core" / "intake" / "tuning.py").read_text(
        encoding="utf-8"
    )
    read |= set(re.findall(r"self\.(\w+)", derived))
    assert {number.name for number in sensitivity.numbers().values()} - read == set()


def test_number_changes_its_own_stages() -> None:
    """Controllers with other tuning are not affected."""
    arm = TUNING.arm._replace(position_gain_per_s=25.0)
    tuned = constants(TUNING)
    changed = constants(TUNING._replace(arm=arm))
    assert {stage for stage in tuned if tuned[stage] != changed[stage]} == {"setpoint", "arm"}
    assert constants(TUNING) == tuned
