"""An arm of UFACTORY through its maker's library, against a simulated control box: it follows, an
error ends the command in words, and after the error was cleared the arm follows again.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.driven_arms import UR5, ControlBox, status_after_moves, sway
from support.ufactory_robot import LAG_S
from thirdhand.arms import DriveError
from thirdhand.arms.ufactory import UfactoryArm
from thirdhand.settings.config import Settings

pytest.importorskip("xarm")
pytestmark = [
    pytest.mark.filterwarnings("ignore:The 'warn' method:DeprecationWarning:xarm"),
    # the library does not close a socket whose connection was refused
    pytest.mark.filterwarnings("ignore:.*<socket.socket:pytest.PytestUnraisableExceptionWarning"),
]
ADDRESS = f"127.79.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"  # its port is fixed


@pytest.fixture
def box() -> Iterator[ControlBox]:
    with contextlib.closing(ControlBox("ufactory_robot.py", ADDRESS)) as box:
        yield box


def connected(lag_s: float = LAG_S) -> UfactoryArm:
    arm = UfactoryArm(UR5, ADDRESS)
    arm.lag_s = lag_s
    return arm


@pytest.mark.thorough
def test_it_leads_by_what_the_servo_lags(box: ControlBox) -> None:
    assert sway(connected(lag_s=0.0), 4.0) > 0.01
    assert sway(connected(), 4.0) < 0.005


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (1, r"is stopped by error 1 \(The Emergency Stop Button .*\): remove the cause, and clear"),
        (31, r"is stopped by error 31 \(Collision Caused Abnormal Current\)"),
        (0, r"was stopped in UFACTORY Studio"),
    ],
)
def test_it_names_its_stop_and_follows_again(box: ControlBox, error: int, words: str) -> None:
    for _ in range(2 if error else 1):  # an error remains until it is cleared
        with pytest.raises(DriveError, match=rf"the arm at .* {words}.* Then start again"):
            sway(connected(), 1.0, halfway=lambda: box.stop(error))
    box.stop(0)
    assert sway(connected(), 1.5) < 0.02


@pytest.mark.thorough
def test_a_box_that_disappears_is_named(box: ControlBox) -> None:
    with pytest.raises(DriveError, match=r"no longer answers: look at its cable"):
        sway(connected(), 1.0, halfway=box.close)


@pytest.mark.thorough
@pytest.mark.usefixtures("box")
def test_a_cell_moves_it(tmp_path: Path) -> None:
    status = status_after_moves(tmp_path, connected)
    assert status["mode"] != "fault", status["because"]


def test_what_it_lacks_is_named(box: ControlBox) -> None:
    with pytest.raises(DriveError, match="has 6 joints, 7 are configured"):
        UfactoryArm(Settings(), ADDRESS)
    with pytest.raises(DriveError, match="--robot is missing"):
        UfactoryArm(UR5)
    with pytest.raises(DriveError, match=r"no arm of UFACTORY at 127\.78\.0\.1: "):
        UfactoryArm(UR5, "127.78.0.1")
