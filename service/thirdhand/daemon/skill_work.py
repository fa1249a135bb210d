"""Work of the skill worker for a running cell, which its loop does not wait for."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence

import numpy as np

from thirdhand.contract.requests import RequestError, ToolLimits, ViaPoint
from thirdhand.core.frame import order
from thirdhand.daemon.answers import Answers
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.skill_worker import tool_limits_of, way_out_of
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.skills.via_points import StartPlace

AGAIN_S = 2.0  # a search is repeated after this time, because obstacles may have moved


class SkillWork:
    """Searches for ways out of a stuck posture, whose results are sent to the loop; the limits of
    the tool at the positions of the skill in force; and a task's start where the hands rest. Each
    has one thread.
    """

    def __init__(self, cell: CellState, answers: Answers) -> None:
        self._cell = cell
        self._answers = answers
        self._skill_worker = answers.skill_worker
        self._start = StartPlace(cell.settings.period_s)
        self._beginning = threading.Thread()
        self._search = threading.Thread()
        self._next_search_s = 0.0
        self._computation = threading.Thread()
        self._file = b""
        self._limits: dict[str, ToolLimits] = {}

    def find_way(self) -> None:
        """Begin a search if the arm is stuck without a way out. Never waits."""
        frame = self._cell.frame
        state = self._cell.controller.state
        is_searching = self._search.is_alive() or time.monotonic() < self._next_search_s
        if not state["stuck"] or state["way_count"] or is_searching:
            return
        arguments = (
            state["joints"][0].copy(),
            frame["target"].copy(),
            frame["orientation"].copy(),
            frame["hands"].copy(),
        )
        self._search = threading.Thread(
            target=self._find, args=arguments, name="way out", daemon=True
        )
        self._search.start()

    def _find(self, *arguments: np.ndarray) -> None:
        began_s = time.monotonic()
        try:
            postures = self._skill_worker.compute(way_out_of, self._cell.settings, *arguments)
        except SkillError as error:
            self._cell.note_beside(f"the search for a way out failed: {error}")
            return
        finally:
            self._next_search_s = time.monotonic() + AGAIN_S
        self._cell.own.append(order("way", json.dumps([posture.tolist() for posture in postures])))
        ways = f"a way out of {len(postures)} postures" if postures else "no way out"
        self._cell.note_beside(
            f"the tool is stuck: {ways}, found in {time.monotonic() - began_s:.1f} s"
        )

    def begin_where_hands_rest(self) -> None:
        """Move the start of the task to hands that rest beside it. Never waits."""
        skill = self._cell.skill
        state = self._cell.controller.state
        points = self._start.moved(skill, state)
        is_in_force = state["skill"].tobytes() == skill.digest
        if points and is_in_force and not self._beginning.is_alive():
            self._beginning = threading.Thread(
                target=self._begin, args=(skill, points), name="start of the task", daemon=True
            )
            self._beginning.start()

    def _begin(self, skill: StoredSkill, points: Sequence[ViaPoint]) -> None:
        try:
            self._answers.begin_at(skill, points)
        except (RequestError, SkillError) as error:
            self._start.refused()
            self._cell.note_beside(f"the task's start stays where it was: {error}")
        else:
            self._start.taken()
            names = ", ".join(point.name for point in points)
            self._cell.note_beside(f"the task begins where the hands rest: {names} moved there")

    def tool_limits(self) -> dict[str, ToolLimits]:
        """The limits for the skill in force; empty until they are known. Never waits."""
        file = self._cell.file
        if file is self._file:
            return self._limits
        if not self._computation.is_alive():
            self._file = file
            self._limits = {}
            self._computation = threading.Thread(
                target=self._compute, args=(file,), name="tool limits", daemon=True
            )
            self._computation.start()
        return {}

    def _compute(self, file: bytes) -> None:
        try:
            self._limits = self._skill_worker.compute(tool_limits_of, self._cell.settings, file)
        except SkillError as error:
            self._cell.note_beside(
                f"what the arm can do where the task is was not computed: {error}"
            )
