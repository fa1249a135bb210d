"""The stage of the task that survives a restart: a small file, written anew whenever it changes."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

from service.core.skill.skill import Skill
from service.daemon.saved_state import restored
from service.daemon.single_instance import state_folder
from service.settings.config import Settings

LONGEST_S = 600.0  # a restart that takes longer is of another job: its hands tell where it begins
SURE = 0.5  # a stage that is less probable is not worth keeping


class SavedStage:
    """The via-point that the task came from last, on disk; written atomically."""

    def __init__(self, settings: Settings) -> None:
        self._path = state_folder(settings) / "stage.json"
        self._kept = ""

    def read(self, skill: Skill) -> str:
        """The via-point that a task of this skill has come to lately; empty: not known."""
        return restored(self._path, lambda content: self._decoded(content, skill), "", what="the stage of the task")

    def _decoded(self, content: bytes, skill: Skill) -> str:
        saved, age_s = json.loads(content), time.time() - self._path.stat().st_mtime
        name, learned_from = saved["via_point"], saved["learned_from"]
        is_lately = learned_from == skill.learned_from and 0.0 <= age_s < LONGEST_S
        return str(name) if is_lately and name in skill.model.names else ""

    def keep(self, skill: Skill, stage: tuple[str, ...], belief: float) -> None:
        """Takes note of the stage that it is now, from and to a via-point. Raises OSError."""
        if not stage or belief < SURE or stage[0] == self._kept:
            return
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        draft: Path = self._path.with_suffix(f".{os.getpid()}.new")
        draft.write_text(json.dumps({"learned_from": skill.learned_from, "via_point": stage[0]}))
        draft.replace(self._path)
        self._kept = stage[0]
