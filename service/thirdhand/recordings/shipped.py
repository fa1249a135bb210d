"""The files shipped beside the code: recordings, demonstrations, the soldering skill, and cells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from thirdhand.settings.config import WAM, Settings, converted, load
from thirdhand.settings.file_content import SettingsError

if TYPE_CHECKING:
    from thirdhand.skills.skill_file import StoredSkill

SHIPPED_SKILL = "soldering.npz"
ARMS = ("wam", "franka", "ur5")  # arms of the shipped cells


def recordings() -> Path:
    """The folder of the shipped recordings and their skill."""
    package = Path(__file__).parents[1]
    installed = package / "shipped"
    cloned = package.parents[1] / "recordings"
    return installed if installed.is_dir() else cloned


def skill_file(settings: Settings) -> Path:
    """The file of a cell's skill, which is in the folder of its other skills and demonstrations."""
    return Path(settings.files.skill) if settings.files.skill else recordings() / SHIPPED_SKILL


def shipped_skill() -> StoredSkill:
    """The skill that the service runs by default."""
    # its import is slow, and most commands do not need it
    from thirdhand.skills.skill_file import skill_in

    return skill_in(recordings() / SHIPPED_SKILL)


def cell_of(arm: str, *, rate_hz: int | None = None) -> Settings:
    """The settings of the shipped cell of an arm, or those in a file, with the given rate. A file
    with several cells is given as FILE.toml:NAME.

    Raises SettingsError.
    """
    if rate_hz is not None:
        values = msgspec.to_builtins(cell_of(arm))
        return converted(values | {"rate_hz": rate_hz}, origin="command line")
    if arm == "wam":
        return Settings()
    if arm in ARMS:
        return load(WAM.with_name(f"{arm}.toml"))
    path, colon, cell = arm.rpartition(":")
    if colon and path.endswith(".toml"):
        return load(Path(path), cell)
    if not Path(arm).suffix and not Path(arm).exists():
        raise SettingsError(
            f"no arm {arm!r}: {', '.join(ARMS)}, or a cell's settings (FILE.toml) needed"
        )
    return load(Path(arm))
