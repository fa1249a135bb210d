"""Demonstrations read from recordings of others: bags with poses in arrays, trees of frames and
joint states, in a tracker's axes and unit, with different clocks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from support.paths import RECORDINGS
from thirdhand.contract.channels import POSE
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import HandSettings, Settings
from thirdhand.workbench.takes.demonstration_reader import hand_samples, read_demonstration
from thirdhand.workbench.takes.pose_streams import POSE_TYPES, TAKE_KEYS, PoseTopic

STORE = get_typestore(Stores.ROS2_HUMBLE)
STAMPS = np.arange(40) * 10_000_000 + 1_000_000_000
WAY = np.linspace(0.0, 0.2, len(STAMPS))


def made(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(stamp_ns: int, frame: str) -> Any:
    stamp = made(
        "builtin_interfaces/msg/Time", sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9)
    )
    return made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def pose(x: float, y: float, z: float) -> Any:
    position = made("geometry_msgs/msg/Point", x=x, y=y, z=z)
    turn = made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    return made("geometry_msgs/msg/Pose", position=position, orientation=turn)


def stamped(stamp_ns: int, frame: str, *at: float) -> Any:
    return made("geometry_msgs/msg/PoseStamped", header=header(stamp_ns, frame), pose=pose(*at))


def array(stamp_ns: int, frame: str, *places: tuple[float, float, float]) -> Any:
    return made(
        "geometry_msgs/msg/PoseArray",
        header=header(stamp_ns, frame),
        poses=[pose(*place) for place in places],
    )


def tree(stamp_ns: int, frame: str, **places: tuple[float, float, float]) -> Any:
    transforms = []
    for child, place in places.items():
        x, y, z = place
        transform = made(
            "geometry_msgs/msg/Transform",
            translation=made("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=pose(*place).orientation,
        )
        transforms.append(
            made(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp_ns, frame),
                child_frame_id=child,
                transform=transform,
            )
        )
    return made("tf2_msgs/msg/TFMessage", transforms=transforms)


def bag(
    path: Path, topics: dict[str, list[Any]], *, plugin: StoragePlugin = StoragePlugin.SQLITE3
) -> Path:
    """A bag with one message of each topic at each of STAMPS, in the order of time."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, messages in topics.items():
            connections[topic] = writer.add_connection(
                topic, messages[0].__msgtype__, typestore=STORE
            )
        for i, stamp_ns in enumerate(STAMPS.tolist()):
            for topic, messages in topics.items():
                data = STORE.serialize_cdr(messages[i], messages[i].__msgtype__)
                writer.write(connections[topic], stamp_ns + 1_000_000, data)
    return path


def moving(make: Any, *arguments: Any) -> list[Any]:
    """A message for each of STAMPS, made of its stamp and the distance covered by then."""
    return [
        make(stamp, *arguments, distance_m)
        for stamp, distance_m in zip(STAMPS.tolist(), WAY.tolist(), strict=True)
    ]


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_arrays_and_trees_are_read_from_bags(tmp_path: Path, plugin: StoragePlugin) -> None:
    """Hands in an array and a tool in a tree are read from bags."""
    hands = moving(lambda stamp, way: array(stamp, "base", (way, 0.3, 0.0), (way, -0.3, 0.0)))
    frames = moving(
        lambda stamp, way: tree(stamp, "base", elbow=(0.0, 0.0, 1.0), glass=(0.5, way, 0.2))
    )
    folder = bag(tmp_path / "bag", {"/mocap/hands": hands, "/tf": frames}, plugin=plugin)
    sources = {
        name: PoseTopic.parsed(text)
        for name, text in (
            ("left", "mocap/hands:1"),
            ("right", "/mocap/hands:0"),
            ("tool", "/tf:glass"),
        )
    }
    (file,) = [path for path in folder.iterdir() if path.suffix != ".yaml"]
    for path in (folder, file):
        got = read_demonstration(path, topics=sources)
        np.testing.assert_array_equal(got.stamps_ns, STAMPS)
        np.testing.assert_allclose(got.left[:, :2], np.column_stack([WAY, np.full(len(WAY), -0.3)]))
        np.testing.assert_allclose(
            got.tool[:, :3], np.column_stack([np.full(len(WAY), 0.5), WAY, np.full(40, 0.2)])
        )
    if plugin is StoragePlugin.SQLITE3:
        with contextlib.closing(
            sqlite3.connect(file)
        ) as recorder:  # a recorder that was killed before it wrote metadata
            recorder.execute("PRAGMA journal_mode = WAL")
            recorder.execute("DELETE FROM messages WHERE timestamp > ?", (int(STAMPS[20]),))
            recorder.commit()
            shutil.copytree(folder, killed := tmp_path / "killed")
        (killed / "metadata.yaml").unlink()
        assert (killed / f"{file.name}-wal").stat().st_size > 0
        for path in (killed, killed / file.name):
            assert len(read_demonstration(path, topics=sources).stamps_ns) == 20
        path = file
    for selection, words in (
        ({"left": PoseTopic("/mocap/hands")}, r"--left /mocap/hands: an index needed, one of 0, 1"),
        (
            {**sources, "tool": PoseTopic("/tf", "iron")},
            r"--tool /tf:iron: a child frame needed, one of elbow, glass",
        ),
        (
            {"left": PoseTopic("/nowhere")},
            r"--left /nowhere: no topic there; its topics: .*topics with poses: /mocap",
        ),
        (
            {},
            r"hands/left .*: /mocap/hands \(geometry_msgs/msg/PoseArray\), .* read: .*; --left "
            r"TOPIC",
        ),
    ):
        with pytest.raises(RecordingError, match=words):
            read_demonstration(path, topics=selection)


