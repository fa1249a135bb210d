"""The page by which a headset's browser is the tracker: hands by WebXR, and the cell drawn around
the person.
"""

from __future__ import annotations

import html
from pathlib import Path

from aiohttp import web

from service.client import Client, Tracker
from service.trackers.browser_hands import NO_TOKEN, BrowserHands
from service.trackers.cell_view import Latest
from service.trackers.web_server import HTML, INLINE, ServerCertificate, WebServer, answer, filled

FRAME = "webxr"  # x to the right, y up, -z ahead of where the headset was when its floor was set, metres
PAGE_FOLDER = Path(__file__).parent
UNKNOWN_PAGE = "There is no such page. Open the address that `thirdhand hands` printed."


class HeadsetPage:
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
    ) -> None:
        self._cell = cell
        self.hands = BrowserHands(tracker, client, latest, frame=FRAME, has_token=self._has_token)
        routes = [web.get("/", self._front), web.get("/hands", self.hands.socket)]
        self.server = WebServer(routes, unknown=UNKNOWN_PAGE, certificate=certificate, token=token)

    def _has_token(self, given: str) -> bool:
        return self.server.has_token(given)

    async def _front(self, request: web.Request) -> web.Response:
        if not self._has_token(request.query.get("token", "")):
            return answer(403, NO_TOKEN)
        socket = f"{'wss' if self.server.scheme == 'https' else 'ws'}://{request.host}"
        policy = f"connect-src 'self' {socket}; {INLINE}; frame-ancestors 'none'"
        scripts = {name: filled(PAGE_FOLDER / f"{name}.js") for name in ("link", "scene")}
        text = filled(PAGE_FOLDER / "headset.html", cell=html.escape(self._cell), frame=FRAME, **scripts)
        return answer(200, text, kind=HTML, policy=policy)
