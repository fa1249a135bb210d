"""The core on arms that we did not write: a Panda, its fingers locked, and a UR5 of six joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.contract.records import Mode
from service.core.arm.stage import Arm
from service.core.controller import Controller, run
from service.core.frame import Frame, Tick
from service.core.skill.skill import Skill
from service.files.recording import Recorder
from service.files.replay import replay
from service.learning.learn import learn
from service.settings.config import Settings, SettingsError, load, parse, robot_description
from sim.scene import Scene
from sim.script import HandScript
from sim.teach import demonstrations
from support.arms import MODELS, cell_of, toml_of, urdf_of
from support.in_process import frames, ticks_of


@pytest.fixture(scope="module")
def reach() -> Skill:
    """A coarse skill of two demonstrations, with which the tool goes a metre."""
    return learn([one.every(2) for one in demonstrations(Scene(), count=2, seed=1)], components=5, points=60)


@pytest.fixture(scope="module", params=MODELS)
def cell(request: pytest.FixtureRequest) -> Settings:
    return cell_of(request.param)


@pytest.mark.parametrize("arm", ["wam", *MODELS])
def test_it_follows_moving_targets_with_every_limit_held(arm: str, reach: Skill) -> None:
    cell = cell_of(arm)
    seen = frames(Controller(cell, reach, urdf=robot_description(cell)), ticks_of(HandScript(Scene(), seed=3)))
    assert (seen["mode"] == Mode.FOLLOW).all()
    error_mm = 1000 * np.linalg.norm(seen["tool"] - seen["setpoint"], axis=1)
    assert np.sqrt(np.mean(error_mm**2)) < 0.5, f"{np.sqrt(np.mean(error_mm**2)):.3f} mm rms"
    assert error_mm.max() < 5.0, f"{error_mm.max():.3f} mm"
    assert np.ptp(seen["tool"], axis=0).max() > 0.3
    limits = cell.joints
    assert seen["joints"].shape[1] == len(limits.names)
    assert (seen["joints"] >= limits.lower).all()
    assert (seen["joints"] <= limits.upper).all()
    velocity, acceleration = seen["joint_velocities"], seen["joint_accelerations"]
    assert (np.abs(velocity) <= limits.velocity).all()
    assert (np.abs(acceleration) <= np.array(limits.acceleration) * (1 + 1e-9)).all()
    assert (np.abs(np.diff(acceleration, axis=0)) / cell.period_s <= np.array(limits.jerk) * (1 + 1e-6)).all()
    assert np.abs(np.diff(seen["joints"], axis=0) / cell.period_s).max() <= max(limits.velocity) * (1 + 1e-6)


def test_its_recording_replays_identically(cell: Settings, reach: Skill, tmp_path: Path) -> None:
    controller = Controller(cell, reach, urdf=robot_description(cell))
    with Recorder(tmp_path / "a.mcap", settings=cell, skill=reach.file, state=controller.state) as recorder:

        def keep(tick: Tick, frame: Frame) -> None:
            recorder.write(tick, frame, time_ns=tick.index * 2_000_000)

        run(controller, list(ticks_of(HandScript(Scene(), seed=3)))[:1500], [keep])
    assert replay(tmp_path / "a.mcap").text() == "1500 ticks, 1500 frames identical"


def test_names_limits_and_reach_come_from_its_description(cell: Settings) -> None:
    arm = Arm(cell, robot_description(cell))
    here = arm.at(np.array(cell.arm.posture))
    position, rotation = here.position, here.rotation
    assert position == pytest.approx(Scene().robot_start, abs=0.03)
    assert rotation[:, 2] == pytest.approx([np.sqrt(0.5), 0.0, -np.sqrt(0.5)], abs=0.01)
    assert len(cell.joints.names) == len(cell.joints.lower) == len(cell.arm.posture)
    assert 0.3 < cell.reach.inner < cell.reach.outer < 1.4


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"plate": ""}, "[arm] plate: missing; the link that carries the tool needed, the last ones are"),
        ({"plate": 'plate = "gripper"'}, "no link 'gripper'"),
        ({"posture": ""}, "[arm] posture: missing; the URDF does not define it, 6 numbers needed"),
        ({"jerk": ""}, "[joints] jerk: missing"),
        ({"posture": "posture = [0, 0, 0]"}, "[arm] posture: 3 numbers, 6 needed, one for each of [joints] names"),
        (
            {"jerk": f"jerk = {[500] * 6}\nvelocity = {[9] * 6}"},
            "[joints] velocity, entry 1: 9.0 given; up to 3.15",
        ),
        ({"jerk": f'jerk = {[500] * 6}\nnames = ["a", "b", "c", "d", "e", "f"]'}, "[joints] names: ['a', 'b'"),
        ({"urdf": '[arm]\nurdf = "nowhere.urdf"'}, "/nowhere.urdf: No such file or directory"),
    ],
)
def test_settings_that_do_not_fit_the_description_are_refused(changed: dict[str, str], message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        parse(toml_of(MODELS["ur5"], **changed), origin="cell.toml")
    assert str(caught.value).startswith("cell.toml: ")
    assert message in str(caught.value)


def test_a_description_is_looked_for_beside_the_settings(tmp_path: Path) -> None:
    meshes = f'packages = ["{urdf_of(MODELS["ur5"]).parents[4]}"]'
    (tmp_path / "arm.urdf").write_bytes(urdf_of(MODELS["ur5"]).read_bytes())
    (tmp_path / "cell.toml").write_text(toml_of(MODELS["ur5"], urdf=f'[arm]\nurdf = "arm.urdf"\n{meshes}'))
    assert load(tmp_path / "cell.toml").joints.names[0] == "shoulder_pan_joint"
