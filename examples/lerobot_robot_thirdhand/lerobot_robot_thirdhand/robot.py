"""The robot `thirdhand`: actions are wishes, observations are what the cell publishes."""

import logging
import math
from typing import Any

from lerobot.cameras import make_cameras_from_configs
from lerobot.robots import Robot

from lerobot_robot_thirdhand.config import ThirdhandRobotConfig
from lerobot_robot_thirdhand.device import CellDevice
from lerobot_robot_thirdhand.poses import limited, unit


class ThirdhandRobot(CellDevice, Robot):  # type: ignore[misc]
    """A cell with `[skill] source = "tool/wish"`; unless `config.leads`, any cell."""

    config_class = ThirdhandRobotConfig
    name = "thirdhand"

    def __init__(self, config: ThirdhandRobotConfig) -> None:
        super().__init__(config)
        self.config: ThirdhandRobotConfig = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self._joints = "joints/state" if config.measured else "joints/command"
        self.needed = ("tool/setpoint", "status", self._joints)
        self._mode = ""
        self._hands = {f"{side}.{axis}": 0.0 for side in ("left", "right") for axis in "xyz"}

    @property
    def observation_features(self) -> dict[str, Any]:
        """Joints `NAME.pos` [rad; m if prismatic]; tool and gripper as commanded, named as in
        actions; with hands `left.x` to `right.z` [m] in frame base, 0 until seen; pictures (height,
        width, 3) of each camera. No flags: a policy divides by the standard deviation of each
        feature, and that of a flag in good demonstrations is 0.
        """
        features: dict[str, Any] = {f"{joint}.pos": float for joint in self.config.joints}
        features |= self.action_features
        if self.config.hands:
            features |= dict.fromkeys(self._hands, float)
        cameras = self.config.cameras.items()
        return features | {name: (camera.height, camera.width, 3) for name, camera in cameras}

    def prepare(self) -> None:
        """Check the cell's settings, and connect the cameras."""
        status = self.newest("status")
        if self.config.leads and "wish" not in status.sources:
            raise ValueError(
                f"cell {status.cell!r} hears no wishes; there, `[skill] source = "
                '"tool/wish"` needed; or leads=False, to observe it'
            )
        if unknown := set(self.config.joints) - set(status.joints):
            raise ValueError(f"joints {sorted(unknown)} given; the arm has {status.joints}")
        for camera in self.cameras.values():
            camera.connect()

    def disconnect(self) -> None:
        """Close the connection and the cameras; an arm that is led by wishes comes to rest."""
        super().disconnect()
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()

    def get_observation(self) -> dict[str, Any]:
        """The newest values of all features. Warns once the arm no longer follows."""
        joints = self.newest(self._joints)
        status = self.newest("status")
        positions = dict(zip(joints.names, joints.position, strict=True))
        observation: dict[str, Any] = {
            f"{name}.pos": positions[name] for name in self.config.joints
        }
        observation |= self.action(self.newest("tool/setpoint"))
        if status.mode not in (self._mode, "follow"):
            logging.warning("mode %s: %s", status.mode, status.because)
        self._mode = status.mode
        if self.config.hands:
            for side, position_m in status.hands_m.items():
                self._hands |= zip((f"{side}.{axis}" for axis in "xyz"), position_m, strict=True)
            observation |= self._hands
        return observation | {name: camera.read_latest() for name, camera in self.cameras.items()}

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Wish for a pose now. Returns what was sent: at most `max_step_m` and `max_step_rad` from
        the present tool, the gripper from 0 to 1. Raises ValueError unless all is finite.
        """
        cell = self.cell
        config = self.config
        numbers = [float(action[name]) for name in self.action_features]
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"action {numbers} given; finite numbers needed")
        pose = [*numbers[:3], *unit(numbers[3:7])]
        closures = [min(max(closure, 0.0), 1.0) for closure in numbers[7:]]
        if config.leads:
            present = list(self.action(self.newest("tool/setpoint")).values())[:7]
            pose = limited(pose, present, config.max_step_m, config.max_step_rad)
            cell.wish(pose)
            for closure in closures:
                cell.wish_gripper(closure)
        return dict(zip(self.action_features, pose + closures, strict=True))
