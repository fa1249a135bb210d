"""One's own arm on thirdhand's wire: a driver to begin from. Put the arm's library where `FakeArm`
keeps numbers; what else a driver owes is in docs/hardware.md. Give it the daemon's settings:

    python examples/own_arm.py --config cell.toml
"""

import argparse
import signal
import threading
import time
from pathlib import Path

import numpy as np

from thirdhand.arms.drive import Measured, follow
from thirdhand.arms.playback import SpeedLimits
from thirdhand.client import client_settings
from thirdhand.settings.config import Settings, load


class FakeArm:
    """An arm that does what it is told at once."""

    period_s: float = 0.002  # at which the drive takes what is written
    takes_velocity: bool = False  # it is led by positions, and keeps to them by itself
    # of its servo, which `thirdhand doctor` measures: what is written leads by it
    lag_s: float = 0.0
    # less than in `limits` at some positions, where the drive has such
    speed_limits: SpeedLimits | None = None

    def __init__(self, settings: Settings) -> None:
        # names, and what the drive can do: no less than what is commanded
        self.limits = settings.joints
        self.position = np.array(settings.arm.posture)
        self.velocity = np.zeros(len(settings.joints.names))

    def __enter__(self) -> "FakeArm":  # switch the drives on: the arm stands
        self._read_s = time.monotonic()
        return self

    def __exit__(
        self, *_: object
    ) -> None: ...  # the arm is at rest, or something failed: switch them off

    def stands_at(self) -> np.ndarray:  # before they are on [rad]
        return self.position

    def read(self) -> Measured:  # once the next period begins, as measured [rad, rad/s]
        before = self._read_s
        due = self._read_s + self.period_s
        time.sleep(max(due - time.monotonic(), 0.0))
        self._read_s = max(due, time.monotonic() - 0.05)
        return Measured(self.position, self.velocity, self._read_s - before)

    def write(
        self, position: np.ndarray, velocity: np.ndarray
    ) -> None:  # where to be when the next one does
        self.move(
            np.clip(position + self.lag_s * velocity, self.limits.lower, self.limits.upper),
            velocity,
        )

    def move(
        self, position: np.ndarray, velocity: np.ndarray
    ) -> None:  # a servo is late; this one is not
        self.position = position
        self.velocity = velocity


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--config",
        type=Path,
        help="settings of the cell: joints, and where they begin, [arm] posture",
    )
    parser.add_argument(
        "--connect", action="append", help="of the daemon, of `thirdhand record` or of a router"
    )
    args = parser.parse_args()
    stop = threading.Event()
    settings = load(args.config) if args.config else Settings()
    where = args.connect or (settings.network.reached_at if args.config else None)
    client = client_settings(connect=where, cell=settings.cell if args.config else None)
    with client.session(timeout_s=None) as session:
        signal.signal(signal.SIGINT, lambda *_: stop.set())  # from now on Ctrl-C brakes first
        follow(FakeArm(settings), session, client.cell, stop=stop)
