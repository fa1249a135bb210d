"""A Franka Research 3 by libfranka's own bindings: joint velocities at 1 kHz.

pylibfranka rather than franky-control, because that plans motions of its own in a thread of its
own: here each cycle is written by the playback. It needs `pip install 'thirdhand[franka]'`.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from service.arms.drive import DriveError, Measured
from service.arms.playback import SpeedLimits
from service.core.frame import Vector
from service.settings.config import JointSettings, Settings

PERIOD_S = 0.001
ACCELERATION, JERK = 9.0, 4000.0  # [rad/s², rad/s³] of 10 and 5000: a lost packet is made up for by the robot
CATCH_UP = 1.1  # of the commands' speed
BRAKE = 5.0  # [rad/s²] toward a joint's end, at most: so much of the acceleration follows the limit as it falls
AHEAD_S, BELOW_RADPS = 0.01, 0.03  # by which that is foreseen, and kept below, for the jerk it takes
# As published, https://frankarobotics.github.io/docs, "Limits for Franka Research 3": greatest
# velocities min(v, sqrt(twice * distance) - offset) [rad/s], with distances to joints' ends.
MAX_VELOCITY = np.array((2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26))
LOWEST = np.array((-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196))
HIGHEST = np.array((2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196))
OFFSET = np.array((0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35))
TWICE = np.array((12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0))


def speed_limits(position: Vector, velocity: Vector) -> tuple[Vector, Vector]:
    """Least and greatest velocities (7,) [rad/s], below those that the robot allows there."""
    there, twice = position + AHEAD_S * velocity, np.minimum(TWICE, 2.0 * BRAKE)
    up = np.sqrt(twice * np.maximum(HIGHEST - there, 0.0)) - OFFSET - BELOW_RADPS
    down = np.sqrt(twice * np.maximum(there - LOWEST, 0.0)) - OFFSET - BELOW_RADPS
    return -np.clip(down, 0.0, MAX_VELOCITY - BELOW_RADPS), np.clip(up, 0.0, MAX_VELOCITY - BELOW_RADPS)


ROBOT_SPEED_LIMITS: SpeedLimits | None = speed_limits


def limits_of(joints: JointSettings) -> JointSettings:
    """What is written to a Franka whose commands keep these limits. Raises DriveError."""
    least, most = LOWEST - 0.2, HIGHEST + 0.2
    if len(joints.names) != len(LOWEST):
        raise DriveError(f"a Franka has 7 joints, {len(joints.names)} are configured: give --config with its own URDF")
    if (np.array(joints.lower) < least).any() or (np.array(joints.upper) > most).any():
        raise DriveError(
            f"a Franka's joints go from {least.tolist()} to {most.tolist()} rad, the configured ones farther: "
            "give --config with its own URDF"
        )
    return msgspec.structs.replace(
        joints,
        velocity=tuple(np.minimum(CATCH_UP * np.array(joints.velocity), MAX_VELOCITY - BELOW_RADPS).tolist()),
        acceleration=(ACCELERATION,) * len(LOWEST),
        jerk=(JERK,) * len(LOWEST),
    )


class FrankaArm:
    """The arm at an address, as `Drive` says. Raises DriveError where there is none."""

    period_s: float = PERIOD_S
    takes_velocity: bool = True

    def __init__(self, settings: Settings, address: str) -> None:
        self.limits, self.speed_limits = limits_of(settings.joints), ROBOT_SPEED_LIMITS
        try:
            import pylibfranka
        except ImportError as error:
            raise DriveError(
                f"pylibfranka cannot be imported ({error}): pip install 'thirdhand[franka]', under Python 3.11 or 3.12"
            ) from None
        self._library, self._address = pylibfranka, address
        self._control: Any = None
        try:  # real-time scheduling is asked for by whoever runs the loop
            self._robot = pylibfranka.Robot(address, pylibfranka.RealtimeConfig.kIgnore)
            self._state = self._robot.read_once()
        except RuntimeError as error:  # its exceptions have no other base in common
            raise DriveError(
                f"no Franka at {address}: {error}. Is it on, its FCI activated in Desk, and --robot its address?"
            ) from None

    def __enter__(self) -> FrankaArm:
        mode = self._library.ControllerMode.JointImpedance
        self._control = self._do(lambda: self._robot.start_joint_velocity_control(mode))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            at_rest = self._library.JointVelocities([0.0] * len(LOWEST))
            at_rest.motion_finished = True
            self._do(lambda: self._control.writeOnce(at_rest))
        self._control = None  # else the robot stops by itself

    def stands_at(self) -> Vector:
        """As `Drive` says, as all here."""
        return np.array(self._state.q)

    def read(self) -> Measured:
        state, passed = self._do(self._control.readOnce)
        return Measured(np.array(state.q), np.array(state.dq), passed.to_sec())

    def write(self, position: Vector, velocity: Vector) -> None:
        self._do(lambda: self._control.writeOnce(self._library.JointVelocities(velocity.tolist())))

    def _do(self, what: Any) -> Any:
        try:
            return what()
        except RuntimeError as error:
            raise DriveError(
                f"the Franka at {self._address} stopped: {error}. See Desk; free and unlock it, then start this again"
            ) from None
