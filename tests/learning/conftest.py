"""Fixtures of the tests of learning: demonstrations, and skills learned from them once."""

from __future__ import annotations

import pytest

from support.paths import RECORDINGS
from support.taught_scene import VIA_POINTS, demonstrated, quickly
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import decoded
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn


@pytest.fixture(scope="session")
def skill() -> Skill:
    """A skill learned the paper's way."""
    path = RECORDINGS / "experiments" / "as-paper.npz"
    return decoded(path.read_bytes(), origin=str(path))


@pytest.fixture(scope="session")
def taught() -> list[Demonstration]:
    """Three demonstrations to learn from and three to hold out."""
    return demonstrated(6)


@pytest.fixture(scope="session")
def learned(taught: list[Demonstration]) -> Skill:
    """A skill of three demonstrations, as a function of the hands' positions."""
    return learn(taught[:3], name="soldering", ell=8.0)


@pytest.fixture(scope="session")
def coarse(taught: list[Demonstration]) -> Skill:
    """A skill of two demonstrations, with few points."""
    return quickly(taught[:2])


@pytest.fixture(scope="session")
def aimed(learned: Skill) -> Skill:
    """The skill of three demonstrations, adapted to the scene's via-points."""
    return adapted(learned, VIA_POINTS, tolerance=0.05)
