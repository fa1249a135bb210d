"""`thirdhand arm`: its output, the files that it writes, and its refusals."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image

from support.cell import told
from support.cell_commands import assert_refused, succeeded
from support.paths import ARMS
from thirdhand.settings.config import Settings, load

UR5 = ARMS / "ur5.urdf"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a first cell for a UR5, and the output of the command."""
    folder = tmp_path_factory.mktemp("arm")
    shutil.copy(UR5, folder / "my.urdf")
    done = succeeded("arm", str(folder / "my.urdf"), "--output", str(folder / "cell.toml"))
    assert done.stderr == ""
    return folder, done.stdout


def test_it_prints_what_was_understood(made: tuple[Path, str]) -> None:
    folder, text = made
    for phrase in (
        "my.urdf: 8 links, 6 joints before the plate",
        "plate     tool0",
        "shoulder_pan_joint           revolute      -6.28     6.28      3.14",
        "are a guess",
        "capsules",
        "reach     0.36 to 0.91 m from (0.00, 0.00, 0.09)",
        "posture   [",
        "can do    in any direction, where the demo's tool goes: 0.80 m/s ([tool]) and ",
        "            along the task, where the demo's tool goes: ",
        "[tool] allows 0.8 m/s and 10 m/s²; a joint in brackets allows less",
        f"next:    thirdhand demo --arm {folder / 'cell.toml'}",
    ):
        assert phrase in text, phrase


def test_what_it_writes_loads_and_is_drawn(made: tuple[Path, str]) -> None:
    folder, _ = made
    cell = load(folder / "cell.toml")
    assert isinstance(cell, Settings)
    assert 'urdf = "my.urdf"  # beside this file' in (folder / "cell.toml").read_text()
    with Image.open(folder / "cell.png") as picture:
        assert min(picture.size) > 500
        # the picture is not empty
        assert len(picture.convert("RGB").resize((60, 30)).getcolors(10_000)) > 20


def test_nothing_that_is_there_is_overwritten(made: tuple[Path, str]) -> None:
    folder, _ = made
    before = {file: file.read_bytes() for file in folder.iterdir()}
    words = "cell.toml exists already: name another file by --output"
    arguments = ("arm", str(folder / "my.urdf"), "--output", str(folder / "cell.toml"))
    assert_refused(1, words, *arguments)
    assert {file: file.read_bytes() for file in folder.iterdir()} == before


ONE_JOINT = """<robot name="r"><link name="l0"/><link name="l1"/><joint name="j0" type="revolute"><parent link="l0"/>
<child link="l1"/><origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="10"/></joint>
</robot>"""


def test_an_arm_that_does_not_move_its_tool_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "one.urdf").write_text(ONE_JOINT)
    done = told("arm", str(tmp_path / "one.urdf"), "--output", str(tmp_path / "cell.toml"))
    assert done.returncode in (1, 2)
    assert "its joints move the tool by 0 mm" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["one.urdf"]
