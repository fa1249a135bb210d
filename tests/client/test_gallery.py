"""Each program of docs/gallery.md has at most ten lines and runs as it stands."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell import LISTENING, Tracker, serving
from support.cell_commands import python
from support.paths import ROOT

PAGE = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
PROGRAMS = dict(re.findall(r"## (.+?)\n.*?```python\n(.*?)```", PAGE, re.DOTALL))
# words of what each one prints
PRINTED = {
    "Say what the cell does, and why": "follow",
    "How sure is the target?": "± ",
    "Two streams at once": " mm from the target",
    "Hold, and go on": "operator ",
    "Teach a via-point": "'tip'",
    "Follow the commands": " +",
    "All cells of a network": "thirdhand follow",
    "What happened in a recording?": "'NONE'",
}
LED = "Let a policy lead"


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """The endpoint of a cell that follows two hands, and its recording."""
    folder = tmp_path_factory.mktemp("cell")
    records = folder / "records"
    arguments = ("--joints", "assumed", "--record", str(records))
    with serving(folder, *arguments) as daemon, Tracker(daemon.session):
        daemon.until(lambda status: status["mode"] == "follow" and status["tick"] > 2500)
        yield daemon.endpoint, str(next(records.glob("*.mcap")))


def output(name: str, endpoint: str, *arguments: str) -> str:
    """What a program prints."""
    code = PROGRAMS[name]
    assert len([line for line in code.splitlines() if line]) <= 10
    done = python(code, *arguments, env=os.environ | {"THIRDHAND_CONNECT": endpoint})
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.timeout(180)
def test_every_program_runs_in_their_order(cell: tuple[str, str]) -> None:
    assert len(PROGRAMS) == 12
    for name in (name for name in PROGRAMS if name != LED):
        assert PRINTED.get(name, "") in output(name, *cell), name


@pytest.mark.timeout(180)
def test_the_program_of_a_policy_leads_the_tool(tmp_path: Path) -> None:
    network = f'{LISTENING}\n[skill]\nsource = "tool/wish"\n'
    with serving(tmp_path, "--joints", "assumed", network=network) as daemon:
        before = daemon.until(lambda status: status["tool_m"] is not None)["tool_m"]
        output(LED, daemon.endpoint)
        after = daemon.client.status().tool_m
    assert after is not None
    assert abs(after[1] - before[1]) > 0.01
