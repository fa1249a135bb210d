"""Requests of one cell without its loop: requests arrive by Zenoh, and a thread takes them."""

from __future__ import annotations

import itertools
import threading
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from support.statuses import holding
from thirdhand.client import Client
from thirdhand.contract import channels, requests
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.controller import start_state
from thirdhand.core.frame import Event
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.answers import Answers
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.queryables import Queryables
from thirdhand.daemon.request_inbox import RequestInbox
from thirdhand.daemon.single_instance import state_folder
from thirdhand.daemon.skill_worker import SkillWorker
from thirdhand.settings.config import Files, Reach, Settings
from thirdhand_sim.scene import Scene

VIA_POINTS = Scene().via_points()
CELLS = (f"tests/cell{n}" for n in itertools.count())


class Cell(CellState):
    """Requests of one cell, a thread in the loop's place that drains their inbox, and a client."""

    def __init__(
        self,
        near: zenoh.Session,
        far: zenoh.Session,
        skill: Skill,
        skill_worker: SkillWorker,
        folder: Path,
        reach: Reach = Reach(),  # noqa: B008  # immutable
    ) -> None:
        (folder / "soldering.npz").write_bytes(skill.file)
        self.folder = folder
        self.settings = Settings(
            cell=next(CELLS), files=Files(state=str(folder / "state")), reach=reach
        )
        self.inbox = RequestInbox()
        self.adoptable = {skill.digest: skill}
        self.scribe = self.newest_status = self
        self.taken: list[Event] = []
        self.notes: list[str] = []
        self.kept: list[bytes] = []
        self.running = True
        self.fails = False
        self.reason = Reason.NO_HANDS
        self.state = start_state(self.settings, skill)
        self._tick = 0
        self._end = threading.Event()
        self.failures: list[str] = []
        self.note = self.notes.append
        self.keep = self.kept.append
        self.fail = self.failures.append
        self.requests = Queryables(self, Answers(self, skill_worker, folder))
        self._loop = threading.Thread(target=self._drain)
        self._loop.start()
        self.requests.open(near)
        self._token = near.liveliness().declare_token(
            channels.presence(self.settings.cell, str(near.zid()))
        )
        self.session = far
        self.client = Client(far, self.settings.cell, timeout_s=60.0)  # the first request compiles
        self.client.wait_until_ready()

    @property
    def mode(self) -> Mode:
        return Mode(int(self.state["mode"]))

    @mode.setter
    def mode(self, mode: Mode) -> None:
        self.state["mode"] = mode

    def moment(self) -> tuple[Any, Any]:
        return self.frame(), self.state

    def requested(self, *, published: bool) -> bytes:
        return requests.encode_json(holding(self.settings.cell, self._tick))

    def frame(self) -> dict[str, Any]:
        unseen = {
            "hand_ages": np.array((-1, -1)),
            "stale_ticks": np.array((50, 50)),
            "hands": np.zeros((2, 3)),
        }
        return {"tick": self._tick, "mode": self.mode, "reason": self.reason, **unseen}

    def _drain(self) -> None:
        while not self._end.wait(0.0005):
            self._tick += 1
            if self.running and self.inbox:
                events = self.inbox.take(self.state)
                if self.fails:
                    self.inbox.answer(None)
                    continue
                for event in events:
                    self.taken.append(event)
                    if event.kind == "skill":
                        self.state["skill"] = np.frombuffer(event.value.digest, np.uint8)
                    elif event.kind in ("hold", "resume"):
                        self.state["operator_hold"] = event.kind == "hold"
                self.inbox.answer(self.frame())  # type: ignore[arg-type]

    def refusal(self, suffix: str, request: Any) -> str:
        """The words in which a request is refused; bytes are sent as they are."""
        before = len(self.taken), self.names(), self.saved_bytes()
        reply = self.reply(suffix, request)
        assert reply.err is not None
        assert (len(self.taken), self.names(), self.saved_bytes()) == before
        return reply.err.payload.to_string()

    def reply(self, suffix: str, request: Any) -> zenoh.Reply:
        """The only reply to a request; bytes are sent as they are."""
        payload = request if isinstance(request, bytes) else requests.encode_json(request)
        (reply,) = self.session.get(
            channels.key(self.settings.cell, suffix), payload=payload, timeout=10.0
        )
        return reply

    def names(self) -> list[str]:
        """The names of the via-points in force."""
        return [point["name"] for point in self.client.ask("via_points", {"op": "list"})["points"]]

    def saved_bytes(self) -> bytes:
        folder = state_folder(self.settings)
        return b"".join(file.read_bytes() for file in sorted(folder.glob("via-points-*.json")))

    def kinds(self) -> list[str]:
        return [event.kind for event in self.taken]

    def close(self) -> None:
        if not self._end.is_set():
            self.requests.close()
            self._end.set()
            self._loop.join()
