"""The daemon as a process on Zenoh: hands in, joint commands out, requests answered, everything
recorded.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from zenoh.handlers import FifoChannel

from support.cell import LEFT, RIGHT, Tracker, serving, thirdhand, told
from support.cell_commands import assert_refused, python, succeeded
from support.in_process import arm
from support.paths import ROOT
from support.recorded import frames_of
from support.wam import JOINT_NAMES
from thirdhand.command_line import main
from thirdhand.contract import cdr, messages, requests
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.status import MeasuredArm
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import Settings, robot_description

HANDOVER = requests.ViaPoint(
    "handover",
    (0.62, -0.28, 0.30),
    RIGHT,
    (0.54, -0.28, 0.38),
    std=0.001,
    radius=0.03,
    follow="left",
)


def following(status: dict[str, Any]) -> bool:
    return bool(status["mode"] == "follow")


@pytest.mark.quick
def test_a_session_from_start_to_end(tmp_path: Path) -> None:
    """Hands are followed, lost, and followed again; via-points are taught; SIGTERM ends the daemon,
    and its recording replays identically.
    """
    records = tmp_path / "records"
    with serving(tmp_path, "--joints", "assumed", "--record", str(records)) as daemon:
        daemon.until(lambda s: (s["mode"], s["reason"]) == ("hold", "no_hands"))
        commands = daemon.session.declare_subscriber("thirdhand/joints/command", FifoChannel(100))
        with Tracker(daemon.session) as tracker:
            daemon.until(following)
            sample = commands.recv()
            command = cdr.decode_joints(sample.payload.to_bytes())
            assert command.names == JOINT_NAMES
            assert len(command.position) == len(command.velocity) == 7
            attachment = cdr.decode_attachment(sample.attachment.to_bytes())
            assert attachment.published_ns >= attachment.hand_stamp_ns
            commands.undeclare()

            reply = daemon.client.add([HANDOVER])
            (point,) = reply.points or ()
            assert point.name == "handover"
            assert point.missed_by_m < 0.005
            assert daemon.until(lambda s: s["tick"] >= reply.tick)["via_points"] == ["handover"]

            tracker.left = None
            assert daemon.until(lambda s: s["mode"] == "hold")["reason"] == "stale_hand"
            tracker.left = LEFT
            daemon.until(following)

            held = daemon.client.hold()
            assert held.tick > 0
            assert (held.mode, held.reason) == ("hold", "operator")
            assert daemon.until(lambda s: s["mode"] == "hold")["reason"] == "operator"
            daemon.client.ask("resume")
            daemon.until(following)
            assert daemon.end() == 0
    (recording,) = records.glob("*.mcap")
    result = replay(recording, output=tmp_path / "whole.mcap")
    assert result.exact, result.text()
    frames = frames_of(tmp_path / "whole.mcap")
    assert not frames["joint_velocities"][-1].any()
    notes = [text for _, text, _ in Recording.open(recording).notes("requests")]
    assert any("handover" in note for note in notes)


def test_at_most_four_samples_a_tick_are_taken(tmp_path: Path) -> None:
    """The samples are recorded in their order, and replayed identically."""
    records = tmp_path / "records"
    period_ns = 20_000_000
    bursts = (3, 1, 3, 2, 3, 30, 3)
    sent: list[list[int]] = []
    with serving(
        tmp_path, "--joints", "assumed", "--rate", "50", "--record", str(records)
    ) as daemon:
        with Tracker(daemon.session):
            daemon.until(following)
        daemon.until(lambda s: s["mode"] == "hold")
        publisher = daemon.session.declare_publisher("thirdhand/hands/left")
        for count in bursts:
            now_ns = time.time_ns()
            sent.append([now_ns + k * period_ns // count for k in range(count)])
            for stamp_ns in sent[-1]:
                pose = messages.PoseStamped(stamp_ns, messages.BASE, LEFT, (0.0, 0.0, 0.0, 1.0))
                publisher.put(cdr.encode_pose(pose))
            time.sleep(5 * period_ns / 1e9)
        assert daemon.end() == 0
    (recording,) = records.glob("*.mcap")
    result = replay(recording)
    assert result.exact, result.text()
    came = [
        [cdr.decode_pose(payload).stamp_ns for kind, payload in step.events if kind == "hands/left"]
        for step in Recording.open(recording).steps()
    ]
    assert max(len(stamps) for stamps in came) <= 4
    taken = [stamp_ns for stamps in came for stamp_ns in stamps]
    for burst in sent:
        end = taken.index(burst[-1]) + 1
        if len(burst) <= 4:
            assert taken[end - len(burst) : end] == burst


def test_via_points_survive_a_restart(tmp_path: Path) -> None:
    """The daemon ends or is killed; the lock of a killed daemon does not keep others out."""
    with serving(tmp_path, "--joints", "assumed") as daemon:
        daemon.client.add([HANDOVER, msgspec.structs.replace(HANDOVER, name="second")])
        daemon.client.ask("via_points", {"op": "remove", "names": ["second"]})
        assert daemon.end() == 0
        assert "earlier run" not in daemon.log.read_text()
    with serving(tmp_path, "--joints", "assumed") as daemon:
        (notice,) = (line for line in daemon.log.read_text().splitlines() if "earlier run" in line)
        (file,) = (tmp_path / "state").rglob("via-points-*.json")
        assert (
            f"via-points of an earlier run are in force (1): handover. They are saved in {file}; "
            in notice
        )
        assert "`thirdhand via-points remove NAME` removes one" in notice
        assert daemon.client.status().via_points == ("handover",)
        listed = daemon.client.ask("via_points", {"op": "list"})["points"]
        assert [(point["name"], point["radius"], point["follow"]) for point in listed] == [
            ("handover", 0.03, "left")
        ]
        daemon.client.ask("via_points", {"op": "clear"})
        daemon.process.kill()
    with serving(tmp_path, "--joints", "assumed") as daemon:
        assert daemon.client.status().via_points == ()


@pytest.fixture(scope="module")
def shared_daemon(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with serving(tmp_path_factory.mktemp("shared"), "--joints", "assumed") as daemon:
        yield daemon
        assert daemon.end() == 0


def test_request_to_many_keys_is_refused(shared_daemon: Any) -> None:
    """Only the status answers a selector of many keys."""
    shared_daemon.client.ask("hold")
    replies = list(shared_daemon.session.get("thirdhand/*", timeout=10))
    assert sum(reply.ok is not None for reply in replies) == 1
    assert (
        shared_daemon.until(lambda s: s["reason"] in ("operator", "arm_not_ready"))["mode"]
        == "hold"
    )
    shared_daemon.client.ask("resume")


def test_the_commands_of_a_client(shared_daemon: Any) -> None:
    connect = ("--connect", shared_daemon.endpoint)
    assert thirdhand("hold", *connect).returncode == 0
    status = told("status", *connect)
    assert status.returncode == 0
    assert "hold (operator)" in status.stdout or "hold (no_hands)" in status.stdout
    assert "resume in force since tick" in told("resume", *connect).stdout
    reset = told("reset", *connect)
    assert (reset.returncode, "there was no fault: nothing was reset" in reset.stdout) == (0, True)
    positions = (
        "--left",
        ".62",
        "-.28",
        ".3",
        "--right",
        ".98",
        ".32",
        ".06",
        "--tool",
        ".62",
        "-.28",
        ".3",
    )
    added = succeeded("via-points", "add", "my point", *positions, *connect)
    assert "my point" in added.stdout
    assert "replaced" not in added.stdout
    repeated = told("via-points", "add", "my point", *positions, *connect)
    assert (
        repeated.returncode,
        repeated.stdout.endswith("replaced, because a via-point had the same name: my point\n"),
    ) == (
        0,
        True,
    )
    assert "1 via-point in force" in told("via-points", "list", *connect).stdout
    assert_refused(1, "in force: my point", "via-points", "remove", "other", *connect)
    succeeded("via-points", "clear", *connect)
    carried = json.loads(told("status", "--json", *connect).stdout)
    assert {"mode", "reason", "tick", "rate_hz", "missed", "rejected"} <= carried.keys()


def test_a_via_point_is_taught_from_where_hands_and_tool_are(
    shared_daemon: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    add = ["via-points", "add", "glass", "--here", "--connect", shared_daemon.endpoint]
    shared_daemon.until(lambda s: not any(age < 300 for age in s["hand_age_ms"].values()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("thirdhand.cli.here.HERE_TIMEOUT_S", 0.0)
        assert main(add) == 1
    message = capsys.readouterr().err
    assert re.search(
        r"nothing was taught: the left hand (has not been seen yet|was last .* ago); --left X Y Z",
        message,
    )
    shared_daemon.client.ask("hold")
    with Tracker(shared_daemon.session):
        status = shared_daemon.until(
            lambda s: s["hand_age_ms"] and max(s["hand_age_ms"].values()) < 50
        )
        assert main(add) == 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("thirdhand.cli.here.HERE_TIMEOUT_S", 0.0)
            assert main(add) == 1
    assert "nothing was taught: hands or tool did not hold still" in capsys.readouterr().err
    (point,) = shared_daemon.client.ask("via_points", {"op": "list"})["points"]
    assert point["name"] == "glass"
    np.testing.assert_allclose(point["left"], LEFT, atol=1e-3)
    np.testing.assert_allclose(point["right"], RIGHT, atol=1e-3)
    np.testing.assert_allclose(point["tool"], status["tool_m"], atol=1e-3)
    shared_daemon.client.ask("via_points", {"op": "clear"})
    shared_daemon.client.ask("resume")


def test_position_of_the_tool_comes_from_the_joints(skill: Skill) -> None:
    """The tool's position follows from the measured joints while the arm reports them."""
    settings = Settings()
    urdf = robot_description(Settings())
    controller = Controller(settings, skill, urdf=urdf)
    joints = settings.arm.posture
    tool = MeasuredArm(settings, urdf)
    expected_m = ArmStage(settings, urdf).at(np.array(joints)).position
    controller.step(Tick(0))
    assert tool.position(controller.state) is None
    controller.step(Tick(1, (arm(joints, 1),)))
    np.testing.assert_allclose(tool.position(controller.state), expected_m, atol=1e-4)
    controller.step(Tick(200))
    assert tool.position(controller.state) is None


def test_a_daemon_that_cannot_listen_says_so(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = thirdhand(
            "serve",
            "--listen",
            endpoint,
            "--joints",
            "assumed",
            env=os.environ | {"HOME": str(tmp_path)},
        )
    assert done.returncode == 1
    assert (
        f"cannot listen on {endpoint}: Address already in use; another program has it; another port"
        in done.stderr
    )
    assert "os error" not in done.stderr


def test_the_client_on_the_page_of_the_wire_works(shared_daemon: Any) -> None:
    code = (
        (ROOT / "docs" / "wire.md")
        .read_text()
        .split("<!-- client -->\n```python\n")[1]
        .split("```")[0]
    )
    code = code.replace("tcp/127.0.0.1:7447", shared_daemon.endpoint)
    done = python(code)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] in ("hold", "follow")
    assert len(lines) > 100
    assert len(code.strip().splitlines()) <= 12
