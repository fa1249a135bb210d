"""The experiment `sensitivity`: tuned numbers as data, and what is made of the figures."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from support.paths import ROOT
from thirdhand.core.controller import Controller
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.lab import sensitivity
from thirdhand_sim.lab.catalogue import EXPERIMENTS

# Values that another limit of the shipped cell keeps from having an effect.
BOUND_BY_SETTINGS = {"arm.position_gain_rate_share 2", "separation.planned_brake_limits 2"}
CELL, SKILL = Settings(), shipped_skill()
URDF = robot_description(CELL)


def constants(tuning: Tuning) -> dict[str, str]:
    """Digests of the constants of each stage."""
    return Controller(CELL, SKILL, urdf=URDF, tuning=tuning).constants


def test_each_tuned_number_reaches_the_constants_of_a_stage() -> None:
    tuned = constants(TUNING)
    unread = {
        f"{number.key} {factor:g}"
        for number in sensitivity.numbers().values()
        for factor in sensitivity.FACTORS
        if constants(number.tuning(factor)) == tuned
    }
    assert unread == BOUND_BY_SETTINGS


def test_each_tuned_number_is_read_by_the_core() -> None:
    """The records of intake, decision and setpoint hold all their numbers, read or not."""
    sources = [path for path in (ROOT / "service" / "thirdhand" / "core").rglob("*.py") if path.name != "tuning.py"]
    read = set(re.findall(r"\.(\w+)", "".join(path.read_text(encoding="utf-8") for path in sources)))
    derived = (ROOT / "service" / "thirdhand" / "core" / "intake" / "tuning.py").read_text(encoding="utf-8")
    read |= set(re.findall(r"self\.(\w+)", derived))
    assert {number.name for number in sensitivity.numbers().values()} - read == set()


def test_a_number_changes_what_follows_from_it_and_no_other_controller() -> None:
    arm = TUNING.arm._replace(position_gain_per_s=25.0)
    tuned, changed = constants(TUNING), constants(TUNING._replace(arm=arm))
    assert {stage for stage in tuned if tuned[stage] != changed[stage]} == {"setpoint", "arm"}
    assert constants(TUNING) == tuned


@pytest.mark.parametrize(
    ("value", "half", "double"), [(8, 4, 16), (0.3, 0.15, 0.6), ((1.0, 2.0), (0.5, 1.0), (2.0, 4.0))]
)
def test_a_number_is_halved_and_doubled_and_a_count_stays_whole(value: Any, half: Any, double: Any) -> None:
    number = sensitivity.Number("intake", "name", value)
    assert (number.changed(0.5), number.changed(2.0)) == (half, double)


def test_shares_are_at_most_one_and_probabilities_sum_to_one() -> None:
    assert sensitivity.Number("arm", "name_shares", (0.4, 0.9)).changed(2.0) == (0.8, 1.0)
    assert np.sum(sensitivity.Number("intake", "mode_prior", (0.3, 0.5, 0.2)).changed(2.0)) == pytest.approx(1.0)


def test_the_largest_change_is_named_beside_the_noise() -> None:
    names = ("moving: a", "stops: b", "other: c", "other: d")
    tuned = [dict(zip(names, (1.0 + noise, 2.0, 3.0 + noise, 4.0), strict=True)) for noise in (0.0, 0.1, 0.2)]
    rows = [row | {"moving: a": 1.5 * row["moving: a"], "stops: b": 2.5, "other: c": 2.8} for row in tuned[:2]]
    found = sensitivity.effect(list(rows), tuned)
    assert found["moving_percent"] == [pytest.approx(100 * 0.525 / 1.1)]
    assert found["stops_mm"] == [0.5]
    assert (found["largest"], found["noises"]) == ("other: c -0.25", pytest.approx(2.5))
    assert sensitivity.effect([rows[0], "ValueError: no gains"], tuned) == {"fails": "ValueError: no gains"}


def test_no_other_experiment_uses_its_seeds() -> None:
    own = [stream for name, stream in EXPERIMENTS["sensitivity"].seeds.tuning.items()]
    others = [one.seeds for name, one in EXPERIMENTS.items() if name != "sensitivity"]
    theirs = [stream for seeds in others for part in seeds[:3] for stream in part.values()]
    assert [f"{one} and {other}" for one in own for other in theirs if one.overlaps(other)] == []
    assert all(len(stream.numbers) == sensitivity.SEEDS for stream in own)
