"""Saved state: via-points and the segment of the task survive a restart, completely or not at
all.
"""

from __future__ import annotations

import json
import os
import re
import resource
import stat
from dataclasses import replace
from pathlib import Path
from random import Random

import msgspec
import numpy as np
import pytest

from support.cell import serving
from thirdhand.cli.usage import added_in
from thirdhand.contract.requests import RequestError
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.saved_segment import MAX_RESTART_S, SavedSegment
from thirdhand.daemon.saved_state import MAX_STATE_BYTES, NOT_OURS
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.single_instance import state_folder
from thirdhand.settings import mesh_cover
from thirdhand.settings.config import WAM, Files, Settings, converted
from thirdhand.skills.skill_file import SkillError
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene

POINTS = Scene().via_points()


def keep(saved: SavedViaPoints, skill: Skill) -> None:
    """Save the via-points of a skill."""
    with saved.replacing(skill):
        pass


@pytest.fixture
def saved(tmp_path: Path) -> SavedViaPoints:
    return SavedViaPoints(Settings(cell="lab/bench2", files=Files(state=str(tmp_path))))


def files_in(folder: Path) -> dict[Path, bytes]:
    """All files below a folder, with their contents."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_failed_save_leaves_the_old_files(
    saved: SavedViaPoints,
    settings: Settings,
    skill: Skill,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No other files remain."""
    monkeypatch.setattr(mesh_cover, "CAPSULE_CACHE", tmp_path)
    taught = adapted(skill, POINTS, tolerance=0.03)
    keep(saved, taught)
    before = files_in(tmp_path)
    with pytest.raises(RequestError), saved.replacing(skill):
        raise RequestError("refused")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))  # each write fails, as on a full disk
    try:
        with pytest.raises(SkillError, match="cannot save via-points"):
            keep(saved, skill)
        unreached = SavedViaPoints(settings, lambda _, tools: np.ones(len(tools)))
        assert unreached.read(skill) == ((), 0.03)
        assert re.search("cannot be set aside .*File too large", unreached.remark)
        with pytest.raises(OSError, match="File too large"):
            SavedSegment(settings).keep(skill, (POINTS[0].name, POINTS[1].name), 1.0)
        mesh_cover._keep("capsule", (1.0,) * 7)  # noqa: SLF001
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files_in(tmp_path) == before


def test_unsuitable_saved_via_points_are_set_aside(
    saved: SavedViaPoints, skill: Skill, caplog: pytest.LogCaptureFixture
) -> None:
    """Via-points that this skill cannot reach are set aside."""

    def refuse(*_: object) -> str:
        raise SkillError("they would bend it too much")

    keep(saved, adapted(skill, POINTS, tolerance=0.03))
    assert saved.restored(skill, refuse, "as learned") == "as learned"
    assert "they would bend it too much" in caplog.text
    assert [file.suffix for file in saved.path(skill).parent.iterdir()] == [".damaged"]


def test_a_bit_that_flips_in_the_file_changes_nothing_or_is_told(
    saved: SavedViaPoints, skill: Skill
) -> None:
    random = Random(1)
    keep(saved, adapted(skill, POINTS, tolerance=0.03))
    whole = saved.path(skill).read_bytes()
    for _ in range(1000):
        damaged = bytearray(whole)
        damaged[random.randrange(len(whole))] ^= 1 << random.randrange(8)
        saved.path(skill).write_bytes(damaged)
        assert saved.read(skill) in (None, (POINTS, 0.03))


def another_arm(folder: Path, change: tuple[str, str]) -> Settings:
    """Settings of a cell with the shipped arm, whose description differs in one text."""
    urdf = folder / "own.urdf"
    text = WAM.read_text()
    assert change[0] in text
    urdf.write_text(text.replace(*change))
    shipped = Settings()
    joints = {
        name: list(getattr(shipped.joints, name))
        for name in ("lower", "upper", "acceleration", "jerk")
    }
    values = {
        "cell": "lab/bench2",
        "files": {"state": str(folder)},
        "arm": {
            "urdf": str(urdf),
            "plate": shipped.arm.plate,
            "posture": list(shipped.arm.posture),
        },
        "joints": joints,
    }
    return converted(values, origin="another arm")


