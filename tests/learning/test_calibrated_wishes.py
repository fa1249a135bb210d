"""`learn --wishes`: a policy's covariance is calibrated by recordings in which a person leads."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from support.cell import told
from support.drawn_policy import wish
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.controller import Controller, start_state
from thirdhand.core.frame import Event, Tick
from thirdhand.daemon.daemon import load_skill
from thirdhand.recordings.recording import Recorder
from thirdhand.recordings.shipped import SHIPPED_SKILL, recordings
from thirdhand.settings.config import Settings, SkillSettings, robot_description
from thirdhand.skills.no_skill import no_skill
from thirdhand.skills.skill_file import SkillError, skill_in

CELL = msgspec.structs.replace(Settings(), skill=SkillSettings(source="tool/wish"))
STATED = tuple(np.diag([1e-4] * 3 + [0.01] * 3).ravel())  # 1 cm


def shadowed(path: Path, error_m: float, seed: int) -> None:
    """Record a person who leads the arm while a policy, which is `error_m` off, wishes."""
    random = np.random.default_rng(seed)
    skill = no_skill()
    controller = Controller(CELL, skill, urdf=robot_description(CELL))
    posture = np.array(CELL.arm.posture)
    with Recorder(
        path, settings=CELL, skill=skill.file, state=start_state(CELL, skill), thin=True
    ) as recorder:
        tick = Tick(0, (), 10**18)
        frame = controller.step(tick)
        recorder.write(tick, frame, time_ns=tick.time_ns)
        for k in range(1, 2500):
            time_ns = 10**18 + 2_000_000 * k
            joints = posture + 0.1 * np.sin(0.002 * k + np.arange(7))
            state = JointState(time_ns, CELL.joints.names, tuple(joints.tolist()), (0.0,) * 7)
            inbox = [
                Event("joints/state", cdr.encode_joints(state), state),
                Event("joints/guided", cdr.encode_bool(True), True),
            ]
            if k > 100 and k % 50 == 0:
                position = frame["tool"] + random.normal(0.0, error_m, 3)
                orientation = frame["tool_orientation"]
                inbox.append(wish(position, orientation, time_ns, covariance=STATED))
            tick = Tick(k, tuple(inbox), time_ns)
            frame = controller.step(tick)
            recorder.write(tick, frame, time_ns=time_ns)
    assert frame["reason"] == Reason.GUIDED


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("shadowed")
    paths = [folder / f"{seed}.mcap" for seed in range(6)]
    for seed, path in enumerate(paths):
        shadowed(path, 0.03, seed)
    return paths


def test_an_over_confident_policy_is_calibrated(takes: list[Path], tmp_path: Path) -> None:
    """The policy states 1 cm, and is 3 cm off; the cell then publishes what is true."""
    output = tmp_path / "policy.npz"
    done = told("learn", "--wishes", *map(str, takes), "--output", str(output))
    assert done.returncode == 0, done.stderr
    assert "of the errors, " in done.stdout
    skill = skill_in(output)
    deviation_m = 0.01 * np.sqrt(skill.regions.scale)
    assert 0.014 < deviation_m < 0.04

    cell = msgspec.structs.replace(CELL, arm=msgspec.structs.replace(CELL.arm, source="assumed"))
    frames = {}
    for name, used in (("before", no_skill()), ("after", skill)):
        controller = Controller(cell, used, urdf=robot_description(cell))
        frame = controller.step(Tick(0, (), 1))
        event = wish(frame["tool"], frame["tool_orientation"], 0, covariance=STATED)
        frames[name] = controller.step(Tick(1, (event,), 2))
    assert frames["after"]["covariance"][0, 0] == pytest.approx(deviation_m**2, rel=0.3)
    assert frames["after"]["mode"] == Mode.FOLLOW
    assert not frames["before"]["flags"] & Flag.UNSURE


def test_what_cannot_be_calibrated_is_refused(takes: list[Path], tmp_path: Path) -> None:
    output = str(tmp_path / "policy.npz")
    few = told("learn", "--wishes", str(takes[0]), "--output", output)
    assert (few.returncode, "recordings given; at least" in few.stderr) == (1, True)
    golden = [str(recordings() / "golden.mcap")] * 6
    other = told("learn", "--wishes", *golden, "--output", output)
    assert (other.returncode, "whose tool wishes lead alone needed" in other.stderr) == (1, True)
    useless = told("learn", "--wishes", str(takes[0]), "--output", output, "--delay", "0.1")
    assert (useless.returncode, "--wishes: without --delay" in useless.stderr) == (2, True)


def test_a_cell_takes_the_stand_in_and_no_other_skill(tmp_path: Path) -> None:
    shipped = recordings() / SHIPPED_SKILL
    assert load_skill(shipped, CELL) is no_skill()
    other = tmp_path / "other.npz"
    other.write_bytes(shipped.read_bytes())
    with pytest.raises(SkillError, match="wishes alone"):
        load_skill(other, CELL)
