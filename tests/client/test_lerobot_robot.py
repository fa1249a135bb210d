"""The plug-in for LeRobot in examples/, with LeRobot's own classes where that is installed."""

from __future__ import annotations

import importlib
import importlib.util
import math
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.cell import LEFT, RIGHT, Tracker, serving, until
from support.in_process import ASSUMED
from support.installed import unpacked, wheel_of
from support.paths import ROOT
from thirdhand.contract.messages import PoseStamped
from thirdhand.daemon.launch import launched
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import HandSettings, SkillSettings

PLUG_IN = ROOT / "examples" / "lerobot_robot_thirdhand"
STAND_IN = ROOT / "tests" / "support" / "stand_in"
LED = msgspec.structs.replace(
    ASSUMED, skill=SkillSettings(source="tool/wish"), hands=HandSettings(gripper="key")
)
PERIOD_S = 1 / 30


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plug-in as pip installs it."""
    folder = tmp_path_factory.mktemp("plug-in")
    return unpacked(wheel_of(PLUG_IN, folder), folder / "site")


@pytest.fixture(scope="module", autouse=True)
def plug_in(site: Path) -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        if importlib.util.find_spec("lerobot") is None:
            patch.syspath_prepend(str(STAND_IN))
        patch.syspath_prepend(str(site))
        yield importlib.import_module("lerobot_robot_thirdhand")


@pytest.fixture
def errors() -> Any:
    return importlib.import_module("lerobot.utils.errors")


def robot(plug_in: ModuleType, endpoint: str, folder: Path, **more: Any) -> Any:
    """A robot whose joints are observed as commanded."""
    config = plug_in.ThirdhandRobotConfig(endpoint=endpoint, measured=False, **more)
    config.calibration_dir = folder
    return plug_in.ThirdhandRobot(config)


def hands(plug_in: ModuleType, endpoint: str, folder: Path) -> Any:
    config = plug_in.ThirdhandHandsConfig(endpoint=endpoint)
    config.calibration_dir = folder
    return plug_in.ThirdhandHands(config)


def test_lerobot_finds_both_devices_by_the_distribution(site: Path) -> None:
    (metadata,) = site.glob("*.dist-info/METADATA")
    assert "\nName: lerobot_robot_thirdhand\n" in metadata.read_text(encoding="utf-8")
    plugins = pytest.importorskip("lerobot.utils.import_utils", reason="needs lerobot and PyTorch")
    plugins.register_third_party_plugins()
    robots = importlib.import_module("lerobot.robots")
    teleoperators = importlib.import_module("lerobot.teleoperators")
    for name, kind, made in (
        ("thirdhand", robots.RobotConfig, robots.make_robot_from_config),
        (
            "thirdhand_hands",
            teleoperators.TeleoperatorConfig,
            teleoperators.make_teleoperator_from_config,
        ),
    ):
        device = made(kind.get_choice_class(name)(calibration_dir=site))
        assert device.name == name


def turned(action: dict[str, float]) -> dict[str, float]:
    """The action with its quaternion normalised, as it is sent."""
    names = [f"tool.q{i}" for i in "xyzw"]
    norm = math.hypot(*(action[name] for name in names))
    return action | {name: action[name] / norm for name in names}


def test_policy_leads_the_tool_by_actions(
    plug_in: ModuleType, errors: ModuleType, tmp_path: Path
) -> None:
    """The tool follows, far actions are cut, and the session replays identically."""
    records = tmp_path / "records"
    with launched(tmp_path, settings=LED, record=records) as service:
        arm = robot(plug_in, service.endpoint, tmp_path, gripper=True, hands=True)
        arm.connect()
        with pytest.raises(errors.DeviceAlreadyConnectedError, match="connected already"):
            arm.connect()
        start = arm.get_observation()
        assert start.keys() == arm.observation_features.keys()
        assert (start["left.x"], start["gripper"]) == (0.0, 0.0)
        action = {name: start[name] for name in arm.action_features}
        arm.send_action(action)
        until(lambda: arm.cell.status().mode == "follow")

        begin_s = time.monotonic()
        tool_m = []
        wished_m = []
        while (time_s := time.monotonic() - begin_s) < 3.0:
            action["tool.y"] = start["tool.y"] + 0.04 * (1.0 - math.cos(2.0 * time_s))
            action["gripper"] = 2.0
            assert arm.send_action(action) == pytest.approx(turned(action) | {"gripper": 1.0})
            observed = arm.get_observation()
            tool_m.append(observed["tool.y"])
            wished_m.append(action["tool.y"])
            time.sleep(PERIOD_S)
        assert np.abs(np.subtract(tool_m, wished_m)).max() < 0.03
        assert np.ptp(tool_m) > 0.07
        assert all(map(math.isfinite, observed.values()))
        until(lambda: arm.get_observation()["gripper"] == 1.0)

        # The quaternion is normalised, and the step is limited.
        now = arm.get_observation()
        far = (
            now
            | {"tool.z": now["tool.z"] + 0.3}
            | {f"tool.q{i}": now[f"tool.q{i}"] * 5 for i in "xyzw"}
        )
        sent = arm.send_action(far)
        assert sent["tool.z"] - now["tool.z"] == pytest.approx(0.10, abs=0.005)
        assert math.hypot(*(sent[f"tool.q{i}"] for i in "xyzw")) == pytest.approx(1.0)
        with pytest.raises(ValueError, match="finite numbers needed"):
            arm.send_action(now | {"tool.x": math.nan})
        arm.disconnect()
        for call in (arm.get_observation, lambda: arm.send_action(action), arm.disconnect):
            with pytest.raises(errors.DeviceNotConnectedError, match="not connected"):
                call()
    (recording,) = records.glob("*.mcap")
    assert replay(recording).exact


def test_hands_lead_by_the_skill_of_a_cell(
    plug_in: ModuleType, errors: ModuleType, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Without hands the action is the present tool. A robot only observes such a cell."""
    with serving(tmp_path, "--joints", "assumed") as daemon:
        leader = hands(plug_in, daemon.endpoint, tmp_path)
        with pytest.raises(errors.DeviceNotConnectedError, match="not connected"):
            leader.get_action()
        with pytest.raises(ValueError, match=r'"tool/wish"` needed'):
            robot(plug_in, daemon.endpoint, tmp_path).connect()
        with pytest.raises(ValueError, match=r"joints \['elbow'\] given; the arm has"):
            robot(plug_in, daemon.endpoint, tmp_path, leads=False, joints=["elbow"]).connect()

        arm = robot(plug_in, daemon.endpoint, tmp_path, leads=False, hands=True)
        arm.connect()
        leader.connect()
        observed = arm.get_observation()
        assert leader.get_action() == pytest.approx(
            {name: observed[name] for name in arm.action_features}
        )
        with Tracker(daemon.session):
            daemon.until(lambda status: status["mode"] == "follow")
            until(lambda: arm.get_observation()["right.x"] != 0.0)
            observed = arm.get_observation()
            for side, position_m in (("left", LEFT), ("right", RIGHT)):
                seen_m = [observed[f"{side}.{axis}"] for axis in "xyz"]
                assert seen_m == pytest.approx(position_m, abs=0.005)
            action = leader.get_action()
            target_m = daemon.client.status().target_m
            assert [action[f"tool.{axis}"] for axis in "xyz"] == pytest.approx(target_m, abs=0.005)
            assert arm.send_action(action) == pytest.approx(turned(action))
        caplog.clear()
        until(lambda: arm.get_observation() and "mode hold: " in caplog.text)
        leader.disconnect()
        arm.disconnect()


