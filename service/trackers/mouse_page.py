"""The page by which a mouse or a finger is the tracker: both hands over the bench, from above."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from service.client import Client, Tracker
from service.contract.messages import BASE
from service.settings import palette
from service.trackers.browser_hands import NO_TOKEN, BrowserHands
from service.trackers.cell_view import Latest
from service.trackers.web_server import HTML, INLINE, JSON, ServerCertificate, WebServer, answer, filled

FOLDER = Path(__file__).parent
UNKNOWN_PAGE = "There is no such page. Open the address that was printed, with its token."
COLOURS = {
    "left": palette.LEFT,
    "right": palette.RIGHT,
    "tool": palette.TOOL,
    "target": palette.TARGET,
    "arm": palette.ARM_BODY,
    "grid": palette.GRID,
}


class PlayedTask:
    """A task that a person plays on the page: what was achieved, and its end."""

    def __init__(self, end: Callable[[], None]) -> None:
        """`end` is called when the person ends the task. It may be called from any thread."""
        self.end = end
        self.lines: list[str] = []
        self.outcome = ""  # not empty once the task has ended
        self.is_done = False  # true if everything was achieved

    def shown(self) -> dict[str, Any]:
        """The task as the page shows it."""
        return {"lines": self.lines, "outcome": self.outcome, "isDone": self.is_done}


class MousePage:
    """The page and its server."""

    def __init__(
        self,
        tracker: Tracker,
        client: Client,
        latest: Latest,
        *,
        cell: str,
        certificate: ServerCertificate | None = None,
        token: str = "",
        task: PlayedTask | None = None,
    ) -> None:
        self._cell, self._task = cell, task
        self.hands = BrowserHands(tracker, client, latest, frame=BASE, has_token=self._has_token)
        routes = [web.get("/", self._front), web.get("/hands", self.hands.socket)]
        if task:
            routes += [web.get("/task", self._shown_task), web.post("/end", self._end)]
        self.server = WebServer(routes, unknown=UNKNOWN_PAGE, certificate=certificate)

    def _has_token(self, given: str) -> bool:
        return self.server.has_token(given)

    async def _front(self, request: web.Request) -> web.Response:
        if not self._has_token(request.query.get("token", "")):
            return answer(403, NO_TOKEN)
        socket = f"{'wss' if self.server.scheme == 'https' else 'ws'}://{request.host}"
        policy = f"connect-src 'self' {socket}; {INLINE}; frame-ancestors 'none'"
        text = filled(
            FOLDER / "mouse.html",
            cell=html.escape(self._cell),
            link=filled(FOLDER / "link.js"),
            colours=json.dumps(COLOURS),
            left=" ".join(map(str, palette.LEFT)),
            right=" ".join(map(str, palette.RIGHT)),
            task=json.dumps(self._task is not None),
        )
        return answer(200, text, kind=HTML, policy=policy)

    async def _shown_task(self, _: web.Request) -> web.Response:
        assert self._task is not None
        return answer(200, json.dumps(self._task.shown()), kind=JSON)

    async def _end(self, request: web.Request) -> web.Response:
        assert self._task is not None
        if not self._has_token(request.headers.get("X-Thirdhand-Token", "")):
            return answer(403, NO_TOKEN)
        self._task.end()
        return answer(200, "The task ends.")
