"""Work of the skill worker for a running cell, which its loop does not wait for."""

from __future__ import annotations

import json
import threading
import time

import numpy as np

from thirdhand.contract.requests import ToolLimits
from thirdhand.core.frame import order
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.skill_worker import SkillWorker, tool_limits_of, way_out_of
from thirdhand.skills.skill_file import SkillError

AGAIN_S = 2.0  # a search is repeated after this time, because obstacles may have moved


class SkillWork:
    """Searches for ways out of a stuck posture, whose results are sent to the loop, and the limits
    of the tool at the positions of the skill in force; one thread for each.
    """

    def __init__(self, cell: CellState, skill_worker: SkillWorker) -> None:
        self._cell = cell
        self._skill_worker = skill_worker
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
