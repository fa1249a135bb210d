"""Via-points that survive a restart: a file for each skill that was taught to each arm."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from service.config import Settings, robot_description
from service.contract.requests import Add, ViaPoint, decode_request
from service.core.skill.skill import Skill
from service.daemon.saved_state import restored
from service.daemon.single_instance import state_folder
from service.learning.skill_file import SkillError
from service.urdf import Urdf

T = TypeVar("T")


def _checksum(saved: dict[str, Any]) -> str:
    """The checksum of all that is saved, independent of its layout."""
    return hashlib.blake2b(json.dumps(saved, sort_keys=True).encode(), digest_size=16).hexdigest()


def _identity(settings: Settings) -> str:
    """What tells an arm from others: its joints, and where they sit to a centimetre, so that it
    stays the same when it is calibrated.
    """
    chain = Urdf(robot_description(settings)).chain(settings.arm.plate)
    return "; ".join(" ".join([one.name, *(f"{round(v, 2) + 0.0:.2f}" for v in one.translation)]) for one in chain)


class SavedViaPoints:
    """The via-points taught to each skill of an arm, on disk; written atomically."""

    def __init__(self, settings: Settings) -> None:
        self._folder = state_folder(settings)
        self._arm, self._shipped_arm = _identity(settings), _identity(Settings())

    def path(self, skill: Skill) -> Path:
        """The file for this skill and arm, named by the hash of what the skill was learned from."""
        arm = "" if self._arm == self._shipped_arm else self._arm  # as before there were others
        digest = hashlib.blake2b((skill.learned_from + arm).encode(), digest_size=6).hexdigest()
        return self._folder / f"places-{digest}.json"

    def read(self, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """Via-points and tolerance taught to this skill of this arm, or None."""
        return self.restored(skill, lambda points, tolerance: (points, tolerance), None)

    def restored(self, skill: Skill, make: Callable[[tuple[ViaPoint, ...], float], T], otherwise: T) -> T:
        """The value that `make` makes of the via-points and the tolerance taught to this skill of
        this arm; `otherwise` where none were, or where that fails.
        """

        def made(content: bytes) -> T:
            found = self._decoded(content, skill)
            return otherwise if found is None else make(*found)

        return restored(self.path(skill), made, otherwise, what="the taught via-points")

    def _decoded(self, content: bytes, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """None where they belong to another skill or arm."""
        saved = json.loads(content)
        if saved.pop("checksum") != _checksum(saved):
            raise ValueError("the checksum is wrong: the file was changed since; teach them again")
        request = saved["request"] and decode_request(json.dumps({"op": "add", **saved["request"]}).encode(), Add)
        if (saved["learned_from"], saved.get("arm", self._shipped_arm)) != (skill.learned_from, self._arm):
            return None
        return (request.points, request.tolerance) if request else ((), skill.tolerance)

    def draft(self, skill: Skill) -> Path:
        """A temporary file, flushed to disk, with this skill's via-points, to be renamed over the
        old one. Raises SkillError.
        """
        request = None
        if skill.via_points:
            request = {"points": msgspec.to_builtins(skill.via_points), "tolerance": skill.tolerance}
        saved = {"skill": skill.name, "learned_from": skill.learned_from, "arm": self._arm, "request": request}
        content = json.dumps(saved | {"checksum": _checksum(saved)}, indent=1)
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=self._folder, suffix=".new", delete=False) as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise SkillError(f"cannot save via-points in {self._folder}: {error.strerror}") from None
        return Path(file.name)
