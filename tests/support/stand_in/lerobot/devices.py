"""Devices and their configurations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(kw_only=True)
class Config:
    """The fields of all configurations."""

    id: str | None = None

    @classmethod
    def register_subclass(cls, name: str) -> Callable[[type], type]:
        """A decorator that leaves the class as it is; LeRobot lists it under the name."""
        return lambda choice: choice


class Device(ABC):
    """The methods that both kinds of devices must have."""

    name: str

    def __init__(self, config: Any) -> None:
        self.id = config.id

    def __str__(self) -> str:
        return f"{self.id} {type(self).__name__}"

    @property
    @abstractmethod
    def action_features(self) -> dict[str, Any]: ...

    @property
    @abstractmethod
    def is_connected(self) -> bool: ...

    @property
    @abstractmethod
    def is_calibrated(self) -> bool: ...

    @abstractmethod
    def connect(self, calibrate: bool = True) -> None: ...

    @abstractmethod
    def calibrate(self) -> None: ...

    @abstractmethod
    def configure(self) -> None: ...

    @abstractmethod
    def disconnect(self) -> None: ...
