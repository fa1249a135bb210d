"""`replay --each` and `report` over several files: by one process, two, or a cluster."""

from __future__ import annotations

import shutil

import pytest

from support.cell import told
from support.cell_commands import python
from support.in_process import record, ticks_of
from thirdhand.core.skill.skill import Skill
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

NAMES = ("a.mcap", "b.mcap", "broken.mcap", "c.mcap")
DASK = """
import sys
from distributed import LocalCluster
from thirdhand.command_line import main
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        code = main([*sys.argv[1:], "--workers", f"dask:{cluster.scheduler_address}"])
    sys.exit(code)
"""


@pytest.fixture(scope="module")
def files(skill: Skill, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three short recordings, one of which is cut."""
    folder = tmp_path_factory.mktemp("many")
    record(folder / "a.mcap", skill, list(ticks_of(HandScript(Scene(), seed=4)))[:200])
    for name in NAMES[1:]:
        shutil.copy(folder / "a.mcap", folder / name)
    (folder / "broken.mcap").write_bytes((folder / "a.mcap").read_bytes()[:30_000])
    return [str(folder / name) for name in NAMES]


def named_failures(errors: str) -> list[str]:
    return [line for line in errors.splitlines() if line.startswith("thirdhand ")]


@pytest.mark.parametrize(
    "command", [("replay", "--each", "--exact"), ("report",)], ids=["replay", "report"]
)
@pytest.mark.one_case
def test_two_workers_print_what_one_process_prints(
    command: tuple[str, ...], files: list[str]
) -> None:
    """A damaged file does not stop the workers."""
    alone = told(*command, *files)
    assert alone.returncode == 1
    assert [
        name
        for name in NAMES
        if f"{name}: 200 ticks" in alone.stdout or f"{name}\n" in alone.stdout
    ] == [name for name in NAMES if name != "broken.mcap"]
    first, last = named_failures(alone.stderr)
    assert "broken.mcap is cut" in first
    assert last == f"thirdhand {command[0]}: 1 of 4 files cannot be used"
    shared = told(*command, *files, "--workers", "2")
    assert (shared.returncode, shared.stdout) == (1, alone.stdout)
    assert named_failures(shared.stderr) == [first, last]


@pytest.mark.thorough
def test_cluster_prints_what_one_process_prints(files: list[str]) -> None:
    pytest.importorskip("distributed")
    command = ["replay", "--each", *files]
    done = python(DASK, *command, timeout=110)
    alone = told(*command)
    assert (done.returncode, done.stdout) == (alone.returncode, alone.stdout), done.stderr
    assert named_failures(done.stderr) == named_failures(alone.stderr)
