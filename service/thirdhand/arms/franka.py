"""A Franka Research 3, driven by joint velocities at 1 kHz through libfranka's own bindings.

It uses pylibfranka, because franky-control plans its own motions in its own thread: here the
playback writes each cycle. It needs `pip install 'thirdhand[franka]'`.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from thirdhand.arms import DriveError
from thirdhand.arms.arm import Arm
from thirdhand.arms.playback import SpeedLimits
from thirdhand.core.frame import Vector
from thirdhand.settings.config import JointSettings, Settings

FRANKA_PERIOD_S = 0.001
ADDRESS = "172.16.0.2"  # of a control box as it is delivered
# [rad/s², rad/s³] The robot allows 10 and 5000, but extrapolates over lost packets by itself.
ACCELERATION = 9.0
JERK = 4000.0
CATCH_UP_RATIO = 1.1  # drive speed / commanded speed: the playback makes up for delays
# [rad/s²] assumed deceleration toward a joint's end, below ACCELERATION to follow the falling limit
BRAKE = 5.0
LIMIT_LOOKAHEAD_S = 0.01  # the speed limit is evaluated at position + 0.01 s * velocity
# the speed remains below the robot's limit by this, for the jerk of a braking
LIMIT_MARGIN_RADPS = 0.03
# https://frankarobotics.github.io/docs, "Limits for Franka Research 3": the largest velocity is
# min(MAX_VELOCITY, sqrt(TWICE * distance) - OFFSET) [rad/s], for the distance [rad] to a joint's
# end.
MAX_VELOCITY = np.array((2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26))
LOWER_RAD = np.array((-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196))
UPPER_RAD = np.array((2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196))
OFFSET = np.array((0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35))
TWICE = np.array((12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0))


def speed_limits(position: Vector, velocity: Vector) -> tuple[Vector, Vector]:
    """Lowest and highest velocity (7,) [rad/s], within the robot's limits at this position."""
    ahead_rad = position + LIMIT_LOOKAHEAD_S * velocity
    twice = np.minimum(TWICE, 2.0 * BRAKE)
    up = np.sqrt(twice * np.maximum(UPPER_RAD - ahead_rad, 0.0)) - OFFSET - LIMIT_MARGIN_RADPS
    down = np.sqrt(twice * np.maximum(ahead_rad - LOWER_RAD, 0.0)) - OFFSET - LIMIT_MARGIN_RADPS
    return -np.clip(down, 0.0, MAX_VELOCITY - LIMIT_MARGIN_RADPS), np.clip(
        up, 0.0, MAX_VELOCITY - LIMIT_MARGIN_RADPS
    )


ROBOT_SPEED_LIMITS: SpeedLimits | None = speed_limits


def limits_of(joints: JointSettings) -> JointSettings:
    """The limits of the playback for a Franka whose commands have these limits. Raises
    DriveError.
    """
    least = LOWER_RAD - 0.2
    most = UPPER_RAD + 0.2
    if len(joints.names) != len(LOWER_RAD):
        raise DriveError(
            f"a Franka has 7 joints, {len(joints.names)} are configured: give --config with its "
            "own URDF"
        )
    if (np.array(joints.lower) < least).any() or (np.array(joints.upper) > most).any():
        raise DriveError(
            f"a Franka's joints move from {least.tolist()} to {most.tolist()} rad, the configured "
            "ones farther: give --config with its own URDF"
        )
    return msgspec.structs.replace(
        joints,
        velocity=tuple(
            np.minimum(
                CATCH_UP_RATIO * np.array(joints.velocity), MAX_VELOCITY - LIMIT_MARGIN_RADPS
            ).tolist()
        ),
        acceleration=(ACCELERATION,) * len(LOWER_RAD),
        jerk=(JERK,) * len(LOWER_RAD),
    )


class FrankaArm(Arm):
    """The Franka at an address. Raises DriveError if it does not answer."""

    period_s = FRANKA_PERIOD_S
    takes_velocity = True

    def __init__(self, settings: Settings, address: str = "") -> None:
        address = address or ADDRESS
        super().__init__(settings, address)
        self.limits = limits_of(settings.joints)
        self.speed_limits = ROBOT_SPEED_LIMITS
        try:
            import pylibfranka
        except ImportError as error:
            raise DriveError(
                f"pylibfranka cannot be imported ({error}): pip install 'thirdhand[franka]', under "
                "Python 3.11 or 3.12"
            ) from None
        self._library = pylibfranka
        self._control: Any = None
        try:  # the caller requests real-time scheduling for the loop
            self._robot = pylibfranka.Robot(address, pylibfranka.RealtimeConfig.kIgnore)
            self._state = self._robot.read_once()
        except RuntimeError as error:  # the library's exceptions have no other common base
            raise DriveError(
                f"no Franka at {address}: {error}. Is it on, is FCI active in Desk, and is --robot "
                "its address?"
            ) from None

    def __enter__(self) -> FrankaArm:
        mode = self._library.ControllerMode.JointImpedance
        self._control = self._do(lambda: self._robot.start_joint_velocity_control(mode))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            at_rest = self._library.JointVelocities([0.0] * len(LOWER_RAD))
            at_rest.motion_finished = True
            self._do(lambda: self._control.writeOnce(at_rest))
        self._control = None  # after an exception the robot stops by itself

    def wait(self) -> float:
        self._state, passed = self._do(self._control.readOnce)
        return float(passed.to_sec())

    def read(self) -> tuple[Vector, Vector]:
        return np.array(self._state.q), np.array(self._state.dq)

    def write(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        self._do(lambda: self._control.writeOnce(self._library.JointVelocities(velocity.tolist())))

    def _do(self, what: Any) -> Any:
        try:
            return what()
        except RuntimeError as error:
            raise DriveError(
                f"the Franka at {self.address} stopped: {error}. Look at Desk, free and unlock "
                "it, then restart"
            ) from None
