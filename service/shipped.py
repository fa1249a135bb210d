"""The files shipped beside the code: recordings, demonstrations and the soldering skill."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.learning.skill_file import StoredSkill

SHIPPED_SKILL = "soldering.npz"


def recordings() -> Path:
    """The folder of the shipped recordings and their skill."""
    service = Path(__file__).parent
    folders = (service / "recordings", service.parent / "recordings")
    return next((folder for folder in folders if folder.is_dir()), folders[1])


def shipped_skill() -> StoredSkill:
    """The skill that the service runs by default."""
    from service.learning.skill_file import decoded  # heavy, and most commands do without

    path = recordings() / SHIPPED_SKILL
    return decoded(path.read_bytes(), origin=str(path))