def test_two_arms_with_one_skill_and_one_folder_keep_their_own(
    saved: SavedViaPoints, skill: Skill, tmp_path: Path
) -> None:
    other = SavedViaPoints(another_arm(tmp_path, ("0.55", "0.65")))
    keep(saved, adapted(skill, POINTS[:2], tolerance=0.03))
    assert other.read(skill) is None
    keep(other, adapted(skill, POINTS[:1], tolerance=0.03))
    assert (saved.read(skill), other.read(skill)) == ((POINTS[:2], 0.03), (POINTS[:1], 0.03))
    other.path(skill).replace(saved.path(skill))  # a file of the other cell under this cell's name
    assert saved.read(skill) is None


def test_unreachable_saved_via_points_are_set_aside(
    saved: SavedViaPoints, skill: Skill, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Via-points within the changed reach are in force; all of them once the reach is as before."""
    keep(saved, adapted(skill, POINTS, tolerance=0.03))
    tools = np.array([point.tool for point in POINTS])
    settings = Settings(cell="lab/bench2")
    for min_x in (0.0, *(np.sort(tools[:, 0])[[0, 1, 2]] + 0.01)):
        reach = msgspec.structs.replace(settings.reach, min_x=float(min_x))
        changed = msgspec.structs.replace(settings, files=Files(state=str(tmp_path)), reach=reach)
        changed_saved = SavedViaPoints(changed)
        read = changed_saved.read(skill)
        assert read is not None
        out = {point.name: min_x - point.tool[0] for point in POINTS if point.tool[0] < min_x}
        assert read == (tuple(point for point in POINTS if point.name not in out), 0.03)
        assert ("out of the arm's reach" in caplog.text) is bool(out)
        assert bool(changed_saved.remark) is bool(out)
        assert all(repr(name) in changed_saved.remark for name in out)
        for name, distance_m in out.items():
            assert f"{name!r} by {distance_m:.3f} m" in caplog.text
        if out:
            aside = Path(re.findall(r"via-points add --file (\S+)", caplog.text)[0])
            added = added_in(aside)
            assert added.points == tuple(point for point in POINTS if point.name in out)
            assert added.tolerance == 0.03
            assert stat.S_IMODE(aside.stat().st_mode) == 0o600
        caplog.clear()
    # no file was replaced
    assert len(list(saved.path(skill).parent.glob("out-of-reach-*.json"))) == 3
    assert saved.read(skill) == (POINTS, 0.03)


# --- the segment of the task ---


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(cell="lab/bench2", files=Files(state=str(tmp_path)))


def test_it_is_kept_for_its_skill_and_for_a_while(
    settings: Settings, skill: Skill, tmp_path: Path
) -> None:
    saved = SavedSegment(settings)
    assert saved.read(skill) == ""
    saved.keep(skill, ("handover", "glass"), 0.9)
    saved.keep(skill, ("start", "handover"), 0.4)
    assert SavedSegment(settings).read(skill) == "handover"
    others = replace(skill, learned_from="others")
    assert saved.read(others) == ""
    for loaded in (others, skill):  # two skills may have a via-point of the same name
        saved.keep(loaded, ("handover", "glass"), 0.9)
        assert SavedSegment(settings).read(loaded) == "handover"
    file = tmp_path / "lab/bench2/segment.json"
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    old = file.stat().st_mtime - MAX_RESTART_S - 1.0
    os.utime(file, (old, old))
    assert saved.read(skill) == ""
    file.write_text(json.dumps({"learned_from": skill.learned_from, "via_point": 3}))
    assert saved.read(skill) == ""


def damage(path: Path, how: str | bytes) -> None:
    """Replace a file by something that cannot be used."""
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
        assert isinstance(how, bytes)
        path.write_bytes(how)


DEEP = b"[" * 200_000
CONTENTS = (b"", b"{", b"[]", b"[3]", b"3", DEEP, b'{"a":' * 200_000, b"\xff\xff")
REASONS: dict[str | bytes, tuple[str, ...]] = {
    "a folder": ("Is a directory; a file needed, and that is a folder",),
    "a pipe": ("it is not a file",),
    "a huge file": (f"it has {1 << 40} bytes, at most {MAX_STATE_BYTES} accepted",),
    "a link to itself": (
        "Too many levels of symbolic links; a link that leads to a file or folder needed",
    ),
}


@pytest.mark.parametrize("how", [*REASONS, *CONTENTS], ids=lambda how: str(how)[:20])
def test_wrong_thing_in_place_of_a_saved_file_is_set_aside(
    how: str | bytes, settings: Settings, skill: Skill, caplog: pytest.LogCaptureFixture
) -> None:
    """The wrong file is reported too."""
    folder = state_folder(settings)
    saved_points = SavedViaPoints(settings)
    segment = folder / "segment.json"
    for path in (segment, saved_points.path(skill)):
        damage(path, how)
    assert SavedSegment(settings).read(skill) == ""
    assert saved_points.read(skill) is None
    for path in (segment, saved_points.path(skill)):
        (reason,) = re.findall(rf"{path} cannot be used: (.*); the file is kept", caplog.text)
        assert reason in REASONS.get(how, (NOT_OURS,))
        assert not os.path.lexists(path)
        aside = path.with_suffix(".damaged")
        assert f"is kept as {aside}" in caplog.text
        assert os.path.lexists(aside)
        assert not isinstance(how, bytes) or aside.read_bytes() == how
    assert saved_points.read(skill) is None  # the second reading finds no file
    SavedSegment(settings).keep(skill, ("handover", "glass"), 0.9)
    assert SavedSegment(settings).read(skill) == "handover"


def test_daemon_starts_with_a_damaged_state(tmp_path: Path, skill: Skill) -> None:
    """The daemon saves its state again."""
    settings = Settings(files=Files(state=str(tmp_path / "state")))
    folder = state_folder(settings)
    points = SavedViaPoints(settings).path(skill)
    for path in (folder / "segment.json", points, folder / "daemon.lock"):
        damage(path, DEEP)
    with serving(tmp_path, "--joints", "assumed") as daemon:
        log = daemon.log.read_text()
        assert "Traceback" not in log
        assert f"{folder / 'segment.json'} cannot be used" in log
        assert f"{points} cannot be used" in log
        assert daemon.client.status().segment == ()
        assert daemon.client.set_segment("glass").mode == "hold"
        assert (
            daemon.until(lambda now: (folder / "segment.json").exists() and now["segment"])[
                "segment_belief"
            ]
            == 1.0
        )
    with serving(tmp_path, "--joints", "assumed") as daemon:
        assert "cannot be used" not in daemon.log.read_text()
        assert daemon.until(lambda now: bool(now["segment"]))["segment"] == ["glass", "soldering"]
        second_log = daemon.log.read_text()
        assert (
            second_log.count(
                "the task continues at via-point glass, which an earlier run had reached"
            )
            == 1
        )
        assert daemon.end() == 0
        assert daemon.log.read_text().endswith(
            " ended: the daemon of cell thirdhand; it recorded nothing\n"
        )


def test_an_arm_that_was_calibrated_keeps_its_own(
    saved: SavedViaPoints, skill: Skill, tmp_path: Path
) -> None:
    keep(saved, adapted(skill, POINTS, tolerance=0.03))
    assert SavedViaPoints(another_arm(tmp_path, ("0.55", "0.5503"))).read(skill) == (POINTS, 0.03)
