"""The stage of the task: asked for by name, told in the status, kept over a restart."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from service.client import RefusedError
from service.core.skill.skill import Skill
from service.daemon.saved_stage import MAX_RESTART_S, SavedStage
from service.daemon.saved_state import MAX_STATE_BYTES, NOT_OURS
from service.daemon.saved_via_points import SavedViaPoints
from service.daemon.single_instance import state_folder
from service.files.shipped import shipped_skill
from service.settings.config import Files, Settings
from support.cell import serving


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(cell="lab/bench2", files=Files(state=str(tmp_path)))


@pytest.fixture
def skill() -> Skill:
    return shipped_skill()


def test_it_is_kept_for_its_skill_and_for_a_while(settings: Settings, skill: Skill, tmp_path: Path) -> None:
    saved = SavedStage(settings)
    assert saved.read(skill) == ""
    saved.keep(skill, ("handover", "glass"), 0.9)
    saved.keep(skill, ("start", "handover"), 0.4)
    assert SavedStage(settings).read(skill) == "handover"
    assert saved.read(replace(skill, learned_from="others")) == ""
    file = tmp_path / "lab/bench2/stage.json"
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    old = file.stat().st_mtime - MAX_RESTART_S - 1.0
    os.utime(file, (old, old))
    assert saved.read(skill) == ""
    for spoilt in ("{", "[]", json.dumps({"learned_from": skill.learned_from, "via_point": 3})):
        file.write_text(spoilt)
        assert saved.read(skill) == ""


def damage(path: Path, how: str) -> None:
    """Puts something in a file's place that cannot be used."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if how == "a folder":
        path.mkdir()
    elif how == "a pipe":
        os.mkfifo(path)
    elif how == "a huge file":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    elif how == "a link to itself":
        path.symlink_to(path)
    else:
        path.write_bytes({"deep brackets": b"[" * 200_000, "no text": b"\xff\xfe", "another kind": b"[3]"}[how])


REASONS = {
    "a folder": ("Is a directory; a file needed, and that is a folder",),
    "a pipe": ("it is not a file",),
    "a huge file": (f"it has {1 << 40} bytes, at most {MAX_STATE_BYTES} accepted",),
    "a link to itself": ("Too many levels of symbolic links",),
}


@pytest.mark.parametrize(
    "how", ["deep brackets", "no text", "another kind", "a folder", "a pipe", "a huge file", "a link to itself"]
)
def test_whatever_is_in_the_place_of_a_saved_file_is_set_aside_and_reported(
    how: str, settings: Settings, skill: Skill, caplog: pytest.LogCaptureFixture
) -> None:
    folder = state_folder(settings)
    saved_points, stage = SavedViaPoints(settings), folder / "stage.json"
    for path in (stage, saved_points.path(skill)):
        damage(path, how)
    assert SavedStage(settings).read(skill) == ""
    assert saved_points.read(skill) is None
    for path in (stage, saved_points.path(skill)):
        (reason,) = re.findall(rf"{path} cannot be used: (.*); the file is kept", caplog.text)
        assert reason in REASONS.get(how, (NOT_OURS,))
        assert not os.path.lexists(path)
        assert os.path.lexists(path.with_suffix(".damaged"))
    SavedStage(settings).keep(skill, ("handover", "glass"), 0.9)
    assert SavedStage(settings).read(skill) == "handover"


def test_a_daemon_starts_beside_a_damaged_state_and_keeps_its_own_again(tmp_path: Path, skill: Skill) -> None:
    settings = Settings(files=Files(state=str(tmp_path / "state")))
    folder, points = state_folder(settings), SavedViaPoints(settings).path(skill)
    for path in (folder / "stage.json", points, folder / "daemon.lock"):
        damage(path, "deep brackets")
    with serving(tmp_path, "--arm", "assumed") as daemon:
        log = daemon.log.read_text()
        assert "Traceback" not in log
        assert f"{folder / 'stage.json'} cannot be used" in log
        assert f"{points} cannot be used" in log
        daemon.client.set_stage("glass")
        daemon.until(lambda now: (folder / "stage.json").exists())
    with serving(tmp_path, "--arm", "assumed") as daemon:
        assert "cannot be used" not in daemon.log.read_text()
        assert daemon.until(lambda now: bool(now["stage"]))["stage"] == ["glass", "soldering"]
        said = daemon.log.read_text()
        assert said.count("the task continues at via-point glass, which an earlier run had reached") == 1
        assert daemon.end() == 0
        assert daemon.log.read_text().endswith(" ended: the daemon of cell thirdhand; it recorded nothing\n")


def test_a_daemon_is_told_the_stage_and_knows_it_after_a_restart(tmp_path: Path) -> None:
    with serving(tmp_path) as daemon:
        with pytest.raises(RefusedError, match=r"no via-point 'shelf' of the task. There are: start, handover, glass"):
            daemon.client.set_stage("shelf")
        assert daemon.client.status().stage == ()
        assert daemon.client.set_stage("glass").mode == "hold"
        assert daemon.until(lambda now: now["stage"] == ["glass", "soldering"])["stage_belief"] == 1.0
    with serving(tmp_path) as daemon:
        assert daemon.until(lambda now: bool(now["stage"]))["stage"] == ["glass", "soldering"]
        said = daemon.log.read_text()
        assert said.count("the task continues at via-point glass, which an earlier run had reached") == 1
        assert daemon.end() == 0
        assert daemon.log.read_text().endswith(" ended: the daemon of cell thirdhand; it recorded nothing\n")
