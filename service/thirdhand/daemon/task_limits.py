"""Limits of the tool at the positions of the skill in force, computed beside the loop."""

from __future__ import annotations

import threading
from collections.abc import Callable

from thirdhand.contract.requests import ToolLimits
from thirdhand.daemon.skill_worker import SkillWorker, tool_limits_of
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import SkillError


class TaskLimits:
    """The limits that the skill worker computes for each skill that comes into force."""

    def __init__(self, settings: Settings, worker: SkillWorker, say: Callable[[str], None]) -> None:
        self._settings = settings
        self._worker = worker
        self._say = say
        self._file = b""
        self._found: dict[str, ToolLimits] = {}
        self._work: threading.Thread | None = None

    def of(self, file: bytes) -> dict[str, ToolLimits]:
        """The limits for the skill in a file; empty until they are known. Never waits."""
        if file is self._file:
            return self._found
        if self._work is None or not self._work.is_alive():
            self._file = file
            self._found = {}
            self._work = threading.Thread(
                target=self._compute, args=(file,), name="tool limits", daemon=True
            )
            self._work.start()
        return {}

    def _compute(self, file: bytes) -> None:
        try:
            self._found = self._worker.compute(tool_limits_of, self._settings, file)
        except SkillError as error:
            self._say(f"what the arm can do where the task is was not computed: {error}")
