"""What the tests of the core share."""

from __future__ import annotations

import pytest

from service.core.skill.skill import Skill
from service.learning.via_points import adapted
from sim.scene import Scene


@pytest.fixture(scope="session")
def taught(skill: Skill) -> Skill:
    """The shipped skill with the via-points of the nominal scene."""
    return adapted(skill, Scene().via_points(), tolerance=0.05)
