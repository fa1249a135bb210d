"""A Barrett WAM, led by positions at 500 Hz by UDP: `thirdhand_wam` runs on the arm's computer, see
`wam/thirdhand_wam.cpp`.

It was tested against a stand-in for the maker's library, never on hardware.
"""

from __future__ import annotations

import socket
import struct
import time

import numpy as np

from thirdhand.arms import DriveError
from thirdhand.arms.arm import Arm
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

PORT = 5710
ANSWER_S = 1.0  # `thirdhand_wam` answers within this time
MOST_STATES = 100  # that may wait


class BarrettWAM(Arm):
    """The arm whose computer is at an address, HOST or HOST:PORT. Raises DriveError."""

    period_s = 0.002

    def __init__(self, settings: Settings, address: str = "") -> None:
        super().__init__(settings, address or f"127.0.0.1:{PORT}")
        count = len(self.limits.names)
        self._command = struct.Struct(f"<4sI{2 * count}d")
        self._state = struct.Struct(f"<4sId{2 * count}d")
        self._number = 0
        host, _, port = self.address.partition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, int(port or PORT)))
        except (OSError, ValueError, OverflowError) as error:
            self._socket.close()
            raise DriveError(f"--robot {self.address}: {error}; HOST or HOST:PORT needed") from None
        self._joints = np.zeros((2, count))
        self._time_s = 0.0
        until_s = time.monotonic() + ANSWER_S
        while not self._receive(0.1):
            if time.monotonic() > until_s:
                self._socket.close()
                raise DriveError(
                    f"nothing answers at {self.address}: does thirdhand_wam run on the arm's "
                    f"computer, for an arm of {count} joints, and is the arm Shift-activated?"
                )
            self._send(0, np.array(self.limits.lower), np.array(self.limits.upper))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._socket.close()

    def wait(self) -> float:
        before_s = self._time_s
        if not self._receive(0.1):
            raise DriveError(
                f"thirdhand_wam at {self.address} no longer answers: the arm brakes. Look at its "
                "pendant, then start both again"
            )
        return self._time_s - before_s

    def read(self) -> tuple[Vector, Vector]:
        position, velocity = self._joints
        return position, velocity

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        self._number += 1
        self._send(self._number, position, velocity)

    def _send(self, number: int, position: Vector, velocity: Vector) -> None:
        try:
            self._socket.send(self._command.pack(b"THWC", number, *position, *velocity))
        except ConnectionRefusedError:
            return  # nobody listens yet, or no longer: `_receive` tells

    def _receive(self, timeout_s: float) -> bool:
        """True once a state has arrived within this time; the newest one is taken."""
        self._socket.settimeout(timeout_s)
        data = b""
        try:
            data = self._socket.recv(4096)
            self._socket.settimeout(0.0)
            for _ in range(MOST_STATES):
                data = self._socket.recv(4096)
        except OSError:  # no further one
            pass
        if len(data) != self._state.size:
            return False
        _, _, self._time_s, *joints = self._state.unpack(data)
        self._joints = np.array(joints).reshape(2, -1)
        return True
