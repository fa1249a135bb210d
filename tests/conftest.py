"""What several tests share."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import pytest
from tests_paths import RECORDINGS

from service.core.skill import Skill
from service.learning.skill_file import decoded


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without places."""
    path = RECORDINGS / "soldering.npz"
    return decoded(path.read_bytes(), origin=str(path))
