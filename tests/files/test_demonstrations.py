"""Demonstrations and hands read from MCAP files of this service and of others: found by the ends of
topic names, and brought to common stamps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from support.recorded import START_NS
from thirdhand.contract import cdr, channels, messages
from thirdhand.contract.ros2msg import schema
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import Settings, TrackerSettings
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.demonstration_reader import read_demonstration, write_demonstration


def _swaying(count: int) -> np.ndarray:
    """Poses (3, T, 7) of hands and tool that move and turn as people do, 100 a second."""
    random = np.random.default_rng(1)
    t = 0.01 * np.arange(count)
    phases = random.uniform(0.0, 6.0, (3, 6, 1))
    waves = np.sin(3.0 * t + phases)
    turns = Rotation.from_rotvec((0.3 * waves[:, 3:]).transpose(0, 2, 1).reshape(-1, 3)).as_quat()
    return np.concatenate(
        [0.2 * waves[:, :3].transpose(0, 2, 1), turns.reshape(3, count, 4)], axis=2
    )


def test_demonstration_is_written_and_read_unchanged(tmp_path: Path) -> None:
    """Written again, it gives the same bytes."""
    stamps = START_NS + np.arange(200) * 10_000_000
    poses = _swaying(200)
    write_demonstration(tmp_path / "a.mcap", Demonstration(stamps, *poses), cell="north/3")
    write_demonstration(tmp_path / "b.mcap", Demonstration(stamps, *poses), cell="north/3")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    got = read_demonstration(tmp_path / "a.mcap")
    assert got.frame == "base"
    for a, b in zip(got[:4], (stamps, *poses), strict=True):
        np.testing.assert_array_equal(a, b)
        assert not a.flags.writeable


def test_streams_are_mapped_by_the_tracker_of_their_frame(tmp_path: Path) -> None:
    """The hands' tracker reports millimetres and is turned by 90 degrees; the tool is in `base`."""
    stamps = START_NS + np.arange(50) * 10_000_000
    path = tmp_path / "a.mcap"
    left, right, tool = _swaying(50)
    quarter = Rotation.from_euler("z", 90, degrees=True)
    tracker_poses = []
    for poses in (left, right):
        turned = quarter.inv() * Rotation.from_quat(poses[:, 3:])
        tracker_poses.append(
            np.hstack([1000 * quarter.inv().apply(poses[:, :3] - [0.1, 0, 0]), turned.as_quat()])
        )
    streams = {
        "/x/hands/left": tracker_poses[0],
        "/x/hands/right": tracker_poses[1],
        "/x/tool/pose": tool,
    }
    _streams(path, {name: (stamps, poses) for name, poses in streams.items()}, frame="mocap")
    mocap = TrackerSettings(
        unit="mm", base_from_tracker=(0.1, 0.0, 0.0, *quarter.as_quat().tolist())
    )
    remarks: list[str] = []
    read = read_demonstration(
        path, settings=Settings(trackers={"mocap": mocap}), say=remarks.append
    )
    for name, poses in (("left", left), ("right", right), ("tool", tool)):
        np.testing.assert_allclose(getattr(read, name)[:, :3], poses[:, :3], atol=1e-9)
    mapped = (
        "hands/left, hands/right transformed to frame base by [trackers.mocap] unit and "
        "base_from_tracker"
    )
    assert mapped in remarks[0]
    with pytest.raises(
        RecordingError, match="hands/left is in frame 'mocap': 'base' needed, or a configuration"
    ):
        read_demonstration(path)
    far = Settings(trackers={"mocap": TrackerSettings()})
    why = r"looks like cm; \[trackers.mocap\] unit is 'm'.*set \[trackers.mocap\] unit in"
    with pytest.raises(RecordingError, match=why):
        read_demonstration(path, settings=far)


def test_gripper_comes_back_at_the_tools_stamps(tmp_path: Path) -> None:
    stamps = START_NS + np.arange(50) * 10_000_000
    poses = _swaying(50)
    closure = np.linspace(0.0, 1.0, 50)
    write_demonstration(tmp_path / "a.mcap", Demonstration(stamps, *poses, gripper=closure))
    np.testing.assert_array_equal(read_demonstration(tmp_path / "a.mcap").gripper, closure)
    with pytest.raises(ValueError, match=r"gripper/state: shape \(7,\) given"):
        write_demonstration(tmp_path / "b.mcap", Demonstration(stamps, *poses, gripper=closure[:7]))


