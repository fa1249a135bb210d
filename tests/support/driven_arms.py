"""Arms that a thread of the test drives, simulated control boxes, and cells that move such arms."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from support.cell import LEFT, LISTENING, Tracker, serving
from support.paths import ARMS, ROOT
from thirdhand.arms.arm import Arm
from thirdhand.arms.drive import follow
from thirdhand.client import open_session
from thirdhand.core.limiter.stage import Limited
from thirdhand.recordings.shipped import cell_of

NEAR_LEFT = (0.85, -0.30, 0.10)
UR5 = cell_of("ur5")


@contextlib.contextmanager
def driven(arm: Arm, session: zenoh.Session) -> Iterator[None]:
    """A context in which an arm follows the commands of a cell."""
    stop = threading.Event()
    driver = threading.Thread(
        target=follow, args=(arm, session, "thirdhand"), kwargs={"stop": stop}
    )
    driver.start()
    try:
        yield
    finally:
        stop.set()
        driver.join(20)
    assert not driver.is_alive()


class ControlBox:
    """A running program of `tests/support` in the place of a control box, at an address."""

    def __init__(self, program: str, address: str) -> None:
        posture = map(str, UR5.arm.posture)
        self._process = subprocess.Popen(
            [sys.executable, str(ROOT / "tests" / "support" / program), address, *posture],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._await("ready")

    def stop(self, error: int = 0) -> None:
        """Stop the arm, or end its stop."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{error}\n")
        self._process.stdin.flush()
        self._await("stopped")

    def close(self) -> None:
        self._process.communicate(timeout=20)

    def _await(self, line: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == f"{line}\n"


def sway(arm: Arm, lasts_s: float, *, halfway: Callable[[], None] = lambda: None) -> float:
    """The error [rad], root mean square, of joints that sway by 0.4 rad, as measured after the
    first half second.
    """
    start = np.array(UR5.arm.posture)
    rate = 2.0 * np.pi * 0.3
    squares = []
    with arm:
        count = round(lasts_s / arm.period_s)
        for tick in range(count):
            if tick == count // 2:
                halfway()
            arm.wait()
            at_s = tick * arm.period_s
            target = start + 0.2 * (1.0 - np.cos(rate * at_s))
            squares.append((arm.measured()[0] - target) ** 2)
            velocity = np.full(6, 0.2 * rate * np.sin(rate * at_s))
            acceleration = np.full(6, 0.2 * rate**2 * np.cos(rate * at_s))
            arm.lead(Limited(target, velocity, acceleration, limited=False))
    return float(np.sqrt(np.mean(squares[round(0.5 / arm.period_s) :])))


def status_after_moves(
    folder: Path, connected: Callable[[], Arm], *, moves: int = 4, fault_error_rad: float = 0.3
) -> dict[str, Any]:
    """The status of a UR5's cell that an arm follows, once the left hand has moved this number of
    times, or at a fault.
    """
    config = folder / "arm.toml"
    shipped = (ARMS / "ur5.toml").read_text()
    # a busy machine makes any arm late
    urdf = f"urdf = {json.dumps(UR5.arm.urdf)}\nsilent_ms = 1000\n"
    urdf += f"fault_error_rad = {fault_error_rad}"
    config.write_text(f"{LISTENING}{shipped}".replace('urdf = "ur5.urdf"', urdf))
    with (
        serving(folder, "--config", str(config), "--joints", "state") as daemon,
        Tracker(daemon.session) as tracker,
        open_session(connect=[daemon.endpoint]) as session,
        driven(connected(), session),
    ):
        daemon.until(lambda status: status["mode"] == "follow", 30.0)
        for number in range(moves):
            tracker.left = LEFT if number % 2 else NEAR_LEFT
            time.sleep(1.0)
            status: dict[str, Any] = daemon.client.ask("status")
            if status["mode"] == "fault":
                break
    return status
