"""The README's program runs as it stands, and its first commands are in a working order."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from support.cell import Tracker, serving
from support.installed import isolated, unpacked, wheel_of
from support.paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


def program() -> str:
    """The program that is marked in the README."""
    programs = re.findall(r"<!-- program -->\n```python\n(.*?)```", README, re.DOTALL)
    assert len(programs) == 1
    return str(programs[0])


def test_program_runs_as_it_stands_by_the_client_alone(tmp_path: Path) -> None:
    """Only the client's packages are installed; the service follows the program's hands."""
    assert len([line for line in program().splitlines() if line]) <= 10
    site = unpacked(wheel_of(ROOT, tmp_path), tmp_path / "site")
    with serving(tmp_path, "--joints", "assumed") as daemon:
        environment = {"THIRDHAND_CONNECT": daemon.endpoint, "HOME": str(tmp_path)}
        # on a busy machine the hands may be stale, or the skill worker late
        for _ in range(3):
            done = isolated(site, program(), "zenoh", "msgspec", env=environment)
            held = daemon.client.status().reason
            daemon.client.resume()
            if done.stdout.startswith("mode follow"):
                break
    assert (done.returncode, done.stderr, held) == (0, "", "operator")
    assert (
        done.stdout
        == "mode follow: the tool is at (0.5, -0.2, 0.4), its target at (0.5, -0.2, 0.4)\n"
    )


def test_the_arm_follows_as_it_stands(tmp_path: Path) -> None:
    """Ten lines are an arm, which follows the service's commands."""
    (code,) = re.findall(r"<!-- arm -->\n```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in code.splitlines() if line]) <= 10
    (tmp_path / "my_arm.py").write_text(code)
    with serving(tmp_path) as daemon, Tracker(daemon.session):
        command = [sys.executable, "-m", "thirdhand", "follow", f"{tmp_path}/my_arm.py:MyArm"]
        arm = subprocess.Popen([*command, "--connect", daemon.endpoint], cwd=ROOT)
        daemon.until(lambda status: status["mode"] == "follow", 60.0)
        arm.send_signal(signal.SIGINT)
        assert arm.wait(20) == 0


def test_the_tracker_of_the_tutorial_moves_the_tool(tmp_path: Path) -> None:
    """The page's program runs, shortened: the left hand moves to the tool once."""
    page = (ROOT / "docs" / "first-tracker.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"<!-- tracker -->\n```python\n(.*?)```", page, re.DOTALL)
    with serving(tmp_path, "--joints", "assumed") as daemon:
        environment = os.environ | {"THIRDHAND_CONNECT": daemon.endpoint}
        before = daemon.client.status().tool_m
        command = [sys.executable, "-c", code.replace("range(3000)", "range(315)")]
        done = subprocess.run(
            command,
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        after = daemon.client.status().tool_m
    assert before is not None
    assert after is not None
    assert math.dist(before, after) > 0.1


def test_environment_is_activated_before_a_bare_command() -> None:
    lines = [
        line
        for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
        for line in block.splitlines()
    ]
    first = next(i for i, line in enumerate(lines) if line.startswith("thirdhand "))
    assert ". .venv/bin/activate" in lines[:first]


def test_the_two_commands_have_the_form_that_programs_look_for() -> None:
    for name, last in (
        ("run", ".venv/bin/thirdhand demo"),
        ("test", ".venv/bin/python -m pytest tests/test_latency.py"),
    ):
        (command,) = re.findall(rf"^<!-- {name} -->\n```sh\n(.*)\n```$", README, re.MULTILINE)
        assert command.startswith("python3.11 -m venv .venv && ")
        assert command.endswith(last)
