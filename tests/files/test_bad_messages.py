"""Recordings in which single messages are bad: these are lost and counted, and nothing else is."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from service.cli.main import main
from service.contract import cdr
from service.contract.channels import JOINTS, POSE, TRANSFORMS
from service.contract.messages import GRIPPER, JointState, PoseStamped, Transform
from service.files.demonstration_reader import hand_samples, read_demonstration
from service.files.mcap_file import McapFile, RecordingError
from service.files.mcap_reader import Messages
from service.files.pose_streams import PoseTopic
from service.files.recording import Recording
from service.files.replay import replay
from service.report.columns import read
from support.circling import circling
from support.paths import RECORDINGS
from support.recorded import write

TAKE = circling(0)
HANDS_AND_TOOL = {"/a/hands/left": TAKE.left, "/a/hands/right": TAKE.right, "/a/tool/pose": TAKE.tool}
BAD: dict[str, Callable[[bytes], bytes]] = {
    "nanoseconds of a whole second": lambda data: data[:8] + struct.pack("<I", 10**9) + data[12:],
    "empty": lambda data: b"",
    "cut": lambda data: data[:40],
    "another encoding": lambda data: b"\0\3" + data[2:],
    "not decompressed": lambda data: b"\x28\xb5\x2f\xfd" + data[4:],
    "too long": lambda data: data + bytes(40),
}


def written(path: Path, spoiled: dict[int, Callable[[bytes], bytes]], *, topic: str = "/a/hands/left") -> Path:
    """A take with hands, tool and gripper; of a topic, messages are spoiled by their indices."""
    with McapFile(path, joints=0, attached=False) as file:
        for i, stamp_ns in enumerate((TAKE.stamps_ns + 10**9).tolist()):
            messages = {
                name: (POSE.type, cdr.encode_pose(PoseStamped(stamp_ns, "base", tuple(row[i, :3]), tuple(row[i, 3:]))))
                for name, row in HANDS_AND_TOOL.items()
            }
            state = JointState(stamp_ns, (GRIPPER,), (0.5,), ())
            messages["/a/gripper/state"] = JOINTS.type, cdr.encode_joints(state)
            for name, (kind, data) in messages.items():
                file.put(name, kind, spoiled.get(i, bytes)(data) if name == topic else data, stamp_ns, i)
    return path


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("topic", [*HANDS_AND_TOOL, "/a/gripper/state"])
def test_a_bad_message_is_lost_and_counted(kind: str, topic: str, tmp_path: Path) -> None:
    path = written(tmp_path / "take.mcap", {100: BAD[kind], 200: BAD[kind]}, topic=topic)
    remarks: list[str] = []
    take = read_demonstration(path, say=remarks.append)
    assert len(take.stamps_ns) == len(TAKE.stamps_ns) - 2 * (topic == "/a/tool/pose")
    stamps = np.isin(TAKE.stamps_ns + 10**9, take.stamps_ns)
    np.testing.assert_allclose(take.left[:, :3], TAKE.left[stamps, :3], atol=0.01)
    (remark,) = [line for line in remarks if "not readable" in line]
    assert remark.startswith(f"{path}: {topic}: 2 of {len(TAKE.stamps_ns)} messages are not readable: ")
    if topic == "/a/hands/left":
        said: list[str] = []
        is_compressed = kind == "not decompressed"
        assert len(hand_samples(path, say=said.append)) == 2 * len(TAKE.stamps_ns) - 2
        assert said[0].startswith(f"{path}: 2 of {2 * len(TAKE.stamps_ns)} poses are not readable: {topic}: ")
        assert is_compressed or said[0].partition(topic)[2] == remark.partition("readable")[2]


def test_a_stream_without_a_readable_message_is_refused_with_the_cause(tmp_path: Path) -> None:
    path = written(tmp_path / "take.mcap", dict.fromkeys(range(len(TAKE.stamps_ns)), BAD["cut"]))
    with pytest.raises(
        RecordingError, match="/a/hands/left: 600 of 600 messages are not readable: 40 bytes end before"
    ):
        read_demonstration(path)


def test_a_report_and_a_command_tell_of_bad_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i in (1, 2):
        written(tmp_path / f"take-{i}.mcap", {100: BAD["empty"]})
    main(["learn", *map(str, sorted(tmp_path.glob("take-*"))), "--output", str(tmp_path / "skill.npz")])
    assert "/a/hands/left: 1 of 600 messages are not readable: header missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    "transform",
    [
        cdr.encode_transforms(10**9, [Transform("world", "elbow", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))]),
        cdr.encode_transforms(10**9, [Transform("base", "elbow", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))]).replace(
            struct.pack("<II", 1, 0), struct.pack("<II", 1, 10**9), 1
        ),
        cdr.encode_transforms(10**9, [Transform("base", "elbow", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))]).replace(
            b"elbow", b"\xff\xff\xff\xff\xff"
        ),
    ],
    ids=["two parents", "bad stamp", "bad name"],
)
def test_frames_that_nobody_asked_for_fail_no_take(transform: bytes, tmp_path: Path) -> None:
    path = tmp_path / "take.mcap"
    with McapFile(path, joints=0, attached=False) as file:
        for i, stamp_ns in enumerate((TAKE.stamps_ns + 10**9).tolist()):
            poses = [
                Transform("base", name, tuple(row[i, :3]), tuple(row[i, 3:]))
                for name, row in zip(("left_hand", "right_hand", "tool"), HANDS_AND_TOOL.values(), strict=True)
            ]
            elbow = Transform("base", "elbow", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))
            file.put("/tf", TRANSFORMS.type, cdr.encode_transforms(stamp_ns, [*poses, elbow]), stamp_ns, i)
            file.put("/tf", TRANSFORMS.type, transform, stamp_ns, i)
    topics = {name: PoseTopic.parsed(f"/tf:{part}") for name, part in
              (("left", "left_hand"), ("right", "right_hand"), ("tool", "tool"))}  # fmt: skip
    take = read_demonstration(path, topics=topics)
    np.testing.assert_allclose(take.tool, TAKE.tool)


def spoiled_session(path: Path, source: Path, topic_end: str, index: int) -> Path:
    """A copy of a session in which one message of a topic is empty."""
    count = 0
    messages = Messages(source)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in messages:
            if not channels:
                for name, data in messages.attachments.items():
                    writer.add_attachment(0, 0, name, "", data)
                writer.add_metadata("thirdhand", messages.metadata["thirdhand"])
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            is_topic = channel.topic.endswith(topic_end)
            data = b"" if is_topic and count == index else message.data
            count += is_topic
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()
    assert count > index
    return path


@pytest.mark.thorough
@pytest.mark.parametrize("topic_end", ["/hands/left", "/joints/state", "/tick", "/frame"])
def test_a_session_is_replayed_up_to_a_bad_message(topic_end: str, tmp_path: Path) -> None:
    result = replay(spoiled_session(tmp_path / "a.mcap", RECORDINGS / "golden.mcap", topic_end, 10))
    assert f"a message on /thirdhand{topic_end}: " in result.text()
    assert result.identical == result.ticks > 0
    assert not result.exact


@pytest.mark.parametrize("topic_end", ["/hands/left", "/joints/state", "/tick", "/frame", "/timing", "/clutch"])
def test_a_session_is_reported_around_a_bad_message(topic_end: str, tmp_path: Path) -> None:
    write(tmp_path / "whole.mcap", 600)
    columns = read(Recording.open(spoiled_session(tmp_path / "a.mcap", tmp_path / "whole.mcap", topic_end, 10)))
    assert f"a message on /hall/bench-1{topic_end}: " in "\n".join(columns.gaps)
    assert len(columns.ticks) >= 598
