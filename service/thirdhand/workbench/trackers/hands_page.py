"""A page of a browser that sends hands, and its server."""

from __future__ import annotations

import html
from collections.abc import Iterable
from pathlib import Path

from aiohttp import web

from thirdhand.client import Client, Tracker
from thirdhand.workbench.trackers.browser_hands import NO_TOKEN, BrowserHands
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.lead import Lead
from thirdhand.workbench.trackers.pinch import Pinches
from thirdhand.workbench.trackers.web_server import (
    HTML,
    INLINE,
    JAVASCRIPT,
    ServerCertificate,
    WebServer,
    answer,
    filled,
)

PAGE_FOLDER = Path(__file__).parent
WORKER = "link_worker.js"  # a thread of its own in the browser
# x to the right, y up, -z ahead of where the headset was when its floor was set, metres
HEADSET_FRAME = "webxr"
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
        lead: Lead | None = None,
        **fields: str,
    ) -> None:
        self._fields = {"cell": html.escape(cell), "frame": self.frame} | fields
        self.hands = BrowserHands(
            tracker,
            client,
            latest,
            frame=self.frame,
            has_token=self.has_token,
            pinches=pinches,
            lead=lead,
        )
        page_routes = [
            ("/", self._front),
            (f"/{WORKER}", self._worker),
            ("/hands", self.hands.socket),
        ]
        routes = [*(web.get(path, handler) for path, handler in page_routes), *more]
        self.server = WebServer(routes, unknown=UNKNOWN_PAGE, certificate=certificate, token=token)

    def has_token(self, given: str) -> bool:
        """True for the token of the page."""
        return self.server.has_token(given)

    async def _front(self, request: web.Request) -> web.Response:
        parts = {name: filled(PAGE_FOLDER / f"{name}.js") for name in self.scripts}
        text = filled(
            PAGE_FOLDER / self.page, style=filled(PAGE_FOLDER / "page.css"), **parts, **self._fields
        )
        return self._answer(
            request, text, HTML, f"{INLINE}; worker-src 'self'; frame-ancestors 'none'"
        )

    async def _worker(self, request: web.Request) -> web.Response:
        return self._answer(
            request, filled(PAGE_FOLDER / WORKER), JAVASCRIPT, "frame-ancestors 'none'"
        )

    def _answer(self, request: web.Request, text: str, kind: str, policy: str) -> web.Response:
        """The answer with a text for clients with the token; the page may connect to this server
        only.
        """
        if not self.has_token(request.query.get("token", "")):
            return answer(403, NO_TOKEN)
        socket = f"{'wss' if self.server.scheme == 'https' else 'ws'}://{request.host}"
        return answer(200, text, kind=kind, policy=f"connect-src 'self' {socket}; {policy}")


class HeadsetPage(HandsPage):
    """The page by which a headset's browser is the tracker: hands by WebXR, and the cell drawn
    around the person.
    """

    page = "headset.html"
    scripts = ("link", "controls", "scene")
    frame = HEADSET_FRAME
