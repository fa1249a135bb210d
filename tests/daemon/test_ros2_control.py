"""An arm behind ros2_control: its controllers are commanded, and its joint states heard, on the
topics that the settings name; whatever ends the commands, a stop goes before.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

from service.client import endpoints, open_session
from service.contract import ros2, ros2msg
from service.settings.config import Settings
from support.cell import Tracker, serving, until
from support.wam import JOINT_NAMES

DOMAIN, RATE_HZ = 11, 250
FORWARD, TRAJECTORY, STATES = "/arm/forward/commands", "/arm/jtc/joint_trajectory", "/arm/joint_states"
CONFIGURATION = f"""
rate_hz = {RATE_HZ}
[network]
listen = ["tcp/127.0.0.1:0"]
connect = ["{{router}}"]
ros2_domain = {DOMAIN}
[ros2]
position_commands = "{FORWARD}"
trajectory = "{TRAJECTORY}"
joint_states = "{STATES}"
joints = {list(reversed(JOINT_NAMES))}
[arm]
silent_ms = 1000.0
[files]
state = "{{state}}"
"""
POSITIONS, WAYS = "std_msgs/msg/Float64MultiArray", "trajectory_msgs/msg/JointTrajectory"
DEFINITIONS = {  # of what this project says and never reads
    POSITIONS: (
        "std_msgs/MultiArrayLayout layout\nfloat64[] data\n" + "=" * 80 + "\nMSG: std_msgs/MultiArrayLayout\n"
        "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n" + "=" * 80
        + "\nMSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
    ),
    WAYS: (
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points\n" + "=" * 80
        + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80
        + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n" + "=" * 80
        + "\nMSG: trajectory_msgs/JointTrajectoryPoint\nfloat64[] positions\nfloat64[] velocities\n"
        "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start\n" + "=" * 80
        + "\nMSG: builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n"
    ),
}  # fmt: skip


@pytest.mark.parametrize("ends", ["stop", "failure"])
@pytest.mark.one_case
def test_controllers_follow_and_are_left_at_rest(tmp_path: Path, ends: str) -> None:
    """Stopped while it moves, and with a loop that fails for good while it moves."""
    sabotage = f"""
from pathlib import Path
from service.core.controller import Controller
step = Controller.step
def sabotaged(self, *given):
    if Path({str(tmp_path / "fail")!r}).exists():
        raise RuntimeError("sabotaged")
    return step(self, *given)
Controller.step = sabotaged
"""
    with open_session(listen=["tcp/127.0.0.1:0"], more={"mode": "router"}) as router:
        (at,) = endpoints(router)
        (tmp_path / "driven.toml").write_text(CONFIGURATION.format(router=at, state=tmp_path))
        port = {"domain_id": DOMAIN, "router_ip": "127.0.0.1", "router_port": int(at.rpartition(":")[2])}

        def typed(kind: str) -> dict[str, str]:
            text = DEFINITIONS.get(kind) or ros2msg.schema(kind)
            return {"msg_type": kind, "msg_definition": text, "type_hash": f"RIHS01_{ros2.TYPE_HASHES[kind]}"}

        positions, ways = list[Any](), list[Any]()
        arguments = ("--config", str(tmp_path / "driven.toml"))
        try:
            heard = [
                ROS2Subscriber(FORWARD, callback=positions.append, **typed("std_msgs/msg/Float64MultiArray"), **port),
                ROS2Subscriber(
                    TRAJECTORY, callback=ways.append, **typed("trajectory_msgs/msg/JointTrajectory"), **port
                ),
            ]
            states = ROS2Publisher(STATES, **typed("sensor_msgs/msg/JointState"), **port)
            kinds = states.session_mgr.store.types
            header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]

            def as_the_arm(*_: Any) -> bool:
                """Stands where the newest command has it, and says so."""
                q = positions[-1].data if positions else np.array(Settings().arm.posture)[::-1]
                now_ns, none = time.time_ns(), np.empty(0)
                states.publish(
                    header=header(stamp=stamp(sec=now_ns // 10**9, nanosec=now_ns % 10**9), frame_id=""),
                    name=list(reversed(JOINT_NAMES)), position=np.array(q), velocity=none, effort=none,
                )  # fmt: skip
                return True

            with serving(tmp_path, *arguments, before=sabotage) as daemon, Tracker(daemon.session) as hands:

                def moves() -> bool:
                    as_the_arm()
                    away = 0.06 * np.sin(3.0 * time.monotonic())
                    hands.left, hands.right = (0.92 + away, -0.3, 0.08), (0.92 + away, 0.3, 0.08)
                    return len(ways) > 10 and np.abs(ways[-1].points[0].velocities).max() > 0.05

                until(moves, "the arm never moved")
                assert list(ways[-1].joint_names) == list(reversed(JOINT_NAMES))
                assert ways[-1].points[0].time_from_start.nanosec == round(1e9 / RATE_HZ)
                if ends == "failure":
                    (tmp_path / "fail").write_text("")
                    until(lambda: as_the_arm() and daemon.process.poll() is not None, "it did not end")
                else:
                    assert daemon.end() == 0
            until(lambda: not ways[-1].points[0].velocities.any(), "the last command moves")
            time.sleep(0.2)
            np.testing.assert_allclose(positions[-1].data, ways[-1].points[0].positions)
            steps = np.abs(np.diff([one.data for one in positions[-40:]], axis=0))
            assert steps.max() < 3 * 1.6 / RATE_HZ  # without a jump; a busy machine loses one message or two
            for one in (*heard, states):
                one.close()
        finally:
            ZenohSession.get_instance().close()
