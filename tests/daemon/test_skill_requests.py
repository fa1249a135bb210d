"""Requests for a skill: loaded by its name, from its folder only, and adopted or not at all."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from service.cli.main import main
from service.client import RefusedError, endpoints
from service.contract.records import Mode, Reason
from service.core.skill.skill import Skill
from service.daemon.daemon import load_skill
from service.daemon.skill_worker import SkillWorker
from service.learning.reach import beyond_m
from service.learning.skill_file import SkillError, StoredSkill, with_file
from service.settings.config import Files, Reach, Settings
from support.request_cell import PLACES, Cell


@pytest.mark.parametrize("name", ["soldering", "soldering.npz"])
def test_a_skill_is_loaded_by_name_and_places_stay_with_what_they_were_taught_to(
    cell: Cell, skill: StoredSkill, name: str
) -> None:
    cell.client.add(PLACES)
    assert len(cell.client.load_skill(name).points or ()) == len(PLACES)
    other = with_file(replace(skill, learned_from="other demonstrations"))
    (cell.folder / "other.npz").write_bytes(other.file)
    assert cell.client.ask("skill", {"name": "other"})["points"] == []
    assert cell.taken[-1].value.digest == other.digest
    assert cell.names() == []
    cell.client.add(PLACES[:1])
    assert len(cell.client.load_skill(name).points or ()) == len(PLACES)
    assert len(cell.client.load_skill("other").points or ()) == 1


def test_a_skill_that_was_given_up_is_not_adopted_later(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.daemon.queryables.ADOPTION_TIMEOUT_S", 0.05)
    cell.running = False
    with pytest.raises(RefusedError):
        cell.client.add(PLACES)
    monkeypatch.undo()
    cell.running = True
    cell.client.ask("hold")  # taken after whatever else waits
    assert cell.kinds() == ["hold"]
    assert cell.names() == []


@pytest.mark.parametrize(
    "name",
    [
        *("../secret", "..", "/etc/passwd", "sub/inside", "a\0b", "link", "loop", "pipe", ".hidden", "x" * 200),
        *("{folder}/../secret", "{folder}/soldering", "soldering.npz/../../secret", "~/secret", "secret\n", ""),
    ],
)
def test_a_skill_is_loaded_from_its_folder_only(cell: Cell, skill: Skill, tmp_path: Path, name: str) -> None:
    """What lies elsewhere is not loaded, however it is named; nor is told where it is."""
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    for path in (outside / "secret.npz", cell.folder.parent / "secret.npz", cell.folder / ".hidden.npz"):
        path.write_bytes(skill.file)
    (cell.folder / "sub").mkdir()
    (cell.folder / "sub" / "inside.npz").write_bytes(skill.file)
    (cell.folder / "link.npz").symlink_to(outside / "secret.npz")
    (cell.folder / "loop.npz").symlink_to(cell.folder / "loop.npz")
    os.mkfifo(cell.folder / "pipe.npz")
    with pytest.raises(RefusedError) as refused:
        cell.client.ask("skill", {"name": name.format(folder=cell.folder)})
    assert str(refused.value).startswith("$.name")
    assert str(outside) not in str(refused.value)
    assert cell.kinds() == []
    assert cell.failures == []


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"name": "nothing"}, "$.name: no skill 'nothing' in the skill folder; its skills: soldering"),
        ({"name": "../soldering"}, "$.name: "),
        ({"name": "/etc/passwd"}, "$.name: "),
        ({"name": ".."}, "$.name: "),
        ({"name": ".npz"}, "$.name: "),
        ({"name": "a/b"}, "$.name: "),
        ({"name": ""}, "$.name: "),
        ({"name": "x" * 129}, "$.name: "),
        ({"name": 3}, "$.name: 3 given; 1 to 64 letters"),
        ({}, "$: field `name` is missing"),
    ],
)
def test_a_request_for_a_skill_is_refused_whole_and_with_a_reason(
    taught_cell: Cell, request_: Any, message: str
) -> None:
    assert taught_cell.refusal("skill", request_).startswith(message)


def test_a_skill_file_that_is_none_is_refused_and_all_stays(taught_cell: Cell) -> None:
    (taught_cell.folder / "broken.npz").write_bytes(b"nothing")
    assert "broken.npz: not a skill" in taught_cell.refusal("skill", {"name": "broken"})
    (taught_cell.folder / "broken.npz").unlink()


def test_the_stage_of_the_task_is_told_by_client_and_command(
    cell: Cell, sessions: tuple[zenoh.Session, zenoh.Session], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "There are: start, handover, glass, soldering" in cell.refusal("stage", {"name": "elsewhere"})
    reply = cell.client.set_stage("glass")
    assert (reply.mode, reply.reason, cell.kinds()[-1]) == ("hold", "no_hands", "stage")
    command = ["stage", "soldering", "--connect", *endpoints(sessions[0]), "--cell", cell.settings.cell]
    for mode, reason, told in ((Mode.HOLD, Reason.NO_HANDS, "hold (no_hands)"), (Mode.FOLLOW, Reason.NONE, "follow")):
        cell.mode, cell.reason = mode, reason
        assert main(command) == 0
        assert re.search(rf"^at soldering since tick \d+: {re.escape(told)}$", capsys.readouterr().out, re.MULTILINE)
    assert cell.kinds()[-3:] == ["stage"] * 3


FAR_LEFT = Reach(centre=(0.0, 1.5, 0.346))


def test_a_skill_out_of_reach_is_refused_and_one_of_which_a_part_is_comes_with_a_warning(
    sessions: tuple[zenoh.Session, zenoh.Session], skill: StoredSkill, skill_worker: SkillWorker, tmp_path: Path
) -> None:
    positions = skill.tool_positions
    half = Reach(min_x=float(np.quantile(positions[:, 0], 0.4)))  # 40 % are nearer to the base
    for reach, is_refused in ((FAR_LEFT, True), (half, False)):
        folder = tmp_path / str(is_refused)
        folder.mkdir()
        number = int(np.count_nonzero(beyond_m(Settings(reach=reach), positions)))
        sentence = (
            f"{number} of {len(positions)} places of the tool in skill 'soldering' are out of the arm's reach, the"
        )
        with contextlib.closing(Cell(*sessions, skill, skill_worker, folder, reach)) as cell:
            if is_refused:
                assert sentence in cell.refusal("skill", {"name": "soldering"})
                assert cell.kept == []
            else:
                (warning,) = cell.client.load_skill("soldering").warnings
                assert warning.startswith(sentence)
                assert cell.kinds() == ["skill"]


@pytest.mark.parametrize("reach", [FAR_LEFT, Reach(min_x=0.95)])
def test_a_skill_out_of_reach_is_not_served(
    reach: Reach, skill: StoredSkill, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "soldering.npz").write_bytes(skill.file)
    settings = Settings(files=Files(state=str(tmp_path)), reach=reach)
    with pytest.raises(SkillError, match=r"places of the tool .* out of the arm's reach, the farthest by \d\.\d+ m: "):
        load_skill(tmp_path / "soldering.npz", settings)
    served = load_skill(tmp_path / "soldering.npz", Settings(files=Files(state=str(tmp_path))))
    assert served.digest == skill.digest
    assert caplog.text == ""
