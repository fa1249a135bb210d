"""The files shipped beside the code: recordings, demonstrations, the soldering skill, and cells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from service.config import WAM, Settings, load
from service.described_arm import UnreadableError

if TYPE_CHECKING:
    from service.learning.skill_file import StoredSkill

SHIPPED_SKILL = "soldering.npz"
ARMS = ("wam", "franka", "ur5")  # that cells are shipped with


def recordings() -> Path:
    """The folder of the shipped recordings and their skill."""
    service = Path(__file__).parent
    folders = (service / "recordings", service.parent / "recordings")
    return next((folder for folder in folders if folder.is_dir()), folders[1])


def skills_folder(settings: Settings) -> Path:
    """The folder of a cell's skills and of the demonstrations that they were learned from."""
    return Path(settings.files.skills).expanduser() if settings.files.skills else recordings()


def shipped_skill() -> StoredSkill:
    """The skill that the service runs by default."""
    from service.learning.skill_file import decoded  # heavy, and most commands do without

    path = recordings() / SHIPPED_SKILL
    return decoded(path.read_bytes(), origin=str(path))


def cell_of(arm: str) -> Settings:
    """The settings of a shipped cell, by its arm, or those in a file.

    Raises SettingsError.
    """
    if arm == "wam":
        return Settings()
    if arm in ARMS:
        return load(WAM.with_name(f"{arm}.toml"))
    if not Path(arm).suffix and not Path(arm).exists():
        raise UnreadableError(f"no arm {arm!r}: {', '.join(ARMS)}, or a cell's settings (FILE.toml) needed")
    return load(Path(arm))
