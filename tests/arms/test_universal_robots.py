"""An arm of Universal Robots through its maker's library, against a simulated control box: it
follows, a protective stop ends the command in words, and after it the arm follows again.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.driven_arms import UR5, ControlBox, status_after_moves, sway
from thirdhand.arms import DriveError
from thirdhand.arms.universal_robots import UniversalRobotsArm
from thirdhand.core.limiter.stage import Limited
from thirdhand.settings.config import Settings

pytest.importorskip("rtde_control")
ADDRESS = f"127.77.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"  # its ports are fixed


@pytest.fixture
def box() -> Iterator[ControlBox]:
    with contextlib.closing(ControlBox("ur_robot.py", ADDRESS)) as box:
        yield box


class LateArm(UniversalRobotsArm):
    """A driver that writes what is commanded, without a lead."""

    def lead(self, moved: Limited) -> None:
        self.write(moved.position, moved.velocity, moved.acceleration)


@pytest.mark.thorough
def test_it_leads_by_what_the_servo_lags_and_names_its_stop(box: ControlBox) -> None:
    assert sway(LateArm(UR5, ADDRESS), 4.0) > 0.01
    assert sway(UniversalRobotsArm(UR5, ADDRESS), 4.0) < 0.005
    box.stop()
    arm = UniversalRobotsArm(UR5, ADDRESS)
    with pytest.raises(DriveError, match=r"is in a protective stop: .* Then start again"):
        sway(arm, 1.0)
    box.stop()
    time.sleep(0.2)
    assert sway(UniversalRobotsArm(UR5, ADDRESS), 1.0) < 0.02


@pytest.mark.thorough
@pytest.mark.usefixtures("box")
def test_a_cell_moves_it(tmp_path: Path) -> None:
    status = status_after_moves(tmp_path, lambda: UniversalRobotsArm(UR5, ADDRESS))
    assert status["mode"] != "fault", status["because"]


@pytest.mark.thorough
@pytest.mark.usefixtures("box")
def test_a_late_arm_is_a_fault_that_says_what_to_set(tmp_path: Path) -> None:
    """The fault says how late the arm is."""
    status = status_after_moves(
        tmp_path, lambda: LateArm(UR5, ADDRESS), moves=12, fault_error_rad=0.06
    )
    assert status["reason"] == "arm_error"
    late = re.search(r"the arm is about (\d+) ms late; a joint was", status["because"])
    assert late is not None, status["because"]
    assert 40 < int(late[1]) < 180  # a busy machine is late too
    assert "set lag_s" in status["remedy"]


def test_what_it_lacks_is_named() -> None:
    with pytest.raises(DriveError, match="has 6 joints, 7 are configured"):
        UniversalRobotsArm(Settings(), ADDRESS)
    with pytest.raises(DriveError, match="--robot is missing"):
        UniversalRobotsArm(UR5)
    with pytest.raises(DriveError, match=r"no arm of Universal Robots at 127\.78\.0\.1: "):
        UniversalRobotsArm(UR5, "127.78.0.1")
