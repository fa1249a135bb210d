"""An xArm, Lite 6 or 850 of UFACTORY, led by `set_servo_angle_j` of xarm-python-sdk at 250 Hz.

It was tested against a simulated controller, never on hardware. It needs `pip install
'thirdhand[xarm]'`.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from typing import Any, Self

import numpy as np

from thirdhand.arms import DriveError
from thirdhand.arms.arm import Arm
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings

MODE_SERVO = 1  # mode in which positions are not planned
STATE_READY = 0  # state to set
STATE_STOPPED = 4  # state to set, and reported after a stop
SWITCH_S = 0.1  # the maker's examples wait this long after a change of mode
REPLY_TIMEOUT_S = 0.25  # users report replies that take 0.19 s


class UfactoryArm(Arm):
    """The arm whose control box is at an address. Raises DriveError.

    The maker does not publish the delay of the servo: nothing leads until `lag_s` is set.
    """

    period_s = 0.004

    def __init__(self, settings: Settings, address: str = "") -> None:
        super().__init__(settings, address)
        if not address:
            raise DriveError("--robot is missing: the address of the control box")
        with contextlib.redirect_stdout(sys.stderr):  # the library prints
            self._arm = self._connected()
        axes = self._arm.axis
        count = len(self.limits.names)
        if axes != count:
            self._arm.disconnect()
            raise DriveError(
                f"the arm at {address} has {axes} joints, {count} are configured: give --config "
                "with its own URDF"
            )

    def _connected(self) -> Any:
        try:
            from xarm.core.config.x_code import ControllerError
            from xarm.core.utils.log import logger, origin_logger
            from xarm.wrapper import XArmAPI
        except ImportError as error:
            raise DriveError(
                f"xarm-python-sdk cannot be imported ({error}): pip install 'thirdhand[xarm]'"
            ) from None
        self._error_of = ControllerError
        logger.setLevel("CRITICAL")  # without reports it warns at every position
        origin_logger.setLevel("CRITICAL")
        default_timeout_s = socket.getdefaulttimeout()
        try:
            address = socket.gethostbyname(self.address)
            return XArmAPI(address, is_radian=True, enable_report=False)
        except Exception as error:  # the library raises no other class
            raise DriveError(
                f"no arm of UFACTORY at {self.address}: {error}. Is it on, and is --robot its "
                "address?"
            ) from None
        finally:
            socket.setdefaulttimeout(default_timeout_s)  # the library changes it

    def __enter__(self) -> Self:
        arm = self._arm
        if arm.error_code:
            self._raise_stop()
        # also after an error that was cleared: it leaves the motors off, and the arm stopped
        for code in (arm.motion_enable(True), arm.set_mode(MODE_SERVO), arm.set_state(STATE_READY)):
            self._check(code)
        time.sleep(SWITCH_S)
        arm.set_timeout(REPLY_TIMEOUT_S)
        return super().__enter__()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._arm.set_state(STATE_STOPPED)
        self._arm.disconnect()

    def read(self) -> tuple[Vector, Vector]:
        code, states = self._arm.get_joint_states(num=2)
        self._check(code)
        position, velocity = np.array(states)[:, : len(self.limits.names)]  # the box gives seven
        return position, velocity

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        self._check(self._arm.set_servo_angle_j(position.tolist()))

    def _check(self, code: int) -> None:
        """Raise DriveError unless the code of a call is 0."""
        if code:
            self._raise_stop(f"rejects what is sent (code {code}): look at UFACTORY Studio")

    def _raise_stop(self, other: str = "") -> None:
        """Raise DriveError with the cause that the control box gives, or else the other one."""
        code, errors = self._arm.get_err_warn_code()
        if code:
            stop = "no longer answers: look at its cable"
        elif errors[0]:
            title = self._error_of(errors[0]).title["en"].rstrip(".")
            stop = (
                f"is stopped by error {errors[0]} ({title}): remove the cause, and clear the error "
                "in UFACTORY Studio"
            )
        elif self._arm.state == STATE_STOPPED:
            stop = "was stopped in UFACTORY Studio, or by another program"
        else:
            stop = other
        raise DriveError(f"the arm at {self.address} {stop}. Then start again")
