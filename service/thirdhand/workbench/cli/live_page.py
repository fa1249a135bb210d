"""The page of `thirdhand view live --web`: mode and reason, buttons for hold, resume and reset, and
Rerun's web viewer, or a plain view from above on a phone and on other machines.

Rerun's own program serves the viewer, and the scribe the stream, on ports of this machine. A
request that changes something needs the token in the page, which no other site can read.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import json
import secrets
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import zenoh
from aiohttp import web

from thirdhand.client import Client
from thirdhand.contract.incidents import ORDERS
from thirdhand.daemon.launch import free_port
from thirdhand.viewer.stream import ViewerError, rerun_program
from thirdhand.workbench.trackers.cell_view import Latest, carried_out
from thirdhand.workbench.trackers.web_server import HTML, INLINE, JSON, WebServer, answer, filled

START_S = 15.0  # the viewer's server starts within this time
PAGE = Path(__file__).with_name("live.html")
NO_SUCH_PAGE = "There is no such page. The page of this cell is at /."


class LivePage:
    """The page and its server; `viewer` is the URL of Rerun's web viewer."""

    def __init__(self, *, client: Client, latest: Latest, cell: str, viewer: str) -> None:
        self._client = client
        self._latest = latest
        self._cell = html.escape(cell)
        self._viewer = viewer
        self._page = secrets.token_hex(4)
        routes = [
            web.get("/", self._front),
            web.get("/status", self._status),
            web.post(f"/{{order:{'|'.join(ORDERS)}}}", self._order),
        ]
        self.server = WebServer(routes, unknown=NO_SUCH_PAGE)

    async def _front(self, _: web.Request) -> web.Response:
        text = filled(
            PAGE, token=self.server.token, page=self._page, viewer=self._viewer, cell=self._cell
        )
        policy = f"connect-src 'self'; frame-src {self._viewer}; {INLINE}; frame-ancestors 'none'"
        return answer(200, text, kind=HTML, policy=policy)

    async def _status(self, _: web.Request) -> web.Response:
        summary = self._latest.summary() | {"page": self._page}
        return answer(200, json.dumps(summary), kind=JSON)

    async def _order(self, request: web.Request) -> web.Response:
        """Carry out hold, resume or reset, even if the browser disconnects meanwhile."""
        if not self.server.has_token(request.headers.get("X-Thirdhand-Token", "")):
            return answer(403, "The token of the page is needed: reload it.")
        order = asyncio.to_thread(carried_out, self._client, request.match_info["order"])
        is_done, text = await asyncio.shield(order)
        return answer(200 if is_done else 502, text)


@contextlib.contextmanager
def live_page(session: zenoh.Session, client: Client, cell: str, url: str) -> Iterator[LivePage]:
    """The page of a live view, with its viewer while the context lasts. Raises ViewerError."""
    with web_viewer(url) as viewer:
        yield LivePage(
            client=client, latest=Latest(session, cell, client.status()), cell=cell, viewer=viewer
        )


@contextlib.contextmanager
def web_viewer(stream: str) -> Iterator[str]:
    """The URL of Rerun's web viewer, which its own program serves on a free port of this machine
    while the context lasts. Raises ViewerError if it does not start.

    The URL has the machine's name `localhost`. For a browser that has the page from 127.0.0.1 this
    is another site, which runs in a process of its own, so that the buttons always respond.
    """
    port = free_port()
    command = [
        str(rerun_program()),
        "--serve-web",
        "--bind",
        "127.0.0.1",
        "--web-viewer-port",
        str(port),
        stream,
    ]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as viewer:
        try:
            deadline_s = time.monotonic() + START_S
            while not _is_listening(port):
                if viewer.poll() is not None or time.monotonic() > deadline_s:
                    raise ViewerError(
                        f"the web viewer did not start on port {port} within {START_S:g} s"
                    )
                time.sleep(0.1)
            yield f"http://localhost:{port}/"
        finally:
            viewer.kill()


def _is_listening(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True
