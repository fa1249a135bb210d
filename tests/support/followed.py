"""Sessions of a cell and a skill, whose frames hold every limit of the joints."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from service.core.controller import Controller
from service.core.frame import Tick
from service.core.skill.skill import Skill
from service.settings.config import Settings, robot_description
from support.in_process import ASSUMED, assert_limits_hold, frames


def followed(skill: Skill, ticks: Iterable[Tick], cell: Settings = ASSUMED) -> np.ndarray:
    """The frames (T,) of a controller that steps through ticks, all within the joints' limits."""
    found = frames(Controller(cell, skill, urdf=robot_description(cell)), ticks)
    assert_limits_hold(found, cell)
    return found