def odometry(stamp_ns: int, frame: str, *at: float) -> Any:
    zero = made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    still = made("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return made(
        "nav_msgs/msg/Odometry",
        header=header(stamp_ns, frame),
        child_frame_id="hand",
        pose=made("geometry_msgs/msg/PoseWithCovariance", pose=pose(*at), covariance=np.zeros(36)),
        twist=made("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
    )


@pytest.mark.parametrize("read", [read_demonstration, hand_samples])
@pytest.mark.parametrize(
    ("kind", "encoding"),
    [
        ("geometry_msgs/msg/Pose", "cdr"),
        ("geometry_msgs/msg/PointStamped", "cdr"),
        (POSE.type, "json"),
    ],
)
def test_unread_type_is_refused_with_accepted_types(
    kind: str, encoding: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    """The refusal names the type and the accepted types."""
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        schema = writer.register_schema(kind, "", b"")
        for topic in TAKE_KEYS.values():
            writer.add_message(writer.register_channel(topic, encoding, schema), 0, b"", 0)
        writer.finish()
    type_text = kind if encoding == "cdr" else f"{kind} in {encoding}"
    accepted = POSE.type if read is hand_samples else ", ".join(POSE_TYPES)
    with pytest.raises(RecordingError, match=re.escape(f"hands/left ({type_text})")) as refusal:
        read(tmp_path / "a.mcap")
    assert accepted in str(refusal.value)


def test_odometry_of_a_tracker_is_read_as_poses(tmp_path: Path) -> None:
    tool = moving(stamped, "base", 0.5, 0.0)
    got = read_demonstration(
        bag(tmp_path / "bag", {"/left_hand": moving(odometry, "base", 0.3, 0.0), "/tool": tool})
    )
    np.testing.assert_allclose(
        got.left[:, :3], np.column_stack([np.full(40, 0.3), np.zeros(40), WAY])
    )


def test_streams_are_found_by_name_and_brought_to_base(tmp_path: Path) -> None:
    """The streams are of a motion capture in millimetres with y up, the arm's base 1 m before its
    origin.
    """
    y_up = Rotation.from_euler("x", 90, degrees=True)
    frames = moving(
        lambda stamp, way: tree(
            stamp, "mocap", LeftWrist=(way, 0.0, -300.0), RightWrist=(900.0, 1.0, 0.0)
        )
    )
    elbows = moving(lambda stamp, way: tree(stamp, "mocap", LeftElbow=(way, 0.0, 0.0)))
    tool = moving(lambda stamp, way: stamped(stamp, "base", 0.5, way, 0.2))
    path = bag(tmp_path / "bag", {"/tf": frames, "/tf_elbows": elbows, "/arm/tcp": tool})
    hands = HandSettings(
        frame="mocap", unit="mm", base_from_tracker=(1.0, 0.0, 0.0, *y_up.as_quat().tolist())
    )
    remarks: list[str] = []
    got = read_demonstration(path, settings=Settings(hands=hands), say=remarks.append)
    expected_m = y_up.apply(np.column_stack([WAY, np.zeros(40), np.full(40, -300.0)])) / 1000 + [
        1.0,
        0.0,
        0.0,
    ]
    np.testing.assert_allclose(got.left[:, :3], expected_m, atol=1e-12)
    np.testing.assert_allclose(got.left[:, 3:], np.tile(y_up.as_quat(), (40, 1)), atol=1e-12)
    np.testing.assert_allclose(got.tool[:, 1], WAY)
    assert "left is /tf:LeftWrist; right is /tf:RightWrist; tool is /arm/tcp" in remarks[0]
    assert "hands/left, hands/right transformed to frame base" in remarks[0]
    with pytest.raises(RecordingError, match=r"tool.*; /arm/tcp, /hand/gripper could be it"):
        read_demonstration(
            bag(tmp_path / "two", {"/tf": frames, "/arm/tcp": tool, "/hand/gripper": tool})
        )


def test_tool_is_found_from_joint_states(tmp_path: Path) -> None:
    """The clocks differ, without effect."""
    settings = Settings()
    begin_ns = STAMPS[0]
    joints = np.array(settings.arm.posture) + np.outer(WAY, np.ones(7))

    def state(stamp: int, way: float) -> Any:
        i = int(np.argmin(np.abs(WAY - way)))
        return made(
            "sensor_msgs/msg/JointState",
            header=header(stamp - begin_ns, ""),  # the arm's clock began at 0
            name=list(settings.joints.names[::-1]),
            position=joints[i, ::-1].copy(),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )

    topics = {
        "/cell/hands/left": moving(stamped, "", 0.3, 0.0),
        "/cell/hands/right": moving(stamped, "", -0.3, 0.0),
        "/joint_states": moving(state),
    }
    remarks: list[str] = []
    got = read_demonstration(bag(tmp_path / "bag", topics), say=remarks.append)
    assert "tool is computed from /joint_states by the arm's URDF" in remarks[0]
    assert "stamps come from different clocks" in remarks[1]
    assert "tool/pose by -1.001 s" in remarks[1]
    np.testing.assert_array_equal(got.stamps_ns, STAMPS + 1_000_000)
    np.testing.assert_allclose(got.left[:, 2], WAY)
    assert np.ptp(got.tool[:, :3], axis=0).max() > 0.05
    assert np.abs(got.tool[0, :3] - [0.45, 0.0, 0.3]).max() < 0.5
    foreign = [
        dataclasses.replace(message, name=["a", *message.name[1:]])
        for message in topics["/joint_states"]
    ]
    with pytest.raises(
        RecordingError, match=r"no topic ending in tool/pose .* or joints/state of the arm's joints"
    ):
        read_demonstration(bag(tmp_path / "foreign", {**topics, "/joint_states": foreign}))


def test_what_is_no_bag_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(b"nothing")
    for path in (tmp_path, tmp_path / "a.db3", tmp_path / "b.bag"):
        with pytest.raises(
            RecordingError, match=r"is not a bag that can be read: |there is no file .*bag"
        ):
            read_demonstration(path)


def test_recording_of_a_daemon_is_a_demonstration() -> None:
    """The golden session has a dropout, bad samples, and no `tool/pose`."""
    remarks: list[str] = []
    got = read_demonstration(RECORDINGS / "golden.mcap", say=remarks.append)
    assert re.search(
        r"tool is computed from .*joints/state by the arm's URDF; \d+ of \d+ poses are invalid or "
        r"farther",
        remarks[0],
    )
    assert any(
        re.search(r"left out, \d\.\d of 20\.0 s: hands/left 6\.48 to 7\.19 s: not seen", line)
        for line in remarks
    )
    assert got.seconds[got.begins[0]] - got.seconds[got.begins[0] - 1] == pytest.approx(0.71)
    assert len(got.stamps_ns) > 1800
    assert np.abs(got.tool[:, :3]).max() < 1.0
