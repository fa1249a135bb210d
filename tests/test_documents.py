"""The manual for incidents tells of every mode, reason, flag and counter."""

from __future__ import annotations

import pytest
from tests_paths import ROOT

from service.contract.records import Cause, Flag, Mode, Reason

MANUAL = (ROOT / "docs" / "incidents.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "word",
    [str(member.name).lower() for kind in (Mode, Reason, Flag, Cause) for member in kind if member.name != "NONE"],
)
def test_each_word_of_a_status_has_its_row(word: str) -> None:
    rows = [line for line in MANUAL.splitlines() if line.startswith(f"| `{word}` |")]
    assert len(rows) == 1
    assert all(len(cell.strip()) > 3 for cell in rows[0].strip("|").split("|"))


def test_no_row_tells_of_what_is_not_there() -> None:
    known = {str(member.name).lower() for kind in (Mode, Reason, Flag, Cause) for member in kind}
    named = {line.split("`")[1] for line in MANUAL.splitlines() if line.startswith("| `")}
    assert named <= known | {"malformed KEY"}
