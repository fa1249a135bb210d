"""Cells with other settings, and sessions of them that keep every limit of the joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from support.in_process import ASSUMED, assert_limits_hold, frames
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings, robot_description


def changed(cell: Settings, **parts: Any) -> Settings:
    """The cell with other settings; a mapping replaces only the fields that it names."""
    for name, part in parts.items():
        changed_part = replace(getattr(cell, name), **part) if isinstance(part, Mapping) else part
        cell = replace(cell, **{name: changed_part})
    return cell


def followed(skill: Skill, ticks: Iterable[Tick], cell: Settings = ASSUMED) -> np.ndarray:
    """The frames (T,) of a controller that steps through ticks; asserts the joints' limits."""
    records = frames(Controller(cell, skill, urdf=robot_description(cell)), ticks)
    assert_limits_hold(records, cell)
    return records
