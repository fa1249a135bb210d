"""Incidents stand in one table: a member without a row does not import, each is named in no other
room, and the words hold the cell's own settings and the constants that decide.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT
from thirdhand.contract.evidence import Evidence, explained
from thirdhand.contract.incidents import (
    BY_WORD,
    INCIDENTS,
    Condition,
    in_full,
    what_happened,
    what_to_do,
    word,
)
from thirdhand.contract.records import (
    GONE_S,
    Cause,
    Flag,
    Mode,
    Reason,
)
from thirdhand.contract.requests import Source
from thirdhand.core.intake import CONFIRMED_SAMPLES
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import (
    ArmSettings,
    HandSettings,
    Settings,
    ToolSettings,
)

STUCK_S = TUNING.decision.stuck_s
TOO_FAST_S = 1.5 * TUNING.intake.confirmed_s


MEMBERS = [member for kind in (Mode, Reason, Flag, Cause, Condition) for member in kind if member is not Reason.NONE]


def test_each_member_has_one_row_with_words_of_its_own() -> None:
    assert (word(Reason.NONE), tuple(explained(Reason.NONE))) == ("", ("", ""))
    rows = [row for rows in INCIDENTS.values() for row in rows]
    assert sorted(word(row.member) for row in rows) == sorted(map(word, MEMBERS))
    assert all(row.title and row.what_happened and row.what_to_do for row in rows)
    assert len({row.title for row in rows}) == len(rows)
    assert {row.mode for row in rows if isinstance(row.member, Reason)} == {Mode.HOLD, Mode.FAULT}


def test_a_new_member_does_not_import_until_it_is_described(tmp_path: Path) -> None:
    """The first step of a contributor who adds a reason, and the answer."""
    shutil.copytree(ROOT / "service" / "thirdhand" / "contract", tmp_path / "thirdhand" / "contract")
    (tmp_path / "thirdhand" / "__init__.py").touch()
    records = tmp_path / "thirdhand" / "contract" / "records.py"
    text = records.read_text(encoding="utf-8")
    for kind in (Mode, Reason, Flag, Cause):
        first = f"    {next(iter(kind)).name} = "
        assert text.count(first) == 1
        text = text.replace(first, f"    PLANTED_{kind.__name__.upper()} = 128\n{first}")
    records.write_text(text, encoding="utf-8")
    command = (sys.executable, "-c", "import thirdhand.contract.incidents")
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False, cwd=tmp_path)
    planted = "planted_cause, planted_flag, planted_mode, planted_reason"
    assert done.stderr.splitlines()[-1] == f"NotImplementedError: no incident is described for {planted}"


def test_a_reason_is_named_where_it_is_decided_and_explained_and_hardly_elsewhere() -> None:
    """So a new one needs `records.py`, `incidents.py` and the segment that decides it."""
    package = ROOT / "service" / "thirdhand"
    named = {
        (str(path.relative_to(package)), found)
        for path in package.rglob("*.py")
        if path.relative_to(package).parts[0] not in ("core", "contract")
        for found in re.findall(r"\bReason\.([A-Z_]+)", path.read_text(encoding="utf-8"))
    }
    assert named == {
        ("cli/diagnosis.py", "TWO_SOURCES"),  # that `doctor` foresees
        ("daemon/daemon.py", "ARM_NOT_READY"),  # before the first tick
        ("daemon/status.py", "NONE"),
        ("workbench/takes/track_check.py", "NONE"),  # takes are checked as live hands are
        ("workbench/takes/track_check.py", "TWO_SOURCES"),
    }


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
        (Reason.TWO_SOURCES, f"more than {1e3 * TUNING.intake.scatter_on_m:g} mm"),
        (Reason.TOOL_SPEED, f"for {1e3 * TOO_FAST_S:g} ms"),
        (Flag.STUCK, f"for {STUCK_S:g} s"),
        (Cause.OLDER, f"more than {TUNING.intake.max_late_s:g} s"),
        (Cause.JUMPED, f"three samples over {1e3 * TUNING.intake.confirmed_s:g} ms"),
        (Cause.SWAPPED, f"after {TUNING.intake.swapped_s:g} s"),
        (Condition.ARM_UNSETTLED, f"for {TUNING.intake.max_late_s:g} s"),
    ):
        assert words in BY_WORD[word(member)].what_happened + BY_WORD[word(member)].what_to_do
    assert (TUNING.intake.contested_on_share, CONFIRMED_SAMPLES) == (0.25, 3)  # in words: a quarter, three


def test_without_figures_the_sentence_is_the_general_one_and_with_them_theirs() -> None:
    off = Evidence(gate_m=(0.123, 0.1), measure="the target's standard deviation")
    assert explained(Reason.FAR_FROM_DEMONSTRATIONS).why.startswith("the hands are farther")
    found = "the target's standard deviation is 12.3 cm, 10.0 accepted"
    assert explained(Reason.FAR_FROM_DEMONSTRATIONS, off).why == found
    assert explained(Reason.TWO_SOURCES, off).why == explained(Reason.TWO_SOURCES).why
    assert explained(Reason.OPERATOR, off) == explained(Reason.OPERATOR)


def test_where_all_of_a_source_is_rejected_the_remedy_is_that_of_the_cause() -> None:
    refused = Source(rate_hz=100.0, cause="wrong_frame", refused="frame 'camera'; 'base' or none accepted")
    sources = {"left": Source(fresh=True), "right": refused}
    found = explained(Reason.NO_HANDS, Evidence(sources))
    assert found.what_to_do == what_to_do("wrong_frame")
    assert found.why.startswith(
        "the right hand has not been seen yet, as what arrives is rejected as wrong_frame: frame"
    )
    assert explained(Reason.NO_HANDS, Evidence({"right": Source()})).what_to_do == what_to_do("no_hands")


def test_two_sources_are_told_by_the_one_that_contradicts_most_or_scatters_most() -> None:
    calm, wild = Source(rate_hz=100.0, scatter_mm=1.0), Source(rate_hz=100.0, contested=0.4, scatter_mm=15.0)
    seen = Evidence({"left": calm, "right": wild}, contested=0.25, scatter_mm=12.0)
    told = "right hand, in the last second: 40% of the samples contradict the rest"
    assert explained(Reason.TWO_SOURCES, seen).why == told
    told = "right hand, in the last second: the samples scatter by 15 mm on each axis, 12 accepted"
    assert explained(Reason.TWO_SOURCES, seen._replace(contested=0.5)).why == told


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
def test_an_arm_error_amid_states_that_contradict_each_other_is_explained_by_two_drivers(
    busy: str, share: float, cause: str, told: str
) -> None:
    arm = Source(rate_hz=500.0, fresh=True, contested=share, cause=cause, refused="elbow from 1 to 2 rad")
    seen = Evidence({"arm": arm}, contested=0.1, busy=busy)
    seen = seen._replace(error_rad=(0.12, 0.1), worst_joint=("elbow", 0.24, "rad"))
    found = explained(Reason.ARM_ERROR, seen)
    assert "a joint was 0.120 rad off" in found.why
    assert found.what_to_do.endswith("then thirdhand reset")
    assert found.why.startswith(told)
    assert ("two drivers publish joints/state" in found.what_to_do) is bool(told)
    assert ("too busy" in found.why) is (bool(busy) and not told)


def test_a_term_is_followed_by_what_there_is_to_say() -> None:
    assert in_full("", "") == ""
    assert in_full("a hand", "look") == ": a hand. What to do: look"
    assert what_to_do("no such word") == what_happened("no such word") == ""
