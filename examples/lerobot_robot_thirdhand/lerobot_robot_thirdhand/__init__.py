"""The robot `thirdhand` and the teleoperator `thirdhand_hands` of LeRobot."""

from lerobot_robot_thirdhand.config import ThirdhandHandsConfig, ThirdhandRobotConfig
from lerobot_robot_thirdhand.hands import ThirdhandHands
from lerobot_robot_thirdhand.robot import ThirdhandRobot

__all__ = ["ThirdhandHands", "ThirdhandHandsConfig", "ThirdhandRobot", "ThirdhandRobotConfig"]
