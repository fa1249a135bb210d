"""An arm of Universal Robots through its maker's library, against a simulated control box: it
follows, a protective stop ends the command in words, and after it the arm follows again.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from support.cell import LEFT, LISTENING, Tracker, serving
from support.paths import ROOT
from thirdhand.arms import DriveError
from thirdhand.arms.drive import follow
from thirdhand.arms.universal_robots import UniversalRobotsArm
from thirdhand.client import open_session
from thirdhand.core.limiter.stage import Limited
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings

pytest.importorskip("rtde_control")
ADDRESS = f"127.77.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"  # its ports are fixed
UR5 = cell_of("ur5")
NEAR_LEFT = (0.85, -0.30, 0.10)


class Box:
    """A running control box; `stop` begins or ends its protective stop."""

    def __init__(self) -> None:
        script = ROOT / "tests" / "support" / "ur_robot.py"
        posture = map(str, UR5.arm.posture)
        self._process = subprocess.Popen(
            [sys.executable, str(script), ADDRESS, *posture],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def stop(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def close(self) -> None:
        self._process.communicate(timeout=20)


@pytest.fixture
def box() -> Iterator[Box]:
    with contextlib.closing(Box()) as box:
        yield box


def sway(arm: UniversalRobotsArm, lasts_s: float, *, leads: bool = True) -> float:
    """The error [rad], root mean square, of joints that sway by 0.4 rad, as measured after the
    first half second.
    """
    start = np.array(UR5.arm.posture)
    rate = 2.0 * np.pi * 0.3
    squares = []
    with arm:
        for tick in range(round(lasts_s / arm.period_s)):
            arm.wait()
            at_s = tick * arm.period_s
            wanted = start + 0.2 * (1.0 - np.cos(rate * at_s))
            squares.append((arm.measured()[0] - wanted) ** 2)
            velocity = np.full(6, 0.2 * rate * np.sin(rate * at_s))
            acceleration = np.full(6, 0.2 * rate**2 * np.cos(rate * at_s))
            ahead = arm.lag_s * velocity + acceleration / arm.gain
            arm.write(wanted + leads * ahead, velocity, acceleration)
    return float(np.sqrt(np.mean(squares[round(0.5 / arm.period_s) :])))


@pytest.mark.thorough
def test_it_leads_by_what_the_servo_lags_and_names_its_stop(box: Box) -> None:
    assert sway(UniversalRobotsArm(UR5, ADDRESS), 4.0, leads=False) > 0.01
    arm = UniversalRobotsArm(UR5, ADDRESS)
    arm_error = sway(arm, 4.0)
    assert arm_error < 0.005
    box.stop()
    arm = UniversalRobotsArm(UR5, ADDRESS)
    with pytest.raises(DriveError, match=r"is in a protective stop: .* Then start again"):
        sway(arm, 1.0)
    box.stop()
    time.sleep(0.2)
    assert sway(UniversalRobotsArm(UR5, ADDRESS), 1.0) < 0.02


class LateArm(UniversalRobotsArm):
    """A driver that writes what is commanded, without a lead."""

    def lead(self, moved: Limited) -> None:
        self.write(moved.position, moved.velocity, moved.acceleration)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [UniversalRobotsArm, LateArm])
def test_a_cell_moves_it(kind: type[UniversalRobotsArm], box: Box, tmp_path: Path) -> None:
    """An arm that is merely late is a fault that says how late, and what to set."""
    config = tmp_path / "ur.toml"
    shipped = (ROOT / "service" / "thirdhand" / "arms" / "ur5.toml").read_text()
    # a busy machine makes any arm late
    most_rad = 0.06 if kind is LateArm else 0.3
    urdf = f"urdf = {json.dumps(UR5.arm.urdf)}\nsilent_ms = 1000\nfault_error_rad = {most_rad}"
    config.write_text(f"{LISTENING}{shipped}".replace('urdf = "ur5.urdf"', urdf))
    stop = threading.Event()
    with (
        serving(tmp_path, "--config", str(config), "--joints", "state") as daemon,
        Tracker(daemon.session) as tracker,
        open_session(connect=[daemon.endpoint]) as session,
    ):
        arm = kind(UR5, ADDRESS)
        driver = threading.Thread(
            target=follow, args=(arm, session, "thirdhand"), kwargs={"stop": stop}
        )
        driver.start()
        try:
            status = daemon.until(lambda status: status["mode"] == "follow", 30.0)
            for number in range(12 if kind is LateArm else 4):
                tracker.left = LEFT if number % 2 else NEAR_LEFT
                time.sleep(1.0)
                status = daemon.client.ask("status")
                if status["mode"] == "fault":
                    break
        finally:
            stop.set()
            driver.join(20)
    assert not driver.is_alive()
    if kind is LateArm:
        assert status["reason"] == "arm_error"
        late = re.search(r"the arm is about (\d+) ms late; a joint was", status["because"])
        assert late is not None, status["because"]
        assert 40 < int(late[1]) < 180  # a busy machine is late too
        assert "set lag_s" in status["remedy"]
    else:
        assert status["mode"] != "fault", status["because"]


def test_what_it_lacks_is_named() -> None:
    with pytest.raises(DriveError, match="has 6 joints, 7 are configured"):
        UniversalRobotsArm(Settings(), ADDRESS)
    with pytest.raises(DriveError, match="--robot is missing"):
        UniversalRobotsArm(UR5)
    with pytest.raises(DriveError, match=r"no arm of Universal Robots at 127\.78\.0\.1: "):
        UniversalRobotsArm(UR5, "127.78.0.1")
