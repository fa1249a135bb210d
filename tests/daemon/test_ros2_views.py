"""Topics that RViz and rqt show of a cell: description and fixed frames (latched), moving frames
and diagnostics, named by the settings.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import zenoh
from zenoh import ext
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

from support.cell import Tracker, serving, until
from support.ros2_nodes import TYPES, guarded, port, typed
from support.wam import JOINT_NAMES
from thirdhand.client import endpoints, open_session
from thirdhand.contract import cdr, ros2
from thirdhand.contract.messages import JointState, Transform
from thirdhand.daemon.ros2_domain import Ros2Domain
from thirdhand.settings.config import Settings, parse, robot_description

DOMAIN = 12
VIEWED = """
[ros2]
tf = "/tf"
robot_description = "/robot_description"
diagnostics = "/diagnostics"
"""
CONFIGURATION = f"""
rate_hz = 250
[network]
listen = ["tcp/127.0.0.1:0"]
connect = ["{{router}}"]
ros2_domain = {DOMAIN}
{VIEWED}
[files]
state = "{{state}}"
"""
POSTURE = np.array(Settings().arm.posture) + 0.05


def key(topic: str) -> str:
    """The Zenoh key of a topic that the settings name."""
    settings = parse(f"network.ros2_domain = {DOMAIN}\n{VIEWED}", origin="cell.toml").ros2
    return ros2.key(
        DOMAIN,
        next(candidate for candidate in ros2.of_settings(settings) if candidate.name == topic),
    )


class LikeRmw:
    """A subscriber of a latched topic as rmw_zenoh declares it, and its messages."""

    def __init__(self, session: zenoh.Session, topic: str) -> None:
        self.told: list[bytes] = []
        self._declared = ext.declare_advanced_subscriber(
            session,
            key(topic),
            lambda sample: self.told.append(sample.payload.to_bytes()),
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )


@pytest.mark.thorough
def test_rviz_and_rqt_are_told_whether_they_come_before_or_after(
    tmp_path: Path, router: zenoh.Session
) -> None:
    (endpoint,) = endpoints(router)
    (tmp_path / "viewed.toml").write_text(CONFIGURATION.format(router=endpoint, state=tmp_path))
    latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
    heard: dict[str, list[Any]] = {}

    def listen(topic: str, kind: str, **more: Any) -> ROS2Subscriber:
        take = heard.setdefault(topic, []).append
        return ROS2Subscriber(topic, callback=take, **typed(kind), **port(endpoint, DOMAIN), **more)

    with open_session(connect=[endpoint]) as node:
        early = {topic: LikeRmw(node, topic) for topic in ("/robot_description", "/tf_static")}
        arguments = ("--config", str(tmp_path / "viewed.toml"))
        with serving(tmp_path, *arguments) as daemon:
            joints = daemon.session.declare_publisher("thirdhand/joints/state")

            def as_the_arm() -> bool:
                joints.put(
                    cdr.encode_joints(
                        JointState(time.time_ns(), JOINT_NAMES, tuple(POSTURE), (0.0,) * 7)
                    )
                )
                return True

            until(
                lambda: as_the_arm() and daemon.client.ask("status")["reason"] == "no_hands",
                "no arm",
            )
            listening = [  # all latched messages have been published before
                listen("/robot_description", "std_msgs/msg/String", qos=latched),
                listen("/tf_static", "tf2_msgs/msg/TFMessage", qos=latched),
                listen("/tf", "tf2_msgs/msg/TFMessage"),
                listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
            ]
            late = {topic: LikeRmw(node, topic) for topic in early}
            until(
                lambda: as_the_arm() and heard["/diagnostics"] and len(heard["/tf"]) > 5,
                "nothing was said",
            )
            until(
                lambda: all(subscriber.told for subscriber in (*early.values(), *late.values())),
                "what is latched was not told",
            )
            began = time.monotonic()
            count = len(heard["/tf"])
            until(lambda: as_the_arm() and len(heard["/tf"]) >= count + 10, "frames ended")
            assert time.monotonic() - began > 0.5  # ten a second, as the loop needs time
            held = heard["/diagnostics"][-1].status[0]
            frames = heard["/tf"][-1].transforms
            with Tracker(daemon.session) as hands:

                def is_at_fault() -> bool:  # a fault, as the arm does not follow
                    away = 0.06 * np.sin(3.0 * time.monotonic())
                    hands.left = (0.92 + away, -0.3, 0.08)
                    hands.right = (0.92 + away, 0.3, 0.08)
                    return bool(as_the_arm() and heard["/diagnostics"][-1].status[0].level == 2)

                until(is_at_fault, "no fault was told")
            assert heard["/robot_description"][0].data == robot_description(Settings())
            assert [
                TYPES.deserialize_cdr(raw, "std_msgs/msg/String").data
                for raw in late["/robot_description"].told
            ] == [robot_description(Settings())]
            assert all(subscriber.told == late[topic].told for topic, subscriber in early.items())
            for subscriber in listening:
                subscriber.close()
    assert (held.level, held.name, held.message[:15]) == (
        1,
        "thirdhand: thirdhand",
        "hold (no_hands)",
    )
    assert heard["/diagnostics"][-1].status[0].message.startswith("fault (arm_")
    values = {pair.key: pair.value for pair in held.values}
    assert (values["mode"], values["reason"]) == ("hold", "no_hands")
    assert float(values["lateness_us.p99"]) >= 0
    assert int(values["missed"]) >= 0
    transforms = [*heard["/tf_static"][0].transforms, *frames]
    assert len({transform.child_frame_id for transform in transforms}) == len(transforms)
    tool = placed([as_told(transform) for transform in transforms], "tool")
    np.testing.assert_allclose(tool, kinematics(Settings(), POSTURE), atol=1e-9)


def as_told(one: Any) -> Transform:
    """A `TransformStamped`."""
    position = one.transform.translation
    q = one.transform.rotation
    return Transform(
        one.header.frame_id,
        one.child_frame_id,
        (position.x, position.y, position.z),
        (q.x, q.y, q.z, q.w),
    )


def placed(transforms: list[Transform], frame: str) -> np.ndarray:
    """The pose of a frame in frame `base` as a 4 x 4 matrix, along its parents."""
    placement = pin.SE3.Identity()
    above = {transform.child: transform for transform in transforms}
    while frame != "base":
        transform = above[frame]
        placement = (
            pin.SE3(
                pin.Quaternion(np.array(transform.rotation)).matrix(),
                np.array(transform.translation),
            )
            * placement
        )
        frame = transform.parent
    return np.array(placement.homogeneous)


def kinematics(settings: Settings, joints: np.ndarray) -> np.ndarray:
    """The tool's pose by Pinocchio, as a 4 x 4 matrix."""
    model = pin.buildModelFromXML(robot_description(settings))
    data = model.createData()
    pin.framesForwardKinematics(model, data, joints)
    offset = settings.tool.plate_from_tool
    tool = pin.SE3(pin.Quaternion(np.array(offset[3:])).matrix(), np.array(offset[:3]))
    return np.array((data.oMf[model.getFrameId(settings.arm.plate)] * tool).homogeneous)


def test_latched_topics_are_delivered_with_certificates(tmp_path: Path) -> None:
    """An observer receives them, a tracker does not."""
    settings = parse(f"network.ros2_domain = {DOMAIN}\n{VIEWED}", origin="cell.toml")
    topics = list(ros2.of_settings(settings.ros2))
    failures: list[str] = []
    sessions = guarded(tmp_path, settings.cell, DOMAIN, topics, "observer", "tracker")
    with sessions as (daemon, observer, tracker):
        domain = Ros2Domain(daemon, settings, topics, failed=failures.append)
        with contextlib.closing(domain):
            admitted, unseen = (
                [LikeRmw(session, topic) for topic in ("/robot_description", "/tf_static")]
                for session in (observer, tracker)
            )
            until(
                lambda: all(subscriber.told for subscriber in admitted), "an observer was not told"
            )
            assert not any(subscriber.told for subscriber in unseen)
        assert failures == []
