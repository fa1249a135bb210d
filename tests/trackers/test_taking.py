"""Demonstrations recorded over Zenoh: received samples are written, the tool follows from the
joints, rest ends a take and is left out, and takes are shown, trimmed and deleted.
"""

from __future__ import annotations

import contextlib
import re
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from support.cell import until
from support.repeated import repeated
from thirdhand.client import endpoints, open_session
from thirdhand.command_line import main
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState, PoseStamped
from thirdhand.contract.requests import Add, encode_json
from thirdhand.core.arm.stage import ArmStage
from thirdhand.daemon.launch import free_port
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import HandSettings, Settings, ToolSettings, robot_description
from thirdhand.workbench.takes.demonstration_files import demonstration_paths, summary, table, uncut
from thirdhand.workbench.takes.demonstration_reader import (
    hand_samples,
    read_demonstration,
    write_demonstration,
)
from thirdhand.workbench.takes.pose_streams import PoseRecording, PoseTopic
from thirdhand.workbench.trackers.capture import (
    JOINT_STATES,
    Capture,
    CaptureError,
    Sample,
    capture,
)
from thirdhand_sim.scene import Scene
from thirdhand_sim.teach import perform

SETTINGS = Settings(
    hands=HandSettings(
        unit="mm", frame="tracker", base_from_tracker=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    )
)
NOTHING = {"until": "key", "rest_s": 1.0, "is_ended": lambda: False, "longest_s": 9.0}


