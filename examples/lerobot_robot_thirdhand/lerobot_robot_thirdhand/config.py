"""Configurations, as on LeRobot's command lines."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from thirdhand.settings.config import Settings


@dataclass(kw_only=True)
class CellConfig:
    """A cell; None: by the environment or the client's file, as in `thirdhand.connect`."""

    endpoint: str | None = None  # such as "tcp/192.168.1.10:7447"
    cell: str | None = None
    gripper: bool = False  # True: actions have the closure of a gripper


@RobotConfig.register_subclass("thirdhand")
@dataclass(kw_only=True)
class ThirdhandRobotConfig(CellConfig, RobotConfig):  # type: ignore[misc]
    """The robot `thirdhand`."""

    leads: bool = True  # False: the cell's own skill leads; actions are only recorded
    # largest step from the present tool to a wish
    max_step_m: float = 0.10  # [m]
    max_step_rad: float = 0.5  # [rad]
    # names in the order of the observations
    joints: list[str] = field(default_factory=lambda: list(Settings().joints.names))
    measured: bool = True  # False: joints as commanded, for `[arm] source = "assumed"`
    hands: bool = False  # True: observations have the hands
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


@TeleoperatorConfig.register_subclass("thirdhand_hands")
@dataclass(kw_only=True)
class ThirdhandHandsConfig(CellConfig, TeleoperatorConfig):  # type: ignore[misc]
    """The teleoperator `thirdhand_hands`."""
