"""The page by which a mouse or a finger is the tracker: both hands over the bench, from above."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from aiohttp import web

from thirdhand.client import Client, Tracker
from thirdhand.contract.messages import BASE
from thirdhand.settings import palette
from thirdhand.workbench.trackers.browser_hands import NO_TOKEN
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.hands_page import HandsPage
from thirdhand.workbench.trackers.web_server import JSON, answer

PAGE_COLOURS = {
    **palette.BY_TRACK,
    "target": palette.TARGET,
    "arm": palette.ARM_BODY,
    "grid": palette.GRID,
}


class PlayedTask:
    """A task that a person plays on the page: achieved events, and its end."""

    def __init__(self, end: Callable[[], None]) -> None:
        """`end` is called when the person ends the task."""
        self.end = end
        self.lines: list[str] = []
        self.outcome = ""  # not empty once the task has ended
        self.is_done = False  # true if everything was achieved

    def shown(self) -> dict[str, Any]:
        """The task as the page shows it."""
        return {"lines": self.lines, "outcome": self.outcome, "isDone": self.is_done}


class MousePage(HandsPage):
    """The page and its server; with a `task`, the page shows it and can end it. Other arguments are
    those of `HandsPage`.
    """

    page = "mouse.html"
    scripts = ("link", "controls")
    frame = BASE

    def __init__(
        self,
        tracker: Tracker,
        client: Client,
        latest: Latest,
        *,
        task: PlayedTask | None = None,
        **served: Any,
    ) -> None:
        async def show(_: web.Request) -> web.Response:
            assert task is not None
            return answer(200, json.dumps(task.shown()), kind=JSON)

        async def end(request: web.Request) -> web.Response:
            assert task is not None
            if not self.has_token(request.headers.get("X-Thirdhand-Token", "")):
                return answer(403, NO_TOKEN)
            task.end()
            return answer(200, "The task ends.")

        super().__init__(
            tracker,
            client,
            latest,
            **served,
            more=[web.get("/task", show), web.post("/end", end)] if task else (),
            colours=json.dumps(PAGE_COLOURS),
            left=" ".join(map(str, palette.LEFT)),
            right=" ".join(map(str, palette.RIGHT)),
            task=json.dumps(task is not None),
        )
