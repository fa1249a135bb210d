"""An arm behind ros2_control: commands and joint states use the topics that the settings name.
However the commands end, a stop comes first.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber

from support.cell import Tracker, serving, until
from support.ros2_nodes import header, port, typed
from support.sabotage import SABOTAGE, fail
from support.wam import JOINT_NAMES
from thirdhand.client import endpoints
from thirdhand.settings.config import Settings

DOMAIN = 11
RATE_HZ = 250
FORWARD = "/arm/forward/commands"
TRAJECTORY = "/arm/jtc/joint_trajectory"
STATES = "/arm/joint_states"
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


@pytest.mark.parametrize("ends", ["stop", "failure"])
@pytest.mark.one_case
def test_controllers_follow_and_are_left_at_rest(
    tmp_path: Path, router: zenoh.Session, ends: str
) -> None:
    """The daemon is stopped, or its loop fails for good, while the arm moves."""
    (endpoint,) = endpoints(router)
    (tmp_path / "driven.toml").write_text(CONFIGURATION.format(router=endpoint, state=tmp_path))
    positions = list[Any]()
    ways = list[Any]()
    topics = {FORWARD: ("std_msgs/msg/Float64MultiArray", positions.append)}
    topics |= {TRAJECTORY: ("trajectory_msgs/msg/JointTrajectory", ways.append)}
    heard = [
        ROS2Subscriber(topic, callback=take, **typed(kind), **port(endpoint, DOMAIN))
        for topic, (kind, take) in topics.items()
    ]
    states = ROS2Publisher(STATES, **typed("sensor_msgs/msg/JointState"), **port(endpoint, DOMAIN))

    def as_the_arm(*_: Any) -> bool:
        """Publish the positions of the newest command as the arm's state."""
        q = positions[-1].data if positions else np.array(Settings().arm.posture)[::-1]
        none = np.empty(0)
        states.publish(
            header=header(states.session_mgr.store.types),
            name=list(reversed(JOINT_NAMES)),
            position=np.array(q),
            velocity=none,
            effort=none,
        )
        return True

    arguments = ("--config", str(tmp_path / "driven.toml"))
    with (
        serving(tmp_path, *arguments, before=SABOTAGE.format(folder=str(tmp_path))) as daemon,
        Tracker(daemon.session) as hands,
    ):

        def moves() -> bool:
            as_the_arm()
            away = 0.06 * np.sin(3.0 * time.monotonic())
            hands.left = (0.92 + away, -0.3, 0.08)
            hands.right = (0.92 + away, 0.3, 0.08)
            return len(ways) > 10 and np.abs(ways[-1].points[0].velocities).max() > 0.05

        until(moves, "the arm never moved")
        assert list(ways[-1].joint_names) == list(reversed(JOINT_NAMES))
        assert ways[-1].points[0].time_from_start.nanosec == round(1e9 / RATE_HZ)
        if ends == "failure":
            fail(tmp_path, "step")
            until(lambda: as_the_arm() and daemon.process.poll() is not None, "it did not end")
        else:
            assert daemon.end() == 0
    until(lambda: not ways[-1].points[0].velocities.any(), "the last command moves")
    time.sleep(0.2)
    np.testing.assert_allclose(positions[-1].data, ways[-1].points[0].positions)
    steps = np.abs(np.diff([message.data for message in positions[-40:]], axis=0))
    # no jump, where a busy machine may lose one or two messages
    assert steps.max() < 3 * 1.6 / RATE_HZ
    for node in (*heard, states):
        node.close()
