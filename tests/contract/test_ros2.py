"""A cell as ROS 2 sees it, against independent implementations: type hashes of rosbags, names and
attachments of zenoh-ros2-sdk.
"""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import (
    endpoint_liveliness_keyexpr,
    node_liveliness_keyexpr,
    topic_keyexpr,
)
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from thirdhand.contract import cdr, channels, ros2
from thirdhand.settings.config import parse
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.network import Ros2

CELL = "lab/bench2"
DOMAIN = 7
SESSION = "1a2b"
COMMANDS = "/forward/commands"
TRAJECTORY = "/arm_controller/joint_trajectory"
STATES = "/joint_states"
VIEWED = {"tf": "/arm/tf", "robot_description": "/robot_description", "diagnostics": "/diagnostics"}
HANDS = {"hands": ["/tf:left_wrist", "/mocap/tf:right"], "tool": "/tf:iron"}
NAMED = msgspec.convert(
    VIEWED
    | HANDS
    | {"position_commands": COMMANDS, "trajectory": TRAJECTORY, "joint_states": STATES},
    Ros2,
)
FRAMES = ("/tf", "/mocap/tf")
LATCHED = ("/arm/tf_static", "/robot_description")


@pytest.mark.parametrize("store", [Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_the_hashes_of_the_types_are_those_of_ros2(store: Stores) -> None:
    types = get_typestore(store)
    assert {kind: f"RIHS01_{digest}" for kind, digest in ros2.TYPE_HASHES.items()} == {
        kind: types.hash_rihs01(kind) for kind in ros2.TYPE_HASHES
    }


def test_every_stream_has_the_key_and_token_of_rmw_zenoh() -> None:
    """Key and token equal those of another implementation."""
    topics = [ros2.of_channel(CELL, channel) for channel in (*ros2.HEARD, *ros2.SAID)]
    topics += ros2.of_settings(NAMED)
    tokens = ros2.tokens(DOMAIN, CELL, SESSION, topics)
    node = NodeEntity(DOMAIN, SESSION, 0, ros2.NODE, f"/{CELL}")
    assert tokens.pop(("", False)) == node_liveliness_keyexpr(node)
    streams = [
        c.key
        for c in channels.CHANNELS
        if c.direction == "out" or (c.direction == "in" and c.event)
    ]
    stream_names = [f"/{CELL}/{suffix}" for suffix in streams]
    assert {name for name, _ in tokens} == {
        *stream_names,
        COMMANDS,
        TRAJECTORY,
        STATES,
        *VIEWED.values(),
        *LATCHED,
        *FRAMES,
    }
    # three frames arrive on two topics
    once = [*{(topic.name, topic.heard): topic for topic in topics}.values()]
    assert [(topic.frame, topic.channel) for topic in topics if topic.frame] == [
        ("left_wrist", "hands/left"),
        ("right", "hands/right"),
        ("iron", "tool/pose"),
    ]
    for number, (((name, _), token), topic) in enumerate(
        zip(tokens.items(), once, strict=True), start=1
    ):
        named = (name, ros2_to_dds_type(topic.type), f"RIHS01_{ros2.TYPE_HASHES[topic.type]}")
        is_in = name.removeprefix(f"/{CELL}/") in [c.key for c in ros2.HEARD] or name in (
            STATES,
            *FRAMES,
        )
        quality = QosProfile(
            reliability=QosReliability.BEST_EFFORT if is_in else QosReliability.RELIABLE
        )
        if name in LATCHED:
            quality = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
        entity = EntityKind.SUBSCRIPTION if is_in else EntityKind.PUBLISHER
        assert token == endpoint_liveliness_keyexpr(
            EndpointEntity(node, number, entity, *named, quality.encode())
        )
        assert ros2.key(DOMAIN, topic) == topic_keyexpr(DOMAIN, *named)


def test_what_controllers_are_told_is_read_by_others() -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    array: Any = types.deserialize_cdr(
        cdr.encode_numbers((0.5, -1.0, 2.0)), "std_msgs/msg/Float64MultiArray"
    )
    assert (array.data.tolist(), array.layout.dim, array.layout.data_offset) == (
        [0.5, -1.0, 2.0],
        [],
        0,
    )
    for names in (("a",), ("base", "elbow", "wrist_1")):
        raw = cdr.encode_trajectory(names, (0.1,) * len(names), (-0.2,) * len(names), 2_000_000)
        trajectory: Any = types.deserialize_cdr(raw, "trajectory_msgs/msg/JointTrajectory")
        [point] = trajectory.points
        assert (
            trajectory.header.stamp.sec,
            trajectory.header.stamp.nanosec,
            tuple(trajectory.joint_names),
        ) == (0, 0, names)
        assert point.positions.tolist() == [0.1] * len(names)
        assert point.velocities.tolist() == [-0.2] * len(names)
        assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 2_000_000)
        assert bytes(types.serialize_cdr(trajectory, "trajectory_msgs/msg/JointTrajectory")) == raw


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            'ros2.trajectory = "/a/b"',
            r"\[network\] ros2_domain: none given; for /a/b one from 0 to 232 needed",
        ),
        ('ros2.tf = "tf"', r"\[ros2\] tf: 'tf' given; a topic's full name, /like/this, accepted"),
        (
            'ros2.hands = ["/tf:l", ""]',
            r"\[network\] ros2_domain: none given; for /tf one from 0 to 232 needed",
        ),
        (
            'ros2.hands = ["/tf:l", "/tf"]',
            r"hands, entry 2: '/tf' given; a topic and a frame, like /tf:left_wrist, acc",
        ),
        (
            'ros2.hands = ["/tf:l", "/tf:l"]',
            r"entry 2: '/tf:l' given; another frame than that of \[ros2\] hands, entry 1",
        ),
        (
            'ros2.hands = ["", "/tf_static:l"]',
            r"entry 2: '/tf_static:l' given; a topic of frames that move needed",
        ),
        (
            'ros2.hands = ["/tf:left_hand", ""]\nros2.tf = "/tf"',
            r"'/tf:left_hand' given, which this cell publishes its",
        ),
        (
            "network.ros2_domain = 233",
            r"ros2_domain: 233 given; a whole number from 0 to 232 accepted",
        ),
        (
            'ros2.joints = ["elbow"]',
            r"\[ros2\] joints: \['elbow'\] given; those of \[joints\] names needed, in any",
        ),
    ],
)
def test_controllers_that_cannot_be_told_are_refused(given: str, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        parse(given, origin="cell.toml")


def test_what_rides_with_a_message_is_read_by_others() -> None:
    gid = ros2.gid("token")
    assert Attachment.from_bytes(
        ros2.encode_attachment(3, 1_700_000_000_000_000_001, gid)
    ) == Attachment(3, 1_700_000_000_000_000_001, gid)
    assert len(ros2.encode_attachment(1, 1, gid)) == 33


@pytest.mark.parametrize(
    ("cell", "ok"),
    [
        ("thirdhand", True),
        ("lab_1/b2", True),
        ("bench-2", False),
        ("2nd", False),
        ("a__b", False),
        ("a/", False),
    ],
)
def test_cell_name_is_checked_only_with_a_ros2_domain(cell: str, ok: bool) -> None:
    """A name that ROS 2 does not allow is refused only if a domain is configured."""
    assert ros2.is_name(cell) == ok
    if cell.endswith("/"):
        return
    assert parse(f"cell = {cell!r}", origin="cell.toml").cell == cell
    domain = f"cell = {cell!r}\nnetwork.ros2_domain = 0"
    if ok:
        assert parse(domain, origin="cell.toml").network.ros2_domain == 0
    else:
        with pytest.raises(
            SettingsError, match=r"cell\.toml: cell: .* given; with \[network\] ros2_domain names"
        ):
            parse(domain, origin="cell.toml")
