"""Search for a way out of a stuck posture, beside the loop."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable

import numpy as np

from thirdhand.core.frame import Event, Frame, Record, order
from thirdhand.daemon.skill_worker import SkillWorker, way_out_of
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import SkillError

AGAIN_S = 2.0  # the search is repeated after this time, because obstacles may have moved


class WayFinder:
    """A search for ways out in the skill worker, one at a time; it sends the result to the loop."""

    def __init__(
        self,
        settings: Settings,
        worker: SkillWorker,
        send: Callable[[Event], object],
        say: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._worker = worker
        self._send = send
        self._say = say
        self._search: threading.Thread | None = None
        self._next_s = 0.0

    def poll(self, frame: Frame, state: Record) -> None:
        """Begin a search if the arm is stuck without a way out. Never waits."""
        searching = self._search is not None and self._search.is_alive()
        if not state["stuck"] or state["way_count"] or searching or time.monotonic() < self._next_s:
            return
        hands = np.array(frame["hands"])
        arguments = (
            state["joints"][0].copy(),
            frame["target"].copy(),
            frame["orientation"].copy(),
            hands,
        )
        self._search = threading.Thread(
            target=self._find, args=arguments, name="way out", daemon=True
        )
        self._search.start()

    def _find(self, *arguments: np.ndarray) -> None:
        began_s = time.monotonic()
        try:
            postures = self._worker.compute(way_out_of, self._settings, *arguments)
        except SkillError as error:
            self._say(f"the search for a way out failed: {error}")
            return
        finally:
            self._next_s = time.monotonic() + AGAIN_S
        self._send(order("way", json.dumps([posture.tolist() for posture in postures])))
        ways = f"a way out of {len(postures)} postures" if postures else "no way out"
        self._say(f"the tool is stuck: {ways}, found in {time.monotonic() - began_s:.1f} s")
