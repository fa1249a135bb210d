"""Fixture of the tests of the core."""

from __future__ import annotations

import pytest

from thirdhand.core.skill.skill import Skill
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene


@pytest.fixture(scope="session")
def taught(skill: Skill) -> Skill:
    """The shipped skill with the via-points of the nominal scene."""
    return adapted(skill, Scene().via_points(), tolerance=0.05)
