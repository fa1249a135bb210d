"""Recordings with single bad messages: only these are lost, and they are counted."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.circling import circling
from support.paths import RECORDINGS
from support.recorded import write
from thirdhand.contract.channels import JOINTS, POSE, TAKE_KEYS
from thirdhand.recordings.mcap_file import McapFile, RecordingError
from thirdhand.recordings.mcap_reader import Messages, full_name
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay
from thirdhand.workbench.report.columns import read
from thirdhand.workbench.takes.demonstration_reader import (
    hand_samples,
    read_demonstration,
    write_demonstration,
)

TAKE = circling(0)._replace(gripper=np.full(600, 0.5))
BAD: dict[str, Callable[[bytes], bytes]] = {
    "nanoseconds of a whole second": lambda data: data[:8] + struct.pack("<I", 10**9) + data[12:],
    "empty": lambda data: b"",
    "a Pose": lambda data: data[:4] + struct.pack("<7d", *[0.5] * 7),
    "cut": lambda data: data[:40],
    "not decompressed": lambda data: b"\x28\xb5\x2f\xfd" + data[4:],
}


def spoiled(
    source: Path, topic: str, kind: str = "empty", indices: range = range(10, 11), retyped: str = ""
) -> Path:
    """A copy of a recording in which the messages of a topic with these indices are bad, and the
    topic has the named type.
    """
    path = source.with_name("spoiled.mcap")
    messages = Messages(source)
    count = 0
    next(iter(messages))
    with McapFile(path, joints=7) as file:
        for name, data in messages.attachments.items():
            file.attach(name, data, 0)
        for name, about in messages.metadata.items():
            file.writer.add_metadata(name, about)
        for schema, channel, message in messages:
            is_bad = channel.topic == topic and count in indices
            count += channel.topic == topic
            data = BAD[kind](message.data) if is_bad else message.data
            named = retyped if retyped and channel.topic == topic else full_name(schema)
            file.put(channel.topic, named, data, message.log_time, 0)
    return path


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("key", [*TAKE_KEYS.values(), "gripper/state"])
def test_a_bad_message_is_lost_and_counted(kind: str, key: str, tmp_path: Path) -> None:
    topic = f"/thirdhand/{key}"
    remarks = list[str]()
    write_demonstration(tmp_path / "take.mcap", TAKE)
    path = spoiled(tmp_path / "take.mcap", topic, kind, range(100, 300, 100))
    take = read_demonstration(path, say=remarks.append)
    assert len(take.stamps_ns) == 600 - 2 * (key == "tool/pose")
    np.testing.assert_allclose(
        take.left, TAKE.left[np.isin(TAKE.stamps_ns, take.stamps_ns)], atol=0.01
    )
    assert f"{path}: {topic}: 2 of 600 messages are not readable: " in "\n".join(remarks)
    if key == "hands/left":
        assert len(hand_samples(path, say=remarks.append)) == 1198
        assert remarks[-1].startswith(f"{path}: 2 of 1200 poses are not readable: {topic}: ")
        with pytest.raises(
            RecordingError, match="hands/left: 600 of 600 messages are not readable: "
        ):
            read_demonstration(spoiled(tmp_path / "take.mcap", topic, kind, range(600)))


@pytest.mark.parametrize("key", ["hands/left", "tool/pose", "gripper/state"])
def test_a_topic_of_another_type_is_named_with_accepted_ones(key: str, tmp_path: Path) -> None:
    """A stream of another type is refused, or left out with a remark; never left out silently."""
    topic = f"/thirdhand/{key}"
    write_demonstration(tmp_path / "take.mcap", TAKE)
    path = spoiled(tmp_path / "take.mcap", topic, retyped="geometry_msgs/msg/Pose")
    remarks = list[str]()
    accepted = JOINTS.type if key == "gripper/state" else POSE.type
    words = rf"{topic} \(geometry_msgs/msg/Pose\).*{accepted}"
    if key == "gripper/state":
        assert read_demonstration(path, say=remarks.append).gripper is None
        assert re.search(words, "\n".join(remarks))
        return
    with pytest.raises(RecordingError, match=words):
        read_demonstration(path)
    if key == "hands/left":
        assert {side for _, side, _ in hand_samples(path, say=remarks.append)} == {"right"}
        assert re.search(words, remarks[0])


def test_bytes_of_another_type_than_the_schema_are_named(tmp_path: Path) -> None:
    """Bytes of a Pose under the schema of a PoseStamped are named as such."""
    write_demonstration(tmp_path / "take.mcap", TAKE)
    path = spoiled(tmp_path / "take.mcap", "/thirdhand/hands/left", "a Pose", range(600))
    words = "60 bytes that fit geometry_msgs/msg/Pose or Transform; geometry_msgs/msg/PoseStamped"
    with pytest.raises(RecordingError, match=words):
        read_demonstration(path)


@pytest.mark.parametrize("key", ["hands/left", "tick", "frame"])
def test_a_session_is_read_around_a_bad_message(key: str, tmp_path: Path) -> None:
    (tmp_path / "golden.mcap").symlink_to(RECORDINGS / "golden.mcap")
    result = replay(spoiled(tmp_path / "golden.mcap", f"/thirdhand/{key}"))
    assert f"a message on /thirdhand/{key}: " in result.text()
    assert result.identical == result.ticks > 0
    assert not result.exact
    write(tmp_path / "whole.mcap", 600)
    columns = read(Recording.open(spoiled(tmp_path / "whole.mcap", f"/hall/bench-1/{key}")))
    assert f"a message on /hall/bench-1/{key}: " in "\n".join(columns.gaps)
    assert len(columns.ticks) >= 598
