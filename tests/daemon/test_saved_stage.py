"""The stage of the task: asked for by name, told in the status, kept over a restart."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from service.client import RefusedError
from service.config import Files, Settings
from service.core.skill.skill import Skill
from service.daemon.saved_stage import LONGEST_S, SavedStage
from service.shipped import shipped_skill
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
    old = file.stat().st_mtime - LONGEST_S - 1.0
    os.utime(file, (old, old))
    assert saved.read(skill) == ""
    for spoilt in ("{", "[]", json.dumps({"learned_from": skill.learned_from, "via_point": 3})):
        file.write_text(spoilt)
        assert saved.read(skill) == ""


def test_a_daemon_is_told_the_stage_and_knows_it_after_a_restart(tmp_path: Path) -> None:
    with serving(tmp_path) as daemon:
        with pytest.raises(RefusedError, match=r"no via-point 'shelf' of the task. There are: start, handover, glass"):
            daemon.client.set_stage("shelf")
        assert daemon.client.status().stage == ()
        assert daemon.client.set_stage("glass").mode == "hold"
        assert daemon.until(lambda now: now["stage"] == ["glass", "soldering"])["stage_belief"] == 1.0
    with serving(tmp_path) as daemon:
        assert daemon.until(lambda now: bool(now["stage"]))["stage"] == ["glass", "soldering"]
