"""`thirdhand tune`: what it prints, draws and refuses."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from service.cli import tune
from service.report.variants import CHANGES
from support.cell import told
from support.paths import RECORDINGS

GOLDEN = str(RECORDINGS / "golden.mcap")
TAKE = str(RECORDINGS / "demonstration-1.mcap")


@pytest.mark.timeout(300)
def test_settings_are_tried_on_a_recording(tmp_path: Path) -> None:
    plot = tmp_path / "tune.png"
    done = told("tune", GOLDEN, "--part", "2", "4.2", "--json", "--plot", str(plot))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [one["name"] for one in found["variants"]][:2] == ["as recorded", "follow = closely"]
    assert len(found["variants"]) == len(CHANGES)  # "as recorded", and all but the recording's own `follow`
    assert found["judged_s"] > 2.0
    left = found["hands"]["left"]
    assert left["noise_mm"] == pytest.approx(0.5, abs=0.15)
    assert found["variants"][0]["rejected"] == {}  # the samples that are rejected come later
    assert tomllib.loads(found["best"]["toml"]) == found["best"]["change"]
    assert plot.stat().st_size > 20_000


@pytest.mark.timeout(300)
def test_a_take_is_tuned_with_the_shipped_cell_and_skill(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune, "CHANGES", CHANGES[:6])
    done = told("tune", TAKE, "--part", "3", "8")
    assert done.returncode == 0, done.stderr
    assert "has no settings: those of the shipped cell are used; --config gives others" in done.stderr
    assert "has no skill: soldering, which is shipped, is used; --skill gives another" in done.stderr
    for words in (
        "Noise and tremor of the hands",
        "Settings, and how the tool follows",
        "as recorded",
        "max_jerk = 100",
    ):
        assert words in done.stdout
    assert "Leave the settings." in done.stdout or "Write into the cell's settings:\n\n[" in done.stdout


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files that cannot be tuned to."""
    folder, whole = tmp_path_factory.mktemp("broken"), Path(GOLDEN).read_bytes()
    (folder / "head.mcap").write_bytes(whole[:3000])
    (folder / "text.mcap").write_text("no recording", encoding="utf-8")
    (folder / "skill.npz").write_bytes(b"no skill")
    return folder


@pytest.mark.parametrize(("words", "code", "arguments"), [
    ("is cut before its first message", 1, ("tune", "head.mcap")),
    ("text.mcap is not an MCAP file", 1, ("tune", "text.mcap")),
    ("no recording nowhere.mcap", 1, ("tune", "nowhere.mcap")),
    ("joints fr3_joint1, fr3_joint2", 1, ("tune", GOLDEN, "--config", "franka")),
    ("the arm follows for", 1, ("tune", GOLDEN, "--part", "8.9", "9.7")),
    ("two times [s], the first below the second, needed", 2, ("tune", GOLDEN, "--part", "5", "4")),
    ("skill.npz", 1, ("tune", GOLDEN, "--skill", "skill.npz")),
    ("a name that ends in .png needed", 2, ("tune", GOLDEN, "--plot", "tune.jpg")),
])  # fmt: skip
def test_a_mistake_is_explained(
    words: str, code: int, arguments: tuple[str, ...], broken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(broken)
    done = told(*arguments)
    assert done.returncode == code, done.stderr
    assert words in done.stderr
    assert done.stdout == ""
