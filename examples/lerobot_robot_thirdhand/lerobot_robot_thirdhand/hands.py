"""The teleoperator `thirdhand_hands`: a person's hands, by the skill that a cell learned."""

from typing import Any

from lerobot.teleoperators import Teleoperator

from lerobot_robot_thirdhand.config import ThirdhandHandsConfig
from lerobot_robot_thirdhand.device import CellDevice


class ThirdhandHands(CellDevice, Teleoperator):  # type: ignore[misc]
    """A cell whose skill predicts the tool for the hands that its tracker sees."""

    config_class = ThirdhandHandsConfig
    name = "thirdhand_hands"
    optional = ("tool/target", "gripper/command")

    def __init__(self, config: ThirdhandHandsConfig) -> None:
        super().__init__(config)
        self.config: ThirdhandHandsConfig = config

    @property
    def feedback_features(self) -> dict[str, type]:
        """None."""
        return {}

    def get_action(self) -> dict[str, float]:
        """The predicted tool; the present one while nothing is predicted, as without hands."""
        return self.action(self.recent("tool/target") or self.newest("tool/setpoint"))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""
