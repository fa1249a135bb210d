"""The program for the WAM's computer, compiled against a stand-in for libbarrett: it follows,
refuses what would jump, brakes when nothing comes, and a cell moves it.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from support.cell import LEFT, Tracker, serving
from support.driven_arms import NEAR_LEFT, driven
from support.paths import ARMS, ROOT
from thirdhand.arms import DriveError
from thirdhand.arms.barrett_wam import BarrettWAM
from thirdhand.client import open_session
from thirdhand.daemon.launch import free_port
from thirdhand.settings.config import Settings

SOURCE = ARMS / "wam" / "thirdhand_wam.cpp"
BRAKE_RADPS2 = 6.0  # as the program has it
pytestmark = pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler is installed")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wam") / "thirdhand_wam"
    options = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-pthread"]
    stand_in = ["-I", str(ROOT / "tests" / "support")]
    subprocess.run(["g++", *options, *stand_in, str(SOURCE), "-o", str(out)], check=True)
    return out


@pytest.fixture
def address(program: Path) -> Iterator[str]:
    """The address of a running program."""
    port = free_port()
    running = subprocess.Popen(
        [program, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert running.stdout is not None
    assert "waiting" in running.stdout.readline()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        running.communicate("\n", timeout=20)


def swayed(arm: BarrettWAM, lasts_s: float) -> float:
    """The largest error [rad] of joints that begin to sway."""
    start = arm.read()[0]
    worst = 0.0
    still = np.zeros(7)
    for tick in range(round(lasts_s / arm.period_s)):
        arm.wait()
        wanted = start + 0.2 * (1.0 - np.cos(2.0 * tick * arm.period_s))
        velocity = still + 0.4 * np.sin(2.0 * tick * arm.period_s)
        arm.write(wanted, velocity, still)
        worst = max(worst, float(np.abs(arm.read()[0] - wanted).max()))
    return worst


def test_it_follows_and_brakes_when_commands_end(address: str) -> None:
    with BarrettWAM(Settings(), address) as arm:
        assert swayed(arm, 1.0) < 0.02
        speeds = []
        until_s = time.monotonic() + 0.5
        while time.monotonic() < until_s:
            arm.wait()
            speeds.append(float(np.abs(arm.read()[1]).max()))
    assert min(speeds[1:8]) > 0.3
    assert speeds[-1] == 0.0
    assert np.diff(speeds).min() > -2.0 * BRAKE_RADPS2 * 0.05  # never at once


@pytest.mark.parametrize("far_rad", [0.1, np.nan, 5.0])
def test_what_would_jump_is_refused(far_rad: float, address: str) -> None:
    with BarrettWAM(Settings(), address) as arm:
        before = arm.read()[0]
        for _ in range(20):
            arm.wait()
            arm.write(before + far_rad, np.zeros(7), np.zeros(7))
        np.testing.assert_array_equal(arm.read()[0], before)
        assert swayed(arm, 0.2) < 0.02


@pytest.mark.thorough
def test_a_cell_moves_it(address: str, tmp_path: Path) -> None:
    with (
        serving(tmp_path) as daemon,
        Tracker(daemon.session) as tracker,
        open_session(connect=[daemon.endpoint]) as session,
    ):
        arm = BarrettWAM(Settings(), address)
        begin = arm.read()[0]
        with driven(arm, session):
            daemon.until(lambda status: status["mode"] == "follow", 30.0)
            for number in range(20):
                tracker.left = LEFT if number % 2 else NEAR_LEFT
                time.sleep(0.5)
                if np.abs(arm.read()[0] - begin).max() > 0.1:
                    break
        assert np.abs(arm.read()[0] - begin).max() > 0.1
        assert np.abs(arm.read()[1]).max() < 0.01


def test_what_it_lacks_is_named() -> None:
    with pytest.raises(DriveError, match="does thirdhand_wam run on the arm's computer"):
        BarrettWAM(Settings(), f"127.0.0.1:{free_port()}")
    with pytest.raises(DriveError, match=r"HOST or HOST:PORT needed"):
        BarrettWAM(Settings(), "127.0.0.1:door")
