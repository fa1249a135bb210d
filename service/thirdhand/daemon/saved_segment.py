"""The saved segment of the task: a small file that is rewritten at each change."""

from __future__ import annotations

import json
import time

from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.saved_state import restored
from thirdhand.daemon.single_instance import state_folder
from thirdhand.settings.config import Settings
from thirdhand.settings.whole_file import whole

# after a longer pause the task begins again, at the segment where the hands are
MAX_RESTART_S = 600.0
MIN_BELIEF = 0.5  # a less probable segment is not saved


class SavedSegment:
    """The last via-point of the task, in a file that is written atomically."""

    def __init__(self, settings: Settings) -> None:
        self._path = state_folder(settings) / "segment.json"
        self._kept = ("", "")  # the skill's demonstrations, and the via-point

    def read(self, skill: Skill) -> str:
        """The last via-point of a task of this skill; empty if it is not known."""
        return restored(
            self._path,
            lambda content: self._decoded(content, skill),
            "",
            what="the segment of the task",
        )

    def _decoded(self, content: bytes, skill: Skill) -> str:
        saved = json.loads(content)
        age_s = time.time() - self._path.stat().st_mtime
        name = saved["via_point"]
        learned_from = saved["learned_from"]
        is_valid = learned_from == skill.learned_from and 0.0 <= age_s < MAX_RESTART_S
        return str(name) if is_valid and name in skill.model.names else ""

    def keep(self, skill: Skill, segment: tuple[str, ...], belief: float) -> None:
        """Save the present segment, a pair of via-points, if it changed. Raises OSError."""
        if not segment or belief < MIN_BELIEF or (skill.learned_from, segment[0]) == self._kept:
            return
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with whole(self._path) as draft:
            draft.write_text(
                json.dumps({"learned_from": skill.learned_from, "via_point": segment[0]})
            )
        self._kept = skill.learned_from, segment[0]
