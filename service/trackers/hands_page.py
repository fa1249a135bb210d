"""A page of a browser that sends hands, and its server."""

from __future__ import annotations

import html
from collections.abc import Iterable
from pathlib import Path

from aiohttp import web

from service.client import Client, Tracker
from service.trackers.browser_hands import NO_TOKEN, BrowserHands
from service.trackers.cell_view import Latest
from service.trackers.pinch import Pinches
from service.trackers.web_server import HTML, INLINE, ServerCertificate, WebServer, answer, filled

PAGE_FOLDER = Path(__file__).parent
UNKNOWN_PAGE = "There is no such page. Open the address that was printed, with its token."


class HandsPage:
    """The page and its server: the file `page` with the scripts and fields that it names filled in.

    Each kind of page is a subclass that names its file, scripts and frame. The poses are published
    in that frame, see `BrowserHands`. `more` are further routes.
    """

    page: str
    scripts: tuple[str, ...]
    frame: str

    def __init__(
        self,
        tracker: Tracker,
        client: Client,
        latest: Latest,
        *,
        cell: str,
        certificate: ServerCertificate | None = None,
        token: str = "",
        more: Iterable[web.AbstractRouteDef] = (),
        pinches: Pinches | None = None,
        **fields: str,
    ) -> None:
        self._fields = {"cell": html.escape(cell), "frame": self.frame} | fields
        self.hands = BrowserHands(tracker, client, latest, frame=self.frame, has_token=self.has_token, pinches=pinches)
        routes = [web.get("/", self._front), web.get("/hands", self.hands.socket), *more]
        self.server = WebServer(routes, unknown=UNKNOWN_PAGE, certificate=certificate, token=token)

    def has_token(self, given: str) -> bool:
        """True for the token of the page."""
        return self.server.has_token(given)

    async def _front(self, request: web.Request) -> web.Response:
        if not self.has_token(request.query.get("token", "")):
            return answer(403, NO_TOKEN)
        socket = f"{'wss' if self.server.scheme == 'https' else 'ws'}://{request.host}"
        policy = f"connect-src 'self' {socket}; {INLINE}; frame-ancestors 'none'"
        scripts = {name: filled(PAGE_FOLDER / f"{name}.js") for name in self.scripts}
        return answer(200, filled(PAGE_FOLDER / self.page, **self._fields, **scripts), kind=HTML, policy=policy)
