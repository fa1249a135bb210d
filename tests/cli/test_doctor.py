"""A cell with one's own arm and tracker: the driver template follows and brakes by itself, and
`doctor`, `status --watch` and the log name faults.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from support.cell import LEFT, Daemon, Tracker, until
from support.cell_commands import started
from support.driven_arms import driven
from support.repeated import repeated
from thirdhand.arms.simulated import SimulatedArm
from thirdhand.client import endpoints, open_session
from thirdhand.command_line import main
from thirdhand.contract import cdr, messages
from thirdhand.daemon.launch import launched
from thirdhand.daemon.single_instance import occupy
from thirdhand.settings.config import Settings

NEAR_LEFT = (0.95, -0.30, 0.08)  # the hand moves little, so that a late arm has a small error
PATIENT = """# Threads of a busy test may be late.
[network]
listen = ["tcp/127.0.0.1:0"]
[arm]
silent_ms = 1000
fault_error_rad = 0.5
[hands]
frame = "optitrack"
stale_ms = 500
"""
OF_THE_MACHINE = {"machine", "loop", "real time", "memory", "disk"}


@contextlib.contextmanager
def simulated(endpoint: str) -> Iterator[SimulatedArm]:
    """A simulated arm, driven on a session of its own."""
    arm = SimulatedArm(Settings())
    with open_session(connect=[endpoint]) as session, driven(arm, session):
        yield arm


@contextlib.contextmanager
def misnamed(session: zenoh.Session) -> Iterator[None]:
    """A tracker that publishes under a misspelled key."""
    pose = messages.PoseStamped(1, "base", LEFT, (0.0, 0.0, 0.0, 1.0))
    with repeated(lambda: session.put("thirdhand/hands/Left", cdr.encode_pose(pose)), 0.02):
        yield


def findings(
    daemon: Daemon, capsys: pytest.CaptureFixture[str], *more: str
) -> tuple[int, list[dict[str, str]]]:
    """Exit code and findings of `thirdhand doctor`, without those of this machine."""
    capsys.readouterr()
    code = main(["doctor", "--json", "--seconds", "0.5", "--connect", daemon.endpoint, *more])
    report = json.loads(capsys.readouterr().out)
    return code, [finding for finding in report if finding["what"] not in OF_THE_MACHINE]


@pytest.mark.thorough
def test_a_cell_with_ones_own_arm_and_tracker(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        launched(tmp_path, record=tmp_path / "records", network=PATIENT) as service,
        open_session(connect=[service.endpoint]) as session,
        contextlib.ExitStack() as watching,
    ):
        daemon = Daemon(service, session)
        with misnamed(daemon.session):
            code, report = findings(daemon, capsys)
        wrong = {finding["what"]: finding for finding in report if finding["level"] == "wrong"}
        assert (code, wrong.keys()) == (
            1,
            {"mode", "left hand", "right hand", "arm", "arm's driver"},
        )
        assert all(finding["wanted"] and finding["remedy"] for finding in wrong.values())
        assert "no joint states arrived yet" in wrong["mode"]["found"]
        assert wrong["left hand"]["found"] == "nothing arrives, but on thirdhand/hands/Left"
        assert wrong["left hand"]["remedy"].startswith(
            "let it publish under the cell's key, thirdhand/hands/left; or start the tracker"
        )

        with simulated(daemon.endpoint) as arm, Tracker(daemon.session) as tracker:
            daemon.until(lambda status: status["mode"] == "follow")
            # the rate is known some time after the driver's first state
            for _ in range(5):
                _, report = findings(daemon, capsys)
                if all(finding["level"] == "ok" for finding in report):
                    break
            assert {finding["level"] for finding in report} == {"ok"}, report
            assert {"left hand", "right hand", "arm", "recording"} <= {
                finding["what"] for finding in report
            }

            tracker.left = NEAR_LEFT
            daemon.until(lambda status: any(arm.velocity))
            assert main(["resume", "--connect", daemon.endpoint]) == 0
            assert "there was no hold to end" in capsys.readouterr().out

            watch = watching.enter_context(
                started("status", "--watch", "--connect", daemon.endpoint)
            )
            line = watch.stdout.readline()
            assert " | follow" in line
            assert line.count("Hz") == 2
            assert all(f" | {name} (" in line for name in ("left", "right", "tool", "target"))

            tracker.left = None
            foreign = messages.PoseStamped(0, "camera", NEAR_LEFT, (0.0, 0.0, 0.0, 1.0))

            def refused(status: dict[str, object]) -> bool:
                payload = cdr.encode_pose(foreign._replace(stamp_ns=time.time_ns()))
                daemon.session.put("thirdhand/hands/left", payload)
                return "wrong_frame" in str(status["because"])

            refusal = daemon.until(refused)
            assert (refusal["reason"], refusal["remedy"][:19]) == (
                "stale_hand",
                "find [hands] frame ",
            )
            assert "frame 'camera'; 'base', 'optitrack' or none accepted" in refusal["because"]
            assert set(refusal["hands_m"]) == {"left", "right"}
            time.sleep(1.5)  # for a line of the watch
            tracker.left = LEFT
            daemon.until(lambda status: any(arm.velocity))
            daemon.process.kill()
            daemon.process.wait()
            until(lambda: not any(arm.velocity))
        output, ended = watch.communicate(timeout=20)
        assert "hold (stale_hand)" in output
        assert "left not seen for" in output
        assert (watch.returncode, "nothing arrives on thirdhand/status" in ended) == (1, True)
        log = daemon.log.read_text()
        assert log.count("left hand: rejected as wrong_frame: frame 'camera'") == 1
        assert main(["doctor", "--connect", daemon.endpoint]) == 1
        assert "nothing listens on 127.0.0.1 port" in capsys.readouterr().out


def test_foreign_port_is_distinguished_from_a_closed_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A port of another program is distinguished from a closed one."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert main(["doctor", "--connect", f"tcp/127.0.0.1:{other.getsockname()[1]}"]) == 1
    assert "opens no Zenoh session" in capsys.readouterr().out


def test_a_cell_of_another_name_is_pointed_out(
    listener: zenoh.Session, capsys: pytest.CaptureFixture[str]
) -> None:
    token = listener.liveliness().declare_token("lab/bench2/daemon/1")
    assert main(["doctor", "--connect", endpoints(listener)[0], "--cell", "lab"]) == 1
    token.undeclare()  # type: ignore[no-untyped-call]
    output = capsys.readouterr().out
    assert (
        "nobody answers on lab/status: only daemons of other cells run there: lab/bench2" in output
    )
    assert "give the name of the cell by --cell" in output


def test_silent_daemon_is_distinguished_from_none(
    listener: zenoh.Session, capsys: pytest.CaptureFixture[str]
) -> None:
    """A daemon that runs but does not answer is distinguished from none."""
    token = occupy(listener, "lab")
    reach = ["--connect", endpoints(listener)[0], "--cell", "lab"]
    assert main(["doctor", *reach]) == 1
    doctor = capsys.readouterr().out
    assert main(["status", *reach]) == 1
    status = capsys.readouterr().err
    token.undeclare()  # type: ignore[no-untyped-call]
    for output in (doctor, status):
        assert "its daemon is alive, but it is starting or ending" in output
        assert "start `thirdhand serve`" not in output
