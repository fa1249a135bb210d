"""No cameras."""

from __future__ import annotations

from typing import Any


class CameraConfig:
    """A camera's configuration."""


def make_cameras_from_configs(camera_configs: dict[str, CameraConfig]) -> dict[str, Any]:
    """No cameras."""
    assert not camera_configs
    return {}
