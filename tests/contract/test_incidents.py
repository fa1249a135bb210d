"""Why it does what it does is said in one place: a member that is not explained there does not pass
the type checker, and what is added is named in no other room.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from service.contract.incidents import MALFORMED, Evidence, Member, explained, in_full, remedy, word
from service.contract.records import Cause, Flag, Mode, Reason
from service.contract.requests import Source
from support.paths import ROOT

MEMBERS: tuple[Member, ...] = (*Mode, *Reason, *Flag, *Cause, MALFORMED)


def test_each_member_has_a_word_of_its_own_a_sentence_and_something_to_do() -> None:
    assert (word(Reason.NONE), explained(Reason.NONE).why) == ("", "")
    members = [member for member in MEMBERS if member is not Reason.NONE]
    assert len({word(member) for member in members}) == len(members)
    assert all(explained(member).why and explained(member).what_to_do for member in members)


def test_a_new_member_does_not_type_check_until_it_is_explained(tmp_path: Path) -> None:
    """A contributor's first step, and what the type checker answers."""
    shutil.copytree(ROOT / "service" / "contract", tmp_path / "service" / "contract")
    (tmp_path / "service" / "__init__.py").touch()
    records = tmp_path / "service" / "contract" / "records.py"
    text = records.read_text(encoding="utf-8")
    for kind in (Mode, Reason, Flag, Cause):
        first = f"    {next(iter(kind)).name} = "
        assert text.count(first) == 1
        text = text.replace(first, f"    PLANTED = 64\n{first}")
    records.write_text(text, encoding="utf-8")
    command = (sys.executable, "-m", "mypy", "--strict", "service/contract/incidents.py")
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False, cwd=tmp_path)
    errors = re.findall(r'error: .* "Literal\[(\w+).PLANTED\]"; expected "Never"', done.stdout)
    assert sorted(errors) == ["Cause", "Flag", "Mode", "Reason"], done.stdout


def test_a_reason_is_named_where_it_is_decided_and_explained_and_hardly_elsewhere() -> None:
    """So a new one needs `records.py`, `incidents.py` and the stage that decides it."""
    named = {
        (str(path.relative_to(ROOT / "service")), found)
        for path in (ROOT / "service").rglob("*.py")
        if not path.is_relative_to(ROOT / "service" / "core") and not path.is_relative_to(ROOT / "service" / "contract")
        for found in re.findall(r"\bReason\.([A-Z_]+)", path.read_text(encoding="utf-8"))
    }
    assert named == {
        ("cli/diagnosis.py", "TWO_SOURCES"),  # that `doctor` foresees
        ("daemon/daemon.py", "ARM_NOT_READY"),  # before the first tick
        ("daemon/status.py", "NONE"),
        ("demonstrations/track_check.py", "NONE"),  # takes are checked as live hands are
        ("demonstrations/track_check.py", "TWO_SOURCES"),
    }


def test_without_figures_the_sentence_is_the_general_one_and_with_them_theirs() -> None:
    off = Evidence(gate_m=(0.123, 0.1), measure="the target's standard deviation")
    assert explained(Reason.FAR_FROM_DEMONSTRATIONS).why.startswith("the skill is not sure")
    found = "the target's standard deviation is 12.3 cm, 10.0 accepted"
    assert explained(Reason.FAR_FROM_DEMONSTRATIONS, off).why == found
    assert explained(Reason.TWO_SOURCES, off).why == explained(Reason.TWO_SOURCES).why
    assert explained(Reason.OPERATOR, off) == explained(Reason.OPERATOR)


def test_where_all_of_a_source_is_rejected_the_remedy_is_that_of_the_cause() -> None:
    refused = Source(rate_hz=100.0, cause="wrong_frame", refused="frame 'camera'; 'base' or none accepted")
    sources = {"left": Source(fresh=True), "right": refused}
    found = explained(Reason.NO_HANDS, Evidence(sources))
    assert found.what_to_do == remedy("wrong_frame")
    assert found.why.startswith("the right hand has not been seen yet, as what comes is rejected as wrong_frame: frame")
    assert explained(Reason.NO_HANDS, Evidence({"right": Source()})).what_to_do == remedy("no_hands")


def test_two_sources_are_told_by_the_one_that_contradicts_most_or_scatters_most() -> None:
    calm, wild = Source(rate_hz=100.0, scatter_mm=1.0), Source(rate_hz=100.0, contested=0.4, scatter_mm=15.0)
    seen = Evidence({"left": calm, "right": wild}, contested=0.25, scatter_mm=12.0)
    told = "right hand, in the last second: 40% of what came contradicts the rest"
    assert explained(Reason.TWO_SOURCES, seen).why == told
    told = "right hand, in the last second: what came scatters by 15 mm an axis, 12 accepted"
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
    assert remedy("no such word") == remedy("follow") == ""
