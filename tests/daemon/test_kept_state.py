"""What a cell keeps is read by later versions: `kept/` has, for each version whose formats were
released, files as that version wrote them. They are never written anew; a version with other
formats gets a folder of its own. Backup and restore are run as docs/operate.md prints them.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import pytest

from service.client import Client
from service.daemon.saved_stage import SavedStage
from service.daemon.saved_via_points import SavedViaPoints
from service.daemon.single_instance import state_folder
from service.learning.skill_file import skill_in
from service.settings.config import Files, RetiredSettingWarning, Settings, load
from sim.scene import Scene
from support.cell import serving
from support.paths import ROOT

KEPT = Path(__file__).with_name("kept")
VERSIONS = sorted(path.name for path in KEPT.iterdir())
PAGE = (ROOT / "docs" / "operate.md").read_text(encoding="utf-8")


def put_back(version: str, settings: Settings) -> None:
    """Put a version's saved state where a cell with these settings looks for it."""
    folder = state_folder(settings)
    folder.mkdir(parents=True)
    for path in (KEPT / version).glob("*.json"):
        shutil.copy(path, folder)


@pytest.mark.parametrize("version", VERSIONS)
def test_settings_skill_via_points_and_stage_of_each_version_are_read(version: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RetiredSettingWarning)
        settings = load(KEPT / version / "bench.toml")
    assert (settings.cell, settings.rate_hz, settings.hands.stale_ms) == ("lab/bench2", 250, 150)
    assert (settings.trackers["vicon"].unit, settings.network.ros2_domain, settings.skill.lead_s) == ("m", 7, 0.1)
    assert len(settings.obstacles.boxes) == 1

    plain = Settings(cell="lab/bench2", files=Files(state=str(tmp_path)))
    put_back(version, plain)
    skill = skill_in(KEPT / version / "soldering.npz")
    assert (skill.name, skill.model.names[:2]) == ("soldering", ("start", "handover"))
    read = SavedViaPoints(plain).read(skill)
    assert read is not None
    assert (read[0], read[1]) == (Scene().via_points(), 0.04)
    for path in state_folder(plain).iterdir():
        os.utime(path)  # a stage is kept for ten minutes
    assert SavedStage(plain).read(skill) == "handover"
    assert not list(tmp_path.rglob("*.damaged"))


def commands(title: str) -> list[str]:
    """The commands of the block of the page that follows this heading."""
    block = re.search(rf"^### {title}$.*?^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert block is not None
    return block[1].splitlines()


def run_in(root: Path, command: str) -> None:
    """Run a command of the page with this folder in the place of the root of the file system."""
    done = subprocess.run(
        command.replace("sudo ", "").replace("-C /", f"-C {root}"),
        shell=True, cwd=root, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_a_cell_is_restored_from_its_backup_by_the_commands_of_the_page(tmp_path: Path) -> None:
    backup, restore = commands("Back up"), commands("Restore")
    assert len(backup) + len(restore) <= 4
    assert [line.split()[1:3] for line in restore if "systemctl" in line] == [
        ["systemctl", "stop"],
        ["systemctl", "start"],
    ]
    home, config = tmp_path / "var/lib/thirdhand", tmp_path / "etc/thirdhand/bench.toml"
    plain = Settings(files=Files(state=str(home / ".local/state/thirdhand")))
    put_back(VERSIONS[-1], plain)
    config.parent.mkdir(parents=True)
    config.write_text("[people]\nclearance = 0.05\n")
    for name in ("recordings/large.mcap", ".cache/numba/x.nbi"):
        (home / name).parent.mkdir(parents=True)
        (home / name).write_bytes(b"not in the backup")

    for command in backup:
        run_in(tmp_path, command)
    shutil.rmtree(tmp_path / "var")
    shutil.rmtree(tmp_path / "etc")
    for command in (line for line in restore if "systemctl" not in line):
        run_in(tmp_path, command)

    assert config.read_text() == "[people]\nclearance = 0.05\n"
    assert not (home / "recordings").exists()
    assert not (home / ".cache").exists()
    folder = tmp_path / "started"
    folder.mkdir()
    shutil.copytree(home / ".local/state/thirdhand", folder / "state")
    skill = str(KEPT / VERSIONS[-1] / "soldering.npz")
    with serving(folder, "--arm", "assumed", "--skill", skill) as daemon:
        assert Client(daemon.session).status().places == tuple(point.name for point in Scene().via_points())
        assert "via-points of an earlier run are in force (3)" in daemon.log.read_text()
