"""The manual for incidents tells of every mode, reason, flag and counter; the table of faults names
tests that are there and the figures that were measured. The tables of the wire and of ROS 2's
topics are the table of channels.
"""

from __future__ import annotations

import json
import re

import pytest
from tests_paths import ROOT

from service.contract import ros2
from service.contract.channels import CHANNELS, Channel
from service.contract.records import Cause, Flag, Mode, Reason
from service.contract.roles import ROLES

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


def rows_of(page: str, first: str) -> list[str]:
    """The rows of a page's tables that begin so."""
    lines = (ROOT / "docs" / page).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith(first)]


def says(channel: Channel) -> str:
    """Who publishes or answers on a channel."""
    if channel.direction == "out":
        return "the service" + ", which answers too" * channel.queryable
    if channel.direction == "request":
        return "the service answers"
    return next((name for name, role in ROLES.items() if channel.key in role.publishes), "who demonstrates")


def test_the_table_of_the_wire_is_the_table_of_channels() -> None:
    assert rows_of("wire.md", "| `<cell>/") == [
        f"| `<cell>/{channel.key}` | `{channel.codec.type}` | `application/{channel.codec.encoding}` | "
        f"{says(channel)} | {channel.rate} | {channel.about} |"
        for channel in CHANNELS
        if channel.direction != "recording"
    ]


def test_the_table_of_topics_is_what_ros2_is_told() -> None:
    does = {True: "subscribes | best effort, volatile", False: "publishes | reliable, volatile"}
    assert rows_of("ros2.md", "| `/<cell>/") == [
        f"| `/<cell>/{channel.key}` | `{ros2.type_of(channel)}`{', JSON' * (channel.codec.encoding == 'json')} | "
        f"{does[channel in ros2.HEARD]} |"
        for channel in (*ros2.HEARD, *ros2.SAID)
    ]
