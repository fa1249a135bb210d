"""Incidents stand in one table: the module does not import if a member has no row, no other package
repeats the words, and the words contain the cell's settings and the deciding constants.
"""

from __future__ import annotations

import pytest

from thirdhand.contract.evidence import Evidence, explained
from thirdhand.contract.incidents import BY_WORD, INCIDENTS, Condition, what_happened, word
from thirdhand.contract.records import GONE_S, Cause, Flag, Mode, Reason
from thirdhand.contract.requests import Source
from thirdhand.core.intake import CONFIRMED_SAMPLES
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import ArmSettings, HandSettings, Settings, ToolSettings

STUCK_S = TUNING.decision.stuck_s
TOO_FAST_S = 0.6 * TUNING.intake.confirmed_s


ALL_MEMBERS = [member for kind in (Mode, Reason, Flag, Cause, Condition) for member in kind]
MEMBERS = [member for member in ALL_MEMBERS if member is not Reason.NONE]


def test_each_member_has_one_row_with_words_of_its_own() -> None:
    assert (word(Reason.NONE), tuple(explained(Reason.NONE))) == ("", ("", ""))
    rows = [row for rows in INCIDENTS.values() for row in rows]
    assert sorted(word(row.member) for row in rows) == sorted(map(word, MEMBERS))
    assert all(row.title and row.what_happened and row.what_to_do for row in rows)
    assert len({row.title for row in rows}) == len(rows)
    assert {row.mode for row in rows if isinstance(row.member, Reason)} == {Mode.HOLD, Mode.FAULT}


def test_what_happened_names_the_settings_of_the_cell() -> None:
    cell = Settings(
        hands=HandSettings(stale_ms=250.0, unseen_ms=700.0),
        arm=ArmSettings(silent_ms=60.0, fault_error_rad=0.2),
        tool=ToolSettings(fault_speed=1.4),
    )
    for member, words in (
        (Reason.STALE_HAND, "250 ms ([hands] stale_ms)"),
        (Reason.STALE_HAND, "700 ms ([hands] unseen_ms)"),
        (Reason.ARM_SILENT, "60 ms ([arm] silent_ms)"),
        (Reason.ARM_ERROR, "0.2 rad ([arm] fault_error_rad)"),
        (Reason.TOOL_SPEED, "1.4 m/s ([tool] fault_speed)"),
    ):
        assert words in explained(member, Evidence(settings=cell)).why
        assert words.partition("(")[2].rstrip(")") in explained(member).why
    for row in BY_WORD.values():
        assert "{" not in what_happened(word(row.member), cell) + row.what_to_do


def test_numbers_in_the_table_are_those_that_decide() -> None:
    for member, words in (
        (Reason.STALE_HAND, f"only {GONE_S:g} s"),
        (Reason.TOOL_SPEED, f"for {1e3 * TOO_FAST_S:g} ms"),
        (Flag.STUCK, f"for {STUCK_S:g} s"),
        (Cause.OLDER, f"more than {TUNING.intake.max_late_s:g} s"),
        (Cause.JUMPED, f"three samples over {1e3 * TUNING.intake.confirmed_s:g} ms"),
        (Condition.ARM_UNSETTLED, f"for {TUNING.intake.max_late_s:g} s"),
    ):
        assert words in BY_WORD[word(member)].what_happened + BY_WORD[word(member)].what_to_do
    # the table spells these numbers out: a quarter, three
    assert (TUNING.intake.contested_on_share, CONFIRMED_SAMPLES) == (0.25, 3)


@pytest.mark.parametrize("busy", ["", "the loop was up to 45 ms late"])
@pytest.mark.parametrize(
    ("share", "cause", "told"),
    [
        (0.0, "", ""),
        (0.1, "older", ""),
        (0.3, "", "30% of the arm's states in the last second contradict the rest"),
        (0.02, "jumped", "states of the arm were rejected as jumped: elbow from 1 to 2 rad"),
    ],
)
def test_contradicting_states_are_explained_by_two_drivers(
    busy: str, share: float, cause: str, told: str
) -> None:
    """An arm error amid states that contradict each other is explained by two drivers."""
    arm = Source(
        rate_hz=500.0, fresh=True, contested=share, cause=cause, refused="elbow from 1 to 2 rad"
    )
    evidence = Evidence({"arm": arm}, contested=0.1, busy=busy)
    evidence = evidence._replace(error_rad=(0.12, 0.1), worst_joint=("elbow", 0.24, "rad"))
    explanation = explained(Reason.ARM_ERROR, evidence)
    assert "a joint was 0.120 rad off" in explanation.why
    assert explanation.what_to_do.endswith("then thirdhand reset")
    assert explanation.why.startswith(told)
    assert ("two drivers publish joints/state" in explanation.what_to_do) is bool(told)
    assert ("too busy" in explanation.why) is (bool(busy) and not told)
