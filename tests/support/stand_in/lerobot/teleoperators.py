"""Teleoperators."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from lerobot.devices import Config, Device


class TeleoperatorConfig(Config):
    """A teleoperator's configuration."""


class Teleoperator(Device):
    """A teleoperator's methods."""

    @property
    @abstractmethod
    def feedback_features(self) -> dict[str, Any]: ...

    @abstractmethod
    def get_action(self) -> dict[str, Any]: ...

    @abstractmethod
    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
