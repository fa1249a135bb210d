"""A device of LeRobot that is a cell: its life cycle, and the newest messages of its channels."""

import math
import time
from collections.abc import Sequence
from threading import Thread
from typing import Any

from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import thirdhand
from lerobot_robot_thirdhand.config import CellConfig
from lerobot_robot_thirdhand.poses import POSE, unit

CONNECT_S = 15.0  # a cell answers and publishes within this time
SILENT_S = 1.0  # a channel without a message for this time is silent
GRIPPER = "gripper"
# LeRobot's mean of a constant is exact for such numbers only, and a policy divides by its deviation
ROUND_TO = 2.0**-12


class CellDevice:
    """Opens and closes the connection. Calibration is the cell's."""

    config: CellConfig
    needed: tuple[str, ...] = ("tool/setpoint",)  # channels that must not be silent
    optional: tuple[str, ...] = ("gripper/command",)
    is_calibrated = True
    _cell: thirdhand.Connection | None = None
    _orientation: Sequence[float] = ()  # newest quaternion: the next one is on its side

    @property
    def action_features(self) -> dict[str, type]:
        """`tool.x` to `tool.z` [m] and the quaternion `tool.qx` to `tool.qw`, in frame base; with a
        gripper `gripper`, its closure from 0 (open) to 1.
        """
        return dict.fromkeys([*POSE, *[GRIPPER] * self.config.gripper], float)

    @property
    def is_connected(self) -> bool:
        """True from `connect` to `disconnect`."""
        return self._cell is not None

    @property
    def cell(self) -> thirdhand.Connection:
        """The connection. Raises DeviceNotConnectedError."""
        if self._cell is None:
            raise DeviceNotConnectedError(f"{self} is not connected; connect() needed")
        return self._cell

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Connect, and wait until the cell publishes. Raises DeviceAlreadyConnectedError,
        DeviceNotConnectedError, thirdhand.UnreachableError, and ValueError for another cell.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        endpoint = self.config.endpoint
        self._cell = cell = thirdhand.connect(endpoint, cell=self.config.cell, timeout_s=CONNECT_S)
        try:
            cell.wait_until_ready(timeout_s=CONNECT_S)
            self._newest: dict[str, tuple[float, Any]] = {}
            for channel in self.needed + self.optional:
                watch = cell.watch(channel)
                Thread(target=self._keep, args=(channel, watch), daemon=True).start()
            end_s = time.monotonic() + CONNECT_S
            while time.monotonic() < end_s and not all(map(self.recent, self.needed)):
                time.sleep(0.01)
            for channel in self.needed:
                self.newest(channel)
            self.prepare()
        except BaseException:
            self.disconnect()
            raise

    def prepare(self) -> None:
        """Check a new connection."""

    def disconnect(self) -> None:
        """Close the connection; an arm that is led by wishes comes to rest."""
        self.cell.close()
        self._cell = None

    def recent(self, channel: str) -> Any:
        """The newest message of a channel; None if it is silent. Raises DeviceNotConnectedError."""
        _ = self.cell
        arrival_s, message = self._newest.get(channel, (-math.inf, None))
        return message if time.monotonic() - arrival_s <= SILENT_S else None

    def _keep(self, channel: str, watch: thirdhand.Watch) -> None:
        """Keep the newest message, until the connection closes."""
        for message in watch:
            self._newest[channel] = time.monotonic(), message

    def newest(self, channel: str) -> Any:
        """The newest message of a channel. Raises DeviceNotConnectedError if it is silent."""
        if (message := self.recent(channel)) is None:
            raise DeviceNotConnectedError(f"{channel} is silent: do the daemon and the arm run?")
        return message

    def action(self, tool: Any) -> dict[str, float]:
        """The action that has this pose of the tool, and the gripper as commanded."""
        self._orientation = unit(tool.orientation, self._orientation)
        pose = [*tool.position, *(round(q / ROUND_TO) * ROUND_TO for q in self._orientation)]
        action = dict(zip(POSE, pose, strict=True))
        if self.config.gripper:
            command = self.recent("gripper/command")
            action[GRIPPER] = command.position[0] if command else 0.0
        return action
