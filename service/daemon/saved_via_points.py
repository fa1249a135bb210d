"""Via-points that survive a restart: a file for each skill that was taught to each arm."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from service.contract.explain import in_words
from service.contract.requests import Add, ViaPoint, decode_request, encode_json
from service.core.frame import Vector
from service.core.skill.skill import Skill
from service.daemon.saved_state import restored
from service.daemon.single_instance import state_folder
from service.learning.reach import beyond_m
from service.learning.skill_file import SkillError
from service.settings.config import Settings, robot_description
from service.settings.file_content import UnusableError
from service.settings.urdf import Urdf

log = logging.getLogger("thirdhand")
T = TypeVar("T")
WHAT = "the taught via-points"


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
    """The via-points taught to each skill of an arm, on disk; written atomically.

    Those that the arm does not reach, as it is now, are set aside.
    """

    def __init__(self, settings: Settings, distances_m: Callable[[Settings, Vector], Vector] = beyond_m) -> None:
        self._folder, self._settings, self._distances_m = state_folder(settings), settings, distances_m
        self._arm, self._shipped_arm = _identity(settings), _identity(Settings())

    def path(self, skill: Skill) -> Path:
        """The file for this skill and arm, named by the hash of what the skill was learned from."""
        arm = "" if self._arm == self._shipped_arm else self._arm  # as before there were others
        digest = hashlib.blake2b((skill.learned_from + arm).encode(), digest_size=6).hexdigest()
        return self._folder / f"places-{digest}.json"

    def read(self, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """Via-points and tolerance taught to this skill of this arm, or None."""
        found = restored(self.path(skill), lambda content: self._decoded(content, skill), None, what=WHAT)
        return found and self._reached(skill, *found)

    def restored(self, skill: Skill, make: Callable[[tuple[ViaPoint, ...], float], T], otherwise: T) -> T:
        """The value that `make` makes of the via-points and the tolerance taught to this skill of
        this arm; `otherwise` where none were, or where that fails.
        """

        def made(content: bytes) -> T:
            found = self._decoded(content, skill)
            return otherwise if found is None else make(*self._reached(skill, *found))

        return restored(self.path(skill), made, otherwise, what=WHAT)

    def _reached(
        self, skill: Skill, points: tuple[ViaPoint, ...], tolerance: float
    ) -> tuple[tuple[ViaPoint, ...], float]:
        """The via-points whose tool positions the arm reaches. Others are kept in a file that
        `thirdhand via-points add --file` takes, which the log reports.
        """
        distances_m = self._distances_m(self._settings, np.reshape([point.tool for point in points], (-1, 3)))
        beyond_m = {point.name: m for point, m in zip(points, distances_m.tolist(), strict=True) if m > 0.0}
        if not beyond_m:
            return points, tolerance
        content = encode_json(Add(tuple(point for point in points if point.name in beyond_m), tolerance))
        digest = hashlib.blake2b(self.path(skill).name.encode() + content, digest_size=6).hexdigest()
        aside = self._folder / f"out-of-reach-{digest}.json"
        try:
            self._written(content).replace(aside)
            where = f"are set aside: once the arm reaches them, teach them by thirdhand via-points add --file {aside}"
        except (OSError, SkillError) as error:
            where = f"are not in force, and lost once others are taught: they cannot be set aside ({in_words(error)})"
        names = ", ".join(f"{name!r} by {m:.3f} m" for name, m in beyond_m.items())
        log.warning("via-points of skill %r are out of the arm's reach, %s; they %s", skill.name, names, where)
        return tuple(point for point in points if point.name not in beyond_m), tolerance

    def _decoded(self, content: bytes, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """None where they belong to another skill or arm."""
        saved = json.loads(content)
        if saved.pop("checksum", None) != _checksum(saved):
            raise UnusableError("the checksum is wrong: the file was changed since; teach them again")
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
        return self._written(json.dumps(saved | {"checksum": _checksum(saved)}, indent=1).encode())

    def _written(self, content: bytes) -> Path:
        """A temporary file of this content, flushed to disk. Raises SkillError."""
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".new", delete=False) as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise SkillError(f"cannot save via-points in {self._folder}: {error.strerror}") from None
        return Path(file.name)
