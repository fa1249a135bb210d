"""Backup and restore, by the commands that docs/operate.md prints."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from support.cell import serving
from support.paths import RECORDINGS, ROOT
from thirdhand.client import Client
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.settings.config import Files, Settings
from thirdhand.skills.skill_file import skill_in
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene

PAGE = (ROOT / "docs" / "operate.md").read_text(encoding="utf-8")


def commands(title: str) -> list[str]:
    """The commands in the page's block below this heading."""
    block = re.search(rf"^### {title}$.*?^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert block is not None
    return block[1].splitlines()


def run_in(root: Path, command: str) -> None:
    """Run a command of the page with this folder as the root of the file system."""
    done = subprocess.run(
        command.replace("sudo ", "").replace("-C /", f"-C {root}"),
        shell=True,
        cwd=root,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_cell_is_restored_by_the_commands_of_the_page(tmp_path: Path) -> None:
    backup = commands("Back up")
    restore = commands("Restore")
    assert len(backup) + len(restore) <= 4
    assert [line.split()[1:3] for line in restore if "systemctl" in line] == [
        ["systemctl", "stop"],
        ["systemctl", "start"],
    ]
    home = tmp_path / "var/lib/thirdhand"
    config = tmp_path / "etc/thirdhand/bench.toml"
    saved = SavedViaPoints(Settings(files=Files(state=str(home / ".local/state/thirdhand"))))
    skill = adapted(skill_in(RECORDINGS / "soldering.npz"), Scene().via_points(), tolerance=0.04)
    with saved.replacing(skill):
        pass
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
    with serving(folder, "--joints", "assumed") as daemon:
        assert Client(daemon.session).status().via_points == tuple(
            point.name for point in Scene().via_points()
        )
        assert "via-points of an earlier run are in force (3)" in daemon.log.read_text()
