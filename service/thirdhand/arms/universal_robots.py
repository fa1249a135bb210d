"""An arm of Universal Robots' e-Series, led by `servoJ` through ur_rtde at 500 Hz.

It was tested against a simulated controller, never on hardware. It needs `pip install
'thirdhand[ur]'`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self, TypeVar

import numpy as np

from thirdhand.arms import DriveError
from thirdhand.arms.arm import Arm
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

COUNT = 6
Found = TypeVar("Found")


class UniversalRobotsArm(Arm):
    """The arm whose control box is at an address, in remote control. Raises DriveError.

    `servoJ` accelerates by `gain` times the error, and is `lookahead_s` late. So that what is
    written leads by both, `lag_s` is set with it.
    """

    period_s = 0.002
    lookahead_s = 0.1  # 0.03 to 0.2
    lag_s = 0.1
    gain = 300.0  # 100 to 2000

    def __init__(self, settings: Settings, address: str = "") -> None:
        super().__init__(settings, address)
        if len(self.limits.names) != COUNT:
            raise DriveError(
                f"an arm of Universal Robots has {COUNT} joints, {len(self.limits.names)} are "
                "configured: give --config with its own URDF"
            )
        try:
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise DriveError(
                f"ur_rtde cannot be imported ({error}): pip install 'thirdhand[ur]'"
            ) from None
        self._library = rtde_control
        self._control: Any = None
        if not address:
            raise DriveError("--robot is missing: the address of the control box")
        self._receive = self._do(
            lambda: rtde_receive.RTDEReceiveInterface(address, 1.0 / self.period_s)
        )

    def __enter__(self) -> Self:
        # uploads its script, so that this also works after a protective stop
        self._control = self._do(
            lambda: self._library.RTDEControlInterface(self.address, 1.0 / self.period_s)
        )
        return super().__enter__()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        control = self._control
        try:
            if kind is None:
                self._do(lambda: (control.servoStop(), control.stopScript()))
        finally:
            control.disconnect()
            self._receive.disconnect()

    def read(self) -> tuple[Vector, Vector]:
        self._check()
        return np.array(self._receive.getActualQ()), np.array(self._receive.getActualQd())

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        times = self.period_s, self.lookahead_s, self.gain
        if not self._do(lambda: self._control.servoJ(position.tolist(), 0.0, 0.0, *times)):
            self._check()
            raise DriveError(
                f"the control box at {self.address} takes no commands: its program was stopped. "
                "Look at the pendant, then start again"
            )

    def _check(self) -> None:
        """Raise DriveError if the arm has stopped by itself, or nothing arrives from it."""
        receive = self._receive
        stop = ""
        if not receive.isConnected():
            stop = "no longer answers: look at its cable"
        elif receive.isEmergencyStopped():
            stop = "is in an emergency stop: release it at the pendant"
        elif receive.isProtectiveStopped():
            stop = (
                "is in a protective stop: find what it touched, or lower [tool] max_speed and "
                "[joints] velocity, and unlock it at the pendant"
            )
        if stop:
            raise DriveError(f"the arm at {self.address} {stop}. Then start again")

    def _do(self, what: Callable[[], Found]) -> Found:
        try:
            return what()
        except RuntimeError as error:  # the library's exceptions have no other common base
            raise DriveError(
                f"no arm of Universal Robots at {self.address}: {error}. Is it on, and in remote "
                "control, and is --robot its address?"
            ) from None
