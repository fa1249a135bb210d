"""Robots."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from lerobot.devices import Config, Device


class RobotConfig(Config):
    """A robot's configuration."""


class Robot(Device):
    """A robot's methods."""

    @property
    @abstractmethod
    def observation_features(self) -> dict[str, Any]: ...

    @abstractmethod
    def get_observation(self) -> dict[str, Any]: ...

    @abstractmethod
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]: ...
