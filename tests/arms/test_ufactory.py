"""An arm of UFACTORY through its maker's library, against a simulated control box: it follows, an
error ends the command in words, and after the error was cleared the arm follows again.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from support.cell import LEFT, LISTENING, Tracker, serving
from support.paths import ROOT
from support.ufactory_robot import LAG_S
from thirdhand.arms import DriveError
from thirdhand.arms.drive import follow
from thirdhand.arms.ufactory import UfactoryArm
from thirdhand.client import open_session
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings

pytest.importorskip("xarm")
pytestmark = [
    pytest.mark.filterwarnings("ignore:The 'warn' method:DeprecationWarning:xarm"),
    # the library does not close a socket whose connection was refused
    pytest.mark.filterwarnings("ignore:.*<socket.socket:pytest.PytestUnraisableExceptionWarning"),
]
ADDRESS = f"127.79.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"  # its port is fixed
SIX_JOINTS = cell_of("ur5")  # the simulated arm has no shape
NEAR_LEFT = (0.85, -0.30, 0.10)


class Box:
    """A running control box."""

    def __init__(self) -> None:
        script = ROOT / "tests" / "support" / "ufactory_robot.py"
        posture = map(str, SIX_JOINTS.arm.posture)
        self._process = subprocess.Popen(
            [sys.executable, str(script), ADDRESS, *posture],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def stop(self, error: int) -> None:
        """Stop the arm by an error; 0 clears it."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{error}\n")
        self._process.stdin.flush()
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "stopped\n"

    def close(self) -> None:
        self._process.communicate(timeout=20)


@pytest.fixture
def box() -> Iterator[Box]:
    with contextlib.closing(Box()) as box:
        yield box


def sway(
    lasts_s: float, *, lag_s: float = LAG_S, halfway: Callable[[], None] | None = None
) -> float:
    """The error [rad], root mean square, of joints that sway by 0.4 rad, as measured after the
    first half second.
    """
    start = np.array(SIX_JOINTS.arm.posture)
    rate = 2.0 * np.pi * 0.3
    squares = []
    with UfactoryArm(SIX_JOINTS, ADDRESS) as arm:
        count = round(lasts_s / arm.period_s)
        for tick in range(count):
            if halfway and tick == count // 2:
                halfway()
            arm.wait()
            at_s = tick * arm.period_s
            target = start + 0.2 * (1.0 - np.cos(rate * at_s))
            squares.append((arm.measured()[0] - target) ** 2)
            velocity = np.full(6, 0.2 * rate * np.sin(rate * at_s))
            arm.write(target + lag_s * velocity, velocity, np.zeros(6))
    return float(np.sqrt(np.mean(squares[round(0.5 / arm.period_s) :])))


@pytest.mark.thorough
def test_it_leads_by_what_the_servo_lags(box: Box) -> None:
    assert sway(4.0, lag_s=0.0) > 0.01
    assert sway(4.0) < 0.005


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (1, r"is stopped by error 1 \(The Emergency Stop Button .*\): remove the cause, and clear"),
        (31, r"is stopped by error 31 \(Collision Caused Abnormal Current\)"),
        (0, r"was stopped in UFACTORY Studio"),
    ],
)
def test_it_names_its_stop_and_follows_again(box: Box, error: int, words: str) -> None:
    for _ in range(2 if error else 1):  # an error remains until it is cleared
        with pytest.raises(DriveError, match=rf"the arm at .* {words}.* Then start again"):
            sway(1.0, halfway=lambda: box.stop(error))
    box.stop(0)
    assert sway(1.5) < 0.02


@pytest.mark.thorough
def test_a_box_that_disappears_is_named(box: Box) -> None:
    with pytest.raises(DriveError, match=r"no longer answers: look at its cable"):
        sway(1.0, halfway=box.close)


@pytest.mark.thorough
def test_a_cell_moves_it(box: Box, tmp_path: Path) -> None:
    config = tmp_path / "ufactory.toml"
    shipped = (ROOT / "service" / "thirdhand" / "arms" / "ur5.toml").read_text()
    # a busy machine makes any arm late
    urdf = f"urdf = {json.dumps(SIX_JOINTS.arm.urdf)}\nsilent_ms = 1000\nfault_error_rad = 0.3"
    config.write_text(f"{LISTENING}{shipped}".replace('urdf = "ur5.urdf"', urdf))
    stop = threading.Event()
    with (
        serving(tmp_path, "--config", str(config), "--joints", "state") as daemon,
        Tracker(daemon.session) as tracker,
        open_session(connect=[daemon.endpoint]) as session,
    ):
        arm = UfactoryArm(SIX_JOINTS, ADDRESS)
        arm.lag_s = LAG_S
        driver = threading.Thread(
            target=follow, args=(arm, session, "thirdhand"), kwargs={"stop": stop}
        )
        driver.start()
        try:
            daemon.until(lambda status: status["mode"] == "follow", 30.0)
            for number in range(4):
                tracker.left = LEFT if number % 2 else NEAR_LEFT
                time.sleep(1.0)
                status = daemon.client.ask("status")
        finally:
            stop.set()
            driver.join(20)
    assert not driver.is_alive()
    assert status["mode"] != "fault", status["because"]


def test_what_it_lacks_is_named(box: Box) -> None:
    with pytest.raises(DriveError, match="has 6 joints, 7 are configured"):
        UfactoryArm(Settings(), ADDRESS)
    with pytest.raises(DriveError, match="--robot is missing"):
        UfactoryArm(SIX_JOINTS)
    with pytest.raises(DriveError, match=r"no arm of UFACTORY at 127\.78\.0\.1: "):
        UfactoryArm(SIX_JOINTS, "127.78.0.1")
