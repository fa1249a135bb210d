"""What several tests share; and that those of the bench are skipped where it is not installed."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import importlib.util
import sys
from typing import Any

import pytest
from tests_paths import RECORDINGS

from service.core.skill import Skill
from service.learning.skill_file import decoded


class _NoBench:
    """Finds no PyBullet, which has no wheels for some Pythons, and skips who asks for it."""

    @staticmethod
    def find_spec(name: str, *_: Any) -> None:
        if name == "pybullet":
            pytest.skip("PyBullet is not installed: no bench", allow_module_level=True)


if importlib.util.find_spec("pybullet") is None:
    sys.meta_path.insert(0, _NoBench)  # type: ignore[arg-type]


@pytest.fixture(scope="session")
def skill() -> Skill:
    """The shipped soldering skill, without places."""
    path = RECORDINGS / "soldering.npz"
    return decoded(path.read_bytes(), origin=str(path))
