"""What several tests share."""

from __future__ import annotations

import os

for _library in ("OPENBLAS", "OMP", "MKL"):  # before NumPy loads, as the commands do
    os.environ[f"{_library}_NUM_THREADS"] = "1"


import pytest
from tests_paths import RECORDINGS

from service.skill import Skill


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without places."""
    path = RECORDINGS / "soldering.npz"
    return Skill.from_bytes(path.read_bytes(), origin=str(path))
