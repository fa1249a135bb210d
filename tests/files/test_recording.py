"""Recordings: messages come back bit for bit, cut files are read up to the cut, and other ROS 2
tools read every message.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from support.recorded import CELL, SKILL, at_ns, state_after, ticks, write
from support.wam import FRAME
from thirdhand.contract import cdr, channels
from thirdhand.contract.channels import EVENT_NUMBERS
from thirdhand.core.frame import blank, encode
from thirdhand.recordings.mcap_file import McapFile, RecordingError
from thirdhand.recordings.recording import Recorder, Recording
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.demonstration_reader import write_demonstration


def test_what_was_written_comes_back_bit_for_bit(tmp_path: Path) -> None:
    written = write(tmp_path / "a.mcap")
    recording = Recording.open(tmp_path / "a.mcap")
    first, *steps = recording.steps()
    assert (recording.settings, recording.skill, recording.truncated) == (CELL, SKILL, False)
    assert first.frame is None
    assert encode(first.state) == encode(state_after(-1))
    assert len(steps) == len(written)
    for step, (tick, frame, timing) in zip(steps, written, strict=True):
        assert step.tick == tick.index
        assert step.events == tuple((event.kind, event.payload) for event in tick.inbox)
        assert encode(step.frame) == encode(frame)
        assert encode(step.timing) == encode(timing)
        assert (step.state is None) == (tick.index % 100 != 99)
        assert (step.time_ns, step.lost, step.skill) == (at_ns(tick.index), 0, None)
    assert {kind for step in steps for kind, _ in step.events} == set(EVENT_NUMBERS)
    assert list(recording.notes("status"))[:2] == [
        ("status", "tick 0", at_ns(0)),
        ("status", "tick 50", at_ns(50)),
    ]


def test_step_after_a_gap_brings_state_and_skill(tmp_path: Path) -> None:
    """The step after a gap has the number of missing ticks too."""
    with Recorder(tmp_path / "a.mcap", settings=CELL, skill=SKILL) as recorder:
        for tick, frame, _ in ticks(10):
            recorder.write(tick, frame, time_ns=at_ns(tick.index))
        for count, skill in ((4, b"other"), (2, b"other"), (1, SKILL)):
            (tick, frame, _), *_ = ticks(1, first=20 + count)
            recorder.write(
                tick,
                frame,
                time_ns=at_ns(tick.index),
                state=state_after(tick.index),
                skill=skill,
                lost=count,
            )
    steps = list(Recording.open(tmp_path / "a.mcap").steps())
    assert [(step.tick, step.lost, step.skill) for step in steps[10:]] == [
        (24, 4, b"other"),
        (22, 2, None),
        (21, 1, SKILL),
    ]
    assert all(step.state is not None for step in steps[10:])


@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_a_cut_recording_is_read_up_to_the_cut_and_says_so(tmp_path: Path, share: float) -> None:
    written = write(tmp_path / "a.mcap", 600)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * share)])
    recording = Recording.open(tmp_path / "cut.mcap")
    assert recording.truncated
    steps = list(recording.steps())[1:]
    assert share * 600 * 0.5 < len(steps) < 600
    assert all(
        encode(step.frame) == encode(frame)
        for step, (_, frame, _) in zip(steps, written, strict=False)
    )


def test_what_was_flushed_survives_when_nothing_is_closed(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", settings=CELL, skill=SKILL)
    for tick, frame, _ in ticks(40):
        recorder.write(tick, frame, time_ns=at_ns(tick.index))
    recorder.flush()
    assert [step.tick for step in Recording.open(tmp_path / "a.mcap").steps()] == list(range(40))
    recorder.close()
    recorder.close()


def test_errors_name_the_file_what_is_wrong_and_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=re.escape(f"no recording {tmp_path}/a.mcap.")):
        Recording.open(tmp_path / "a.mcap")
    write_demonstration(
        tmp_path / "demo.mcap", Demonstration(np.arange(3) * 10, *np.ones((3, 3, 7)))
    )
    (tmp_path / "notes.mcap").write_text("not an MCAP file at all", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"Its folder has: demo.mcap, notes.mcap\."):
        Recording.open(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match=r"notes.mcap is not an MCAP file"):
        Recording.open(tmp_path / "notes.mcap")
    with pytest.raises(RecordingError, match="not a recording of thirdhand"):
        Recording.open(tmp_path / "demo.mcap")
    write(tmp_path / "b.mcap", 1)
    (tmp_path / "b.mcap").write_bytes((tmp_path / "b.mcap").read_bytes()[:600])
    with pytest.raises(RecordingError, match="cut before its first message"):
        Recording.open(tmp_path / "b.mcap")


def test_a_note_may_not_pose_as_what_a_replay_needs(tmp_path: Path) -> None:
    with (
        Recorder(tmp_path / "a.mcap", settings=CELL, skill=SKILL) as recorder,
        pytest.raises(ValueError, match="'frame'"),
    ):
        recorder.note("frame", "x", 0)


def test_event_of_unknown_kind_is_refused(tmp_path: Path) -> None:
    """The error names the tick."""
    file = McapFile(tmp_path / "a.mcap", joints=7)
    with Recorder(tmp_path / "b.mcap", settings=CELL, skill=SKILL) as recorder:
        recorder.close()
    recording = Recording.open(tmp_path / "b.mcap")
    file.put("/hall/bench-1/tick", channels.TICK.type, cdr.encode_tick(3, b"\xff", 0), 0, 0)
    file.put("/hall/bench-1/frame", channels.FRAME.type, encode(blank(FRAME)), 0, 0)
    file.close()
    recording.path = tmp_path / "a.mcap"
    with pytest.raises(RecordingError, match="after tick 3: a Tick with an event of kind 255"):
        list(recording.steps())


def test_ros_2_tools_read_every_message_of_a_recording(tmp_path: Path) -> None:
    written = write(tmp_path / "a.mcap", 120)
    with (tmp_path / "a.mcap").open("rb") as stream:
        decoded = [
            (channel.topic, message)
            for _, channel, _, message in make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    topics = {topic for topic, _ in decoded}
    assert {"/tf", "/robot_description"} < topics
    now_and_then = {"skill_in_force", "requests", "log", "objects", "gripper/command"}
    always = [
        channel.key
        for channel in channels.CHANNELS
        if channel.recorded and channel.key not in now_and_then
    ]
    assert {channels.topic("hall/bench-1", key) for key in always} == topics
    frames = [message for topic, message in decoded if topic == "/hall/bench-1/frame"]
    assert list(frames[-1].joints) == written[-1][1]["joints"].tolist()
    assert frames[-1].mode == 1
    with warnings.catch_warnings(), AnyReader([tmp_path / "a.mcap"]) as reader:
        read = [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]
    assert len(read) == len(decoded)
    assert (
        next(
            message.position.tolist()
            for topic, message in reversed(read)
            if topic.endswith("joints/command")
        )
        == written[-1][1]["joints"].tolist()
    )