def _streams(
    path: Path, streams: dict[str, tuple[np.ndarray, np.ndarray]], *, frame: str = "base"
) -> None:
    """Write poses as a ROS 2 recorder does, each topic at its own stamps."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        pose = writer.register_schema(
            channels.POSE.type, "ros2msg", schema(channels.POSE.type).encode()
        )
        other = writer.register_channel(
            "/chatter", "json", writer.register_schema("x", "jsonschema", b"{}")
        )
        writer.add_message(other, 0, b"{}", 0)
        for topic, (stamps, poses) in streams.items():
            channel = writer.register_channel(topic, "cdr", pose)
            for stamp, row in zip(stamps.tolist(), poses.tolist(), strict=True):
                frame_id = frame if "hands" in topic else "base"
                writer.add_message(
                    channel,
                    stamp + 5,
                    cdr.encode_pose(
                        messages.PoseStamped(stamp, frame_id, tuple(row[:3]), tuple(row[3:]))
                    ),
                    stamp,
                )
        writer.finish()


def _line(stamps: np.ndarray, slope: float) -> np.ndarray:
    poses = np.zeros((len(stamps), 7))
    poses[:, 0] = slope * stamps / 1e9
    poses[:, 6] = np.where(np.arange(len(stamps)) % 2, -1.0, 1.0)
    return poses


def test_streams_are_brought_to_the_stamps_of_the_tool(tmp_path: Path) -> None:
    left = np.arange(0, 1000, 7) * 1_000_000
    right = np.arange(30, 900, 11) * 1_000_000
    tool = np.arange(0, 1000, 5) * 1_000_000
    _streams(
        tmp_path / "a.mcap",
        {
            "/x/hands/left": (left, _line(left, 1)),
            "/x/hands/right": (right, _line(right, 2)),
            "/x/tool/pose": (tool, _line(tool, 3)),
        },
    )
    got = read_demonstration(tmp_path / "a.mcap")
    assert (got.stamps_ns[0], got.stamps_ns[-1]) == (30_000_000, 895_000_000)
    for poses, slope in zip(got[1:4], (1, 2, 3), strict=True):
        np.testing.assert_allclose(poses[:, 0], slope * got.stamps_ns / 1e9, atol=1e-12)
        np.testing.assert_allclose(np.abs(poses[:, 6]), 1.0, atol=1e-12)


def test_a_demonstration_that_lacks_something_says_what(tmp_path: Path) -> None:
    stamps = np.arange(5) * 1_000_000
    good = (stamps, _line(stamps, 1))
    _streams(tmp_path / "a.mcap", {"/x/tool/pose": good})
    with pytest.raises(
        RecordingError,
        match=r"ending in hands/left .* topics: /chatter \(x in json\), /x/tool/pose",
    ):
        read_demonstration(tmp_path / "a.mcap")
    _streams(tmp_path / "a.mcap", {"/x/hands/left": good, "/y/hands/left": good})
    with pytest.raises(
        RecordingError, match=r"two streams of hands/left: /x/hands/left and /y/hands/left"
    ):
        read_demonstration(tmp_path / "a.mcap")
    all_three = {"/x/hands/left": good, "/x/hands/right": good, "/x/tool/pose": good}
    late = (stamps + 10**12, good[1])
    _streams(tmp_path / "a.mcap", all_three | {"/x/tool/pose": late})
    with pytest.raises(RecordingError, match="by different clocks"):
        read_demonstration(tmp_path / "a.mcap")
    still = (stamps * 0, good[1])
    _streams(tmp_path / "a.mcap", all_three | {"/x/tool/pose": still})
    with pytest.raises(
        RecordingError, match="5 poses on tool/pose with 1 different stamps, 2 needed"
    ):
        read_demonstration(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match=r"hands/right: shape \(4, 7\) given"):
        write_demonstration(
            tmp_path / "b.mcap", Demonstration(stamps, good[1], good[1][:4], good[1])
        )
    for wrong, words in ((stamps * 1e-9, "float64 from 0 on"), (stamps - 1, "int64 from -1 on")):
        with pytest.raises(
            ValueError, match=rf"stamps_ns: {words} given, integers \[ns\] from 0 on needed"
        ):
            write_demonstration(tmp_path / "b.mcap", Demonstration(wrong, *[good[1]] * 3))