@pytest.fixture(scope="module")
def sessions(listener: zenoh.Session) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A session that receives, and a connected session that publishes."""
    with open_session(connect=endpoints(listener)) as sender:
        yield listener, sender


def encoded(stamp_ns: int, frame: str, *position: float) -> bytes:
    """A message of an unturned pose."""
    return cdr.encode_pose(PoseStamped(stamp_ns, frame, position, (0.0, 0.0, 0.0, 1.0)))  # type: ignore[arg-type]


def heard(taken: Capture, count: int) -> None:
    """Wait until this number of messages has arrived."""

    def is_complete() -> bool:
        taken.collect()
        return sum(map(len, taken.samples.values())) + sum(taken.malformed.values()) >= count

    until(is_complete)


def test_a_take_holds_what_came_and_the_tool_by_the_joints(
    sessions: tuple[zenoh.Session, zenoh.Session], tmp_path: Path
) -> None:
    hearing, sender = sessions
    taken = Capture(hearing, "bench", SETTINGS)
    joints = np.array(SETTINGS.arm.posture)
    publishers = {key: sender.declare_publisher(f"bench/{key}") for key in taken.samples}
    until(lambda: all(publisher.matching_status.matching for publisher in publishers.values()))
    sent = []
    for i in range(30):
        stamp = 10**18 + i * 10_000_000
        for side, y in (("left", -300.0), ("right", 300.0)):
            sent.append(encoded(stamp, "tracker", 10.0 * i, y, 0.0))
            publishers[f"hands/{side}"].put(sent[-1])
        state = JointState(stamp, SETTINGS.joints.names, tuple((joints + 0.01 * i).tolist()), ())
        publishers[JOINT_STATES].put(cdr.encode_joints(state))
        heard(taken, 3 * (i + 1))
    unstamped = (0.5, -0.3, 0.2, 0.0, 0.0, 0.0, 1.0)
    publishers["hands/left"].put(cdr.CDR_HEADER + struct.pack("<7d", *unstamped))
    publishers["hands/left"].put(encoded(0, "", float("nan"), 0.0, 0.0))
    heard(taken, 92)
    taken.close()
    assert taken.malformed == {"hands/left": 2}
    assert taken.unreadable == [
        "2 messages on hands/left are not readable: 60 bytes that fit geometry_msgs/msg/Pose or "
        "Transform; geometry_msgs/msg/PoseStamped needed: a stamp of 1071644672 ns beside its "
        "seconds, less than 1000000000 needed"
    ]
    path = tmp_path / "a.mcap"
    taken.write(path)
    assert list(tmp_path.iterdir()) == [path]
    assert sorted(cdr.encode_pose(pose) for *_, pose in hand_samples(path)) == sorted(sent)
    got = read_demonstration(path)
    arm = ArmStage(SETTINGS, robot_description(SETTINGS))
    assert got.left[0, :3].tolist() == [1.0, -0.3, 0.0]
    np.testing.assert_allclose(got.tool[-1, :3], arm.at(joints + 0.29).position, atol=1e-12)
    assert PoseRecording(path).settings == SETTINGS
    longer = Settings(
        tool=ToolSettings(plate_from_tool=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)), hands=SETTINGS.hands
    )
    of_joints = {"tool": PoseTopic("bench/joints/state")}
    np.testing.assert_array_equal(read_demonstration(path, settings=longer).tool, got.tool)
    moved = read_demonstration(path, settings=longer, topics=of_joints).tool - got.tool
    np.testing.assert_allclose(np.linalg.norm(moved[:, :3], axis=1), 0.1)


def test_what_is_not_heard_is_named(
    sessions: tuple[zenoh.Session, zenoh.Session], tmp_path: Path
) -> None:
    with pytest.raises(
        CaptureError,
        match=r"not received: hands/left, hands/right, tool/pose or joints/state\. Are tracker",
    ):
        capture(sessions[0], "bench", SETTINGS, wait_s=0.0, **NOTHING)  # type: ignore[arg-type]
    empty = Capture(sessions[0], "bench", SETTINGS)
    empty.close()
    with pytest.raises(CaptureError, match=r"no messages on hands/left, .* arrived in time"):
        empty.write(tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


@contextlib.contextmanager
def published(
    session: zenoh.Session, poses: dict[str, tuple[float, float, float]]
) -> Iterator[None]:
    """A context in which a session publishes each position under its key, at 100 Hz, stamped with
    the time.
    """
    publishers = {key: session.declare_publisher(key) for key in poses}

    def publish() -> None:
        for key, position in poses.items():
            publishers[key].put(encoded(time.time_ns(), "base", *position))

    with repeated(publish):
        yield


@pytest.mark.parametrize(
    ("poses", "wait_s", "words"),
    [
        (
            {
                "bench/hands/left": (980.0, -320.0, 60.0),
                "bench/hands/right": (0, 0, 1),
                "bench/tool/pose": (0, 0, 1),
            },
            20.0,
            r"^hands/left is at \(980, -320, 60\), which looks like mm; \[hands\] unit is 'm', at "
            r"most 5 m from the "
            r"base plate accepted: set \[hands\] unit .*--config\)\. Nothing was recorded",
        ),
        (
            {
                "thirdhand/hands/Left": (0, 0, 1),
                "bench7/hands/left": (0, 0, 1),
                "bench/hands/right": (0, 0, 1),
            },
            1.0,
            r"not received: hands/left, tool.*; received instead: bench7/hands/left, "
            r"thirdhand/hands/Left\. Are",
        ),
    ],
)
def test_unsuitable_streams_are_reported_before_recording(
    sessions: tuple[zenoh.Session, zenoh.Session], poses: dict[str, Any], wait_s: float, words: str
) -> None:
    """The streams are published in an unsuitable form."""
    with published(sessions[1], poses), pytest.raises(CaptureError, match=words):
        capture(sessions[0], "bench", Settings(), wait_s=wait_s, **NOTHING)  # type: ignore[arg-type]


def test_a_take_that_a_request_begins_tells_when(
    sessions: tuple[zenoh.Session, zenoh.Session], tmp_path: Path
) -> None:
    """It is told of a rest before the motion, after cutting, and in a take that is written."""
    poses = {f"bench/{key}": (0.1, 0.2, 0.3) for key in ("hands/left", "hands/right", "tool/pose")}
    since_s = time.monotonic()
    asked = iter([False] * 10 + [True] * 100)
    lines: list[str] = []
    with published(sessions[1], poses):
        taken = capture(
            sessions[0],
            "bench",
            Settings(),
            until="rest",
            rest_s=1.0,
            is_ended=lambda: len(lines) > 2 and time.monotonic() - since_s > 2.0,
            wait_s=20.0,
            longest_s=1.0,
            is_begun=lambda: next(asked),
            say=lines.append,
        )
    assert lines[1].startswith("hands and tool arrive: Enter begins the take")
    path = tmp_path / "take.mcap"
    taken.write(path)
    take = read_demonstration(path)
    assert take.begun_s == pytest.approx(0.0, abs=0.1)
    assert main(["record", "take", "--folder", str(tmp_path), "--trim", "0.3", "0.9"]) == 0
    cut = read_demonstration(path)
    assert cut.begun_s == pytest.approx(0.3, abs=0.1)
    write_demonstration(path, cut)
    assert read_demonstration(path).begun_s == pytest.approx(cut.begun_s, abs=1e-8)


def test_take_too_far_away_says_where_and_in_which_unit(
    sessions: tuple[zenoh.Session, zenoh.Session], tmp_path: Path
) -> None:
    """Positions in `base` are in metres; hands, and poses in the tracker's frame, are in `[hands]
    unit`.
    """
    taken = Capture(sessions[0], "bench", Settings(hands=HandSettings(unit="mm", frame="tracker")))
    path = tmp_path / "a.mcap"
    taken.close()

    def told(tool: tuple[str, float]) -> None:
        for key, frame, scale in (
            ("hands/left", "tracker", 1e3),
            ("hands/right", "", 1e3),
            ("tool/pose", *tool),
        ):
            taken.samples[key] = [
                Sample(stamp, encoded(stamp, frame, 0.3 * scale, 0.0, 0.0), np.zeros(3))
                for stamp in range(10**18, 10**18 + 9 * 10**7, 10**7)
            ]
        taken.write(path)

    told(("tracker", 1e3))
    taken.check()
    report = summary(path)
    assert report.demonstration.tool[0, :3].tolist() == pytest.approx([0.3, 0.0, 0.0])
    assert [line.split(":")[0] for line in report.remarks if "of motion" in line] == [
        "hands",
        "tool",
    ]
    told(("base", 1e3))
    words = (
        r"at \(300, 0, 0\), which looks like mm; tool/pose in frame 'base' is always in metres, "
        r"and \[hands\] unit is ignored"
    )
    with pytest.raises(CaptureError, match=f"tool/pose is {words}"):
        taken.check()
    with pytest.raises(
        RecordingError, match=f"all 9 poses on tool/pose are too far away; the first is {words}"
    ):
        read_demonstration(path)
    with pytest.raises(
        RecordingError,
        match=r"all 9 poses on hands/left are too far away; .* \[hands\] unit is 'm', at most",
    ):
        read_demonstration(path, settings=Settings(hands=HandSettings(frame="tracker")))


@pytest.mark.parametrize("key", ["hands/right", "tool/pose"])
def test_pose_in_an_unknown_frame_ends_the_take_early(
    sessions: tuple[zenoh.Session, zenoh.Session], key: str
) -> None:
    """The take ends before it begins."""
    for hands, refused in ((HandSettings(), True), (HandSettings(frame="camera"), False)):
        taken = Capture(sessions[0], "bench", Settings(hands=hands))
        taken.close()
        pose = encoded(10**18, "camera", 0.3, 0.0, 0.0)
        taken.samples[key] = [Sample(10**18, pose, np.zeros(3))]
        if refused:
            words = (
                rf"{key} is in frame 'camera': 'base' needed, or a configuration .*\. Nothing was "
                r"recorded"
            )
            with pytest.raises(CaptureError, match=words):
                taken.check()
        else:
            taken.check()


def samples_of(way: np.ndarray, end_ns: int) -> list[Sample]:
    """Samples each 10 ms up to now, at positions (N,) along one axis [m]."""
    times = end_ns - np.arange(len(way))[::-1] * 10_000_000
    return [
        Sample(int(at_ns), b"", np.array([x, 0.0, 0.0]))
        for at_ns, x in zip(times, way, strict=True)
    ]


def test_rest_after_motion_is_the_end_and_is_left_out(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    taken = Capture(sessions[0], "bench", SETTINGS)
    now_ns = time.time_ns()
    taken.close()
    noise = 0.002 * np.random.default_rng(0).standard_normal(400)
    pause = np.zeros(100)
    motion = np.concatenate([np.zeros(100), np.linspace(0, 0.5, 150), np.full(150, 0.5)])
    for path, over in ((np.tile(pause, 4), False), (motion[:300], False), (motion, True)):
        taken.samples |= {
            key: samples_of(noise[: len(path)], now_ns) for key in ("hands/left", "hands/right")
        }
        taken.samples["tool/pose"] = samples_of(path, now_ns)
        assert taken.is_over(1.0) is over
    start_ns, end_ns = taken.span_of_motion()
    expected_ns = now_ns - np.array([(400 - 100 - 5 + 30) * 10**7, (150 + 5 - 30) * 10**7])
    np.testing.assert_allclose(
        np.array([start_ns, end_ns]) - now_ns, expected_ns - now_ns, atol=6e7
    )
    assert taken.keep_motion() == pytest.approx((0.75, 1.25), abs=0.06)
    assert 190 < len(taken.samples["tool/pose"]) < 220


def test_a_demonstration_is_recorded_shown_trimmed_and_deleted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command records the bench's teacher at eight times the speed."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    options = {"connect": [endpoint], "cell": "thirdhand", "speed": 8.0, "wait_s": 20.0}
    teacher = threading.Thread(target=perform, args=(Scene(),), kwargs=options | {"seed": 1})
    teacher.start()
    folder = ["--folder", str(tmp_path / "takes")]
    ended = ["--until", "rest", "--rest", "0.5"]
    (tmp_path / "via-points.json").write_bytes(encode_json(Add(Scene().via_points())))
    ended += ["--via-points", str(tmp_path / "via-points.json"), "--person", "Ada"]
    assert main(["record", "take-1", "--listen", endpoint, *ended, *folder]) == 0
    teacher.join(20)
    path = tmp_path / "takes" / "take-1.mcap"
    captured = capsys.readouterr()
    assert (
        "waiting for hands/left, hands/right, tool/pose or joints/state of cell thirdhand"
        in captured.err
    )
    assert (
        "recording; it ends once hands and tool stay within 15 mm (joints 0.02 rad) for 0.5 s after"
        in captured.err
    )
    assert "ended by rest: hands and tool stay within 15 mm" in captured.err
    assert re.search(r"rest left out: \d\.\d s before the motion, \d\.\d s after it", captured.err)
    report = summary(path)
    assert captured.out.strip() == table(report)
    assert "  by Ada\n  via-points handover, glass, soldering\n" in captured.out
    assert 1.0 < report.lasts_s < 2.5
    assert [stream.name for stream in report.streams] == ["left", "right", "tool"]
    assert all(stream.poses > 20 and stream.frame == "base" for stream in report.streams)
    tool = report.demonstration.tool[:, :3]
    assert np.linalg.norm(tool[0] - Scene().robot_start) < 0.05
    assert np.linalg.norm(tool[-1] - Scene().carry) < 0.05

    whole = path.read_bytes()
    assert main(["record", "take-1", "--trim", "0.3", "0.9", *folder]) == 0
    assert summary(path).lasts_s == pytest.approx(0.6, abs=0.1)
    assert re.search(
        r"\d\.\d s cut to 0\.\d s; the uncut take is kept as .*take-1\.mcap\.uncut",
        capsys.readouterr().err,
    )
    assert uncut(path).read_bytes() == whole
    assert demonstration_paths(path.parent) == [path]
    assert summary(path).demonstration.via_points == Scene().via_points()
    assert summary(path).demonstration.person == "Ada"
    assert PoseRecording(path).settings == Settings()
    capsys.readouterr()
    (tmp_path / "takes" / "take-0.mcap").write_bytes(b"")
    assert main(["record", "--list", *folder]) == 1
    captured = capsys.readouterr()
    assert "take-0 " in captured.out
    assert "is not an MCAP file" in captured.out
    assert "Hz, right " in captured.out
    assert "2 takes in" in captured.err
    assert main(["record", "take-1", "--delete", *folder]) == 0
    assert not path.exists()
    assert not uncut(path).exists()


@pytest.mark.parametrize("who", ["left", "right"])
def test_a_hand_that_conducts_alone_is_taken_without_the_other(
    sessions: tuple[zenoh.Session, zenoh.Session], tmp_path: Path, who: str
) -> None:
    hearing, sender = sessions
    taken = Capture(hearing, "alone", Settings(), who)  # type: ignore[arg-type]
    assert taken.missing == [f"hands/{who}", "tool/pose or joints/state"]
    for i in range(20):
        for key in ("hands/left", "hands/right", "tool/pose"):
            message = encoded(10**18 + i * 10**7, "base", 0.01 * i, 0.0, 0.5)
            sender.put(f"alone/{key}", message)
        heard(taken, 2 * (i + 1))
    taken.close()
    taken.write(tmp_path / "a.mcap")
    got = read_demonstration(tmp_path / "a.mcap")
    assert got.conducts == who
    assert "hands/" + ("right" if who == "left" else "left") not in " ".join(
        PoseRecording(tmp_path / "a.mcap").topics
    )
    np.testing.assert_array_equal(got.left, got.right)
    lines = table(summary(tmp_path / "a.mcap")).splitlines()
    assert any(f"the {who} hand leads alone" in line for line in lines)
    assert [line.split()[0] for line in lines if line.endswith(" m/s")] == [who, "tool"]
