"""The pages agree with the code: status, faults with their figures, tests of promises, the wire,
ROS 2 topics, commands, options, settings and files. Retired words of the glossary are not used.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np
import pytest

import thirdhand_sim.__main__
from support.paths import ROOT
from thirdhand import command_line as main
from thirdhand.contract import incidents, requests, ros2
from thirdhand.contract.channels import CHANNELS, Channel, topic
from thirdhand.contract.messages import BASE
from thirdhand.contract.roles import ROLES
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import FRAME, TIMING_FIELDS
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import Settings, robot_description
from thirdhand.viewer.blueprint import plot_views

FAULTS = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
MEASURED = json.loads(
    (ROOT / "recordings" / "experiments" / "faults.json").read_text(encoding="utf-8")
)["faults"]
STATUS = (ROOT / "docs" / "status.md").read_text(encoding="utf-8")


def table(head: str) -> list[list[str]]:
    """The rows of the table with this head on the page about the status, as cells."""
    lines = STATUS[STATUS.index(f"\n| {head} |") :].lstrip().split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_page_on_the_status_lists_its_fields_and_no_others() -> None:
    def named(cells: Iterable[str]) -> list[str]:
        return sorted(word for cell in cells for word in re.findall(r"`(\w+)`", cell))

    assert named(row[0] for row in table("field")) == sorted(requests.Status.__struct_fields__)
    assert named(row[0] for row in table("of a source")) == sorted(
        requests.Source.__struct_fields__
    )
    scribe = next(row[1] for row in table("field") if row[0] == "`scribe`")
    assert named([scribe]) == sorted(Scribe(Settings()).status())


def test_what_to_do_names_fields_settings_and_causes_that_exist() -> None:
    settings = msgspec.to_builtins(Settings())
    terms = {*requests.Status.__struct_fields__, *incidents.BY_WORD, *settings, BASE}
    for section in settings.values():
        if isinstance(section, dict):
            terms |= section.keys()
    named = {
        name
        for row in incidents.BY_WORD.values()
        for name in re.findall(r"`([a-z]+(?:_[a-z]+)*)`", row.what_to_do)
    }
    assert {"hand_age_ms", "rejected", "older", "keep_mb"} <= named <= terms


def test_each_view_that_a_page_names_by_its_title_exists() -> None:
    titles = {view.title for view in plot_views(Settings()).values()}
    for name in ("incidents.md", "viewing.md"):
        text = (ROOT / "docs" / name).read_text(encoding="utf-8")
        named = {
            " ".join(title.split())
            for title in re.findall(r"""["`]([A-Z][^"`]*\[[^]]+\])["`]""", text)
        }
        assert named <= titles
        assert named or name != "incidents.md"


def test_the_table_of_signs_is_that_of_the_shipped_arm() -> None:
    text = (ROOT / "docs" / "hardware.md").read_text(encoding="utf-8")
    arm = ArmStage(Settings(), robot_description(Settings()))
    names = Settings().joints.names
    begin = np.array([0.0, 0.5, 0.0, 1.5, 0.0, -1.0, 0.0])
    rows = re.findall(r"\| `(wam/\w+)` \| (-?\d+) \| (-?\d+) \| (-?\d+) \|", text)
    assert [row[0] for row in rows] == list(names)
    for i, (_, *written_mm) in enumerate(rows):
        moved = arm.at(begin + 0.3 * (np.arange(7) == i)).position - arm.at(begin).position
        np.testing.assert_allclose(1000 * moved, [float(v) for v in written_mm], atol=0.51)
    assert "({:.3f}, {:.3f}, {:.3f}) m".format(*arm.at(begin).position) in text
    assert f"{arm.at(np.zeros(7)).position[2]:.3f} m above" in text


def cells_below(text: str, head: str) -> list[list[str]]:
    """The rows of all tables in a text whose first column has this head, as cells."""
    tables = re.findall(rf"^\| {head} \|.*\n\|---.*\n((?:\|.*\n?)+)", text, flags=re.MULTILINE)
    return [
        [cell.strip() for cell in row.strip("|").split("|")]
        for rows in tables
        for row in rows.splitlines()
    ]


@pytest.mark.parametrize(
    ("page", "head", "least"),
    [("faults.md", "fault", len(MEASURED) + 10), ("bounds.md", "bound", 10)],
)
def test_promises_of_the_appendix_have_tests(page: str, head: str, least: int) -> None:
    """The tests exist."""
    promises = [
        row[0] for row in cells_below((ROOT / "docs" / page).read_text(encoding="utf-8"), head)
    ]
    rows = cells_below((ROOT / "docs" / "evidence.md").read_text(encoding="utf-8"), head)
    assert [row[0] for row in rows] == promises
    assert len(rows) >= least
    for promise, tests in rows:
        named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", tests)
        assert named, promise
        for file, test in named:
            text = (ROOT / file).read_text(encoding="utf-8")
            assert re.search(
                rf"^(def|class) {test}\b" if test else r"^def test_|^class Test", text, re.MULTILINE
            ), tests


def test_each_fault_that_was_measured_has_a_row_with_its_figures() -> None:
    assert {row[0] for row in cells_below(FAULTS, "fault") if len(row) == 6} == set(MEASURED)


def rows_of(page: str, first: str) -> list[str]:
    """The rows of a page's tables that begin with this text."""
    lines = (ROOT / "docs" / page).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith(first)]