def test_a_constant_orientation_is_its_own_mean(plug_in: ModuleType, tmp_path: Path) -> None:
    """LeRobot takes means of single precision: for 0.92388, 300 rows, off by more than their
    deviation.
    """
    tool = PoseStamped(0, "base", (0.5, 0.0, 0.3), (0.0, 0.9238795, 0.0, 0.3826834))
    action = hands(plug_in, "", tmp_path).action(tool)
    turn = [action[f"tool.q{axis}"] for axis in "xyzw"]
    assert turn == pytest.approx(tool.orientation, abs=2e-4)
    rows = np.tile(np.array(turn, np.float32), (300, 1))
    assert (rows.mean(axis=0) == rows).all()


numbers = st.floats(-1.0, 1.0)
poses = st.lists(numbers, min_size=7, max_size=7).filter(lambda pose: math.hypot(*pose[3:]) > 0.1)


@given(poses, poses)
def test_a_limited_step_leads_toward_the_pose(first: list[float], second: list[float]) -> None:
    """It is never longer than the limits, and a short one is left as it is."""
    of = importlib.import_module("lerobot_robot_thirdhand.poses")
    present, pose = ([*pose[:3], *of.unit(pose[3:])] for pose in (first, second))
    step = of.limited(pose, present, 0.1, 0.5)
    assert math.dist(step[:3], present[:3]) <= 0.1 + 1e-9
    assert math.dist(step[:3], pose[:3]) <= math.dist(present[:3], pose[:3]) + 1e-9
    assert math.hypot(*step[3:]) == pytest.approx(1.0)
    # chords between unit quaternions: 2 sin(angle / 4)
    assert math.dist(step[3:], present[3:]) <= 2.0 * math.sin(0.5 / 4) + 1e-7
    assert of.limited(step, present, 0.1 + 1e-6, 0.5 + 1e-6) == pytest.approx(step)
