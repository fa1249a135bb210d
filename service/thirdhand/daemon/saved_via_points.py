"""Saved via-points, with a file for each skill and each arm that it was taught to."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from thirdhand.contract.explain import in_words
from thirdhand.contract.requests import Add, ViaPoint, decode_request, encode_json
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.saved_state import restored
from thirdhand.daemon.single_instance import state_folder
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.file_content import UnusableError
from thirdhand.settings.urdf import Urdf
from thirdhand.skills.reach import beyond_m
from thirdhand.skills.skill_file import SkillError

log = logging.getLogger("thirdhand")
Made = TypeVar("Made")
WHAT = "the taught via-points"


def _checksum(saved: dict[str, Any]) -> str:
    """The checksum of all that is saved, independent of its layout."""
    return hashlib.blake2b(json.dumps(saved, sort_keys=True).encode(), digest_size=16).hexdigest()


def _identity(settings: Settings) -> str:
    """A text that identifies an arm: its joints and their positions to a centimetre, so that a
    calibration does not change it.
    """
    chain = Urdf(robot_description(settings)).chain(settings.arm.plate)
    return "; ".join(
        " ".join([joint.name, *(f"{round(v, 2) + 0.0:.2f}" for v in joint.translation)])
        for joint in chain
    )


class SavedViaPoints:
    """The via-points taught to each skill of an arm, in files that are written atomically.

    Via-points that the arm does not reach are set aside in another file.
    """

    def __init__(
        self, settings: Settings, distances_m: Callable[[Settings, Vector], Vector] = beyond_m
    ) -> None:
        self._folder = state_folder(settings)
        self._settings = settings
        self._distances_m = distances_m
        self._arm = _identity(settings)
        self.remark = ""  # message on via-points that were set aside by the last reading

    def path(self, skill: Skill) -> Path:
        """The file for this skill and arm, named by a hash of the skill's demonstrations."""
        digest = hashlib.blake2b(
            (skill.learned_from + self._arm).encode(), digest_size=6
        ).hexdigest()
        return self._folder / f"via-points-{digest}.json"

    def read(self, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """The via-points and the tolerance taught to this skill of this arm; None if there are
        none. `remark` names those that the arm does not reach.
        """
        saved = restored(
            self.path(skill), lambda content: self._decoded(content, skill), None, what=WHAT
        )
        return saved and self._reached(skill, *saved)

    def restored(
        self, skill: Skill, make: Callable[[tuple[ViaPoint, ...], float], Made], otherwise: Made
    ) -> Made:
        """The value that `make` returns for the via-points and the tolerance taught to this skill
        of this arm; `otherwise` if there are none, or if that fails.
        """

        def made(content: bytes) -> Made:
            saved = self._decoded(content, skill)
            return otherwise if saved is None else make(*self._reached(skill, *saved))

        return restored(self.path(skill), made, otherwise, what=WHAT)

    def _reached(
        self, skill: Skill, points: tuple[ViaPoint, ...], tolerance: float
    ) -> tuple[tuple[ViaPoint, ...], float]:
        """The via-points whose tool positions the arm reaches. The others are written to a file for
        `thirdhand via-points add --file`, which log and remark name.
        """
        distances_m = self._distances_m(
            self._settings, np.reshape([point.tool for point in points], (-1, 3))
        )
        beyond_m = {
            point.name: m for point, m in zip(points, distances_m.tolist(), strict=True) if m > 0.0
        }
        self.remark = ""
        if not beyond_m:
            return points, tolerance
        content = encode_json(
            Add(tuple(point for point in points if point.name in beyond_m), tolerance)
        )
        digest = hashlib.blake2b(
            self.path(skill).name.encode() + content, digest_size=6
        ).hexdigest()
        aside = self._folder / f"out-of-reach-{digest}.json"
        try:
            with self._replacing(aside, content):
                pass
            where = (
                "are set aside: once the arm reaches them, teach them by thirdhand via-points add "
                f"--file {aside}"
            )
        except (OSError, SkillError) as error:
            where = (
                "are not in force, and the next teaching deletes them: they cannot be set aside "
                f"({in_words(error)})"
            )
        names = ", ".join(f"{name!r} by {m:.3f} m" for name, m in beyond_m.items())
        self.remark = (
            f"via-points of skill {skill.name!r} are out of the arm's reach, {names}; they {where}"
        )
        log.warning("%s", self.remark)
        return tuple(point for point in points if point.name not in beyond_m), tolerance

    def _decoded(self, content: bytes, skill: Skill) -> tuple[tuple[ViaPoint, ...], float] | None:
        """The via-points and the tolerance in a file; None if they are of another skill or arm."""
        saved = json.loads(content)
        if saved.pop("checksum", None) != _checksum(saved):
            raise UnusableError(
                "the checksum is wrong, so the file was edited; teach the via-points again"
            )
        request = saved["request"] and decode_request(
            json.dumps({"op": "add", **saved["request"]}).encode(), Add
        )
        if (saved["learned_from"], saved["arm"]) != (skill.learned_from, self._arm):
            return None
        return (request.points, request.tolerance) if request else ((), skill.tolerance)

    def replacing(self, skill: Skill) -> contextlib.AbstractContextManager[None]:
        """A context in which this skill's via-points are on disk. They replace the saved ones at
        its end, unless it raises. Raises SkillError if they cannot be written, OSError at its end.
        """
        request = None
        if skill.via_points:
            request = {
                "points": msgspec.to_builtins(skill.via_points),
                "tolerance": skill.tolerance,
            }
        saved = {
            "skill": skill.name,
            "learned_from": skill.learned_from,
            "arm": self._arm,
            "request": request,
        }
        content = json.dumps(saved | {"checksum": _checksum(saved)}, indent=1)
        return self._replacing(self.path(skill), content.encode())

    @contextlib.contextmanager
    def _replacing(self, path: Path, content: bytes) -> Iterator[None]:
        part = path.with_suffix(".new")
        try:
            try:
                self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                with os.fdopen(
                    os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb"
                ) as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise SkillError(
                    f"cannot save via-points in {self._folder}: {error.strerror}"
                ) from None
            yield
            part.replace(path)
        finally:
            with contextlib.suppress(OSError):
                part.unlink()