def publisher(channel: Channel) -> str:
    """The role that publishes on a channel or answers there."""
    if channel.direction == "out":
        return "the service" + ", which answers too" * channel.queryable
    if channel.direction == "request":
        return "the service answers"
    return next(
        (name for name, role in ROLES.items() if channel.key in role.publishes), "who demonstrates"
    )


def test_the_table_of_the_wire_is_the_table_of_channels() -> None:
    assert rows_of("wire.md", "| `<cell>/") == [
        f"| `<cell>/{channel.key}` | `{channel.codec.type}` | "
        f"`application/{channel.codec.encoding}` | {publisher(channel)} | {channel.rate} | "
        f"{channel.about}{channel.condition and f'; heard with {channel.condition}'} |"
        for channel in CHANNELS
        if channel.direction != "recording"
    ]


def test_the_table_of_topics_is_that_of_the_ros2_node() -> None:
    does = {True: "subscribes | best effort, volatile", False: "publishes | reliable, volatile"}
    assert rows_of("ros2.md", "| `/<cell>/") == [
        f"| `/<cell>/{channel.key}` | "
        f"`{ros2.type_of(channel)}`{', JSON' * (channel.codec.encoding == 'json')} | "
        f"{does[channel in ros2.HEARD]} |"
        for channel in (*ros2.HEARD, *ros2.SAID)
    ]


def test_foxglove_layout_shows_existing_topics() -> None:
    """A recording has these topics and fields."""
    layout = json.loads((ROOT / "docs" / "foxglove-layout.json").read_text(encoding="utf-8"))
    fields = {
        topic("thirdhand", name): {field.name for field in fields}
        for name, fields in (("frame", FRAME), ("timing", TIMING_FIELDS))
    }
    text = json.dumps(layout)
    topics = {topic("thirdhand", channel.key) for channel in CHANNELS if channel.recorded}
    scene_topics = set(layout["configById"]["3D!scene"]["topics"])
    assert {
        "/robot_description",
        "/thirdhand/objects",
        "/thirdhand/hands/left",
        "/thirdhand/tool/target",
    } <= scene_topics
    assert scene_topics <= topics
    named = re.findall(r'"(/thirdhand/\w+)\.(\w+)', text)
    assert len(named) >= 8
    assert all(field in fields.get(name, {"data"}) and name in topics for name, field in named)

    def panels(part: object) -> set[str]:
        return (
            panels(part["first"]) | panels(part["second"])
            if isinstance(part, dict)
            else {str(part)}
        )

    assert panels(layout["layout"]) == set(layout["configById"])


# All pages except the log of changes.
FOLDERS = (ROOT, ROOT / "docs", ROOT / "kmp", ROOT / "kmp" / "docs", ROOT / "recordings")
ALL_PAGES = [path for folder in FOLDERS for path in folder.glob("*.md")]
PAGES = sorted(path for path in ALL_PAGES if path.name != "CHANGELOG.md")


def commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands below a parser."""
    kind = argparse._SubParsersAction  # noqa: SLF001
    actions = (action for action in parser._actions if isinstance(action, kind))  # noqa: SLF001
    return {name: command for action in actions for name, command in action.choices.items()}


def options(parser: argparse.ArgumentParser) -> set[str]:
    """The options of a command and of the commands below it."""
    return {*parser._option_string_actions}.union(*map(options, commands(parser).values()))  # noqa: SLF001


OPTIONS = {
    name: options(command)
    for name, command in (
        commands(main.parser()) | {"sim": thirdhand_sim.__main__.parser()}
    ).items()
}
TABLES = {
    name: set(section)
    for name, section in msgspec.to_builtins(Settings()).items()
    if isinstance(section, dict)
}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_on_a_page_exist(page: Path) -> None:
    """The names are those of commands, options, settings and files."""
    text = page.read_text(encoding="utf-8")
    code = re.findall(r"```(?:sh|console)\n(.*?)```|(?<!`)`([^`\n]+)`(?!`)", text, re.DOTALL)
    for name, arguments in re.findall(
        r"(?:^|\s)thirdhand ([a-z][a-z-]*)([^|&#\n]*)", "\n".join(map("".join, code))
    ):
        assert name in OPTIONS, f"thirdhand {name}"
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", arguments)) <= OPTIONS[name] | {
            "--help"
        }, name + arguments
    for table, name in re.findall(r"\[(\w+)\] (\w+)", text):
        assert table not in TABLES or name in TABLES[table], f"[{table}] {name}"
    for file in re.findall(r"`((?:service|sim|kmp|tests|docs|examples)/[\w./-]+\.\w+)`", text):
        assert (ROOT / file).exists(), file


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_prose_has_lines_of_100_characters_at_most(page: Path) -> None:
    text = re.sub(
        r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    assert [
        line
        for line in text.splitlines()
        if len(line) > 100 and not line.startswith(("|", "!", "<!--"))
    ] == []
