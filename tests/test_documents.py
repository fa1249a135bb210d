"""The manual for incidents tells of every mode, reason, flag and counter; the table of faults names
tests that are there and the figures that were measured.
"""

from __future__ import annotations

import json
import re

import pytest
from tests_paths import ROOT

from service.contract.records import Cause, Flag, Mode, Reason

FAULTS = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
MEASURED = json.loads((ROOT / "recordings" / "experiments" / "faults.json").read_text(encoding="utf-8"))["faults"]
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


def rows_of_faults() -> list[list[str]]:
    """The cells of each row of the tables of faults."""
    lines = (line for line in FAULTS.splitlines() if line.startswith("| ") and not line.startswith("| fault |"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_each_fault_names_a_test_that_is_there() -> None:
    rows = rows_of_faults()
    assert len(rows) >= len(MEASURED) + 10
    for *_, tests in rows:
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", tests)
        assert named, tests
        for file, test in named:
            assert f"\ndef {test}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}::{test}"


def test_each_fault_has_the_figures_that_were_measured() -> None:
    rows = {row[0]: row[2:6] for row in rows_of_faults() if len(row) == 7}
    assert set(rows) == set(MEASURED)
    for name, one in MEASURED.items():
        figures = (one.get(key) for key in ("hold_ms", "rest_ms", "travelled_mm", "lost_ticks"))
        assert rows[name] == ["-" if value is None else f"{value:.0f}" for value in figures], name
