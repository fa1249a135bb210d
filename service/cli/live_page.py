"""The page of `thirdhand view live --web`: mode and reason, buttons for hold, resume and reset, and
Rerun's web viewer, on a phone a plain view from above, all at one address.

The server passes on the viewer's files and the daemon's stream from this machine, without
the samples that a browser does not draw. A request that changes something needs the token in the
page, which no other site can read. Nothing is fetched from elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import http.client
import json
import re
import secrets
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import aiohttp
from aiohttp import web
from yarl import URL

from service.client import Client
from service.contract.explain import in_words
from service.contract.incidents import ORDERS
from service.trackers.cell_view import Latest, carried_out
from service.trackers.web_server import HTML, INLINE, JSON, Address, WebServer, answer, filled

STREAM = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"  # the path at which viewers request the stream
PIECE = 64 * 1024  # bytes of a file that are passed on at once
TIMEOUT_S = 10.0  # the viewer's server and the stream answer within this time
START_S = 15.0  # the viewer's server starts within this time
A_PICTURE = 130  # messages that are sent ahead of a picture: 0.6 s, in which everything frequent is repeated
BEHIND_MS = 1000.0  # a picture older than this, compared with the newest message sent, makes no room for more
PATIENCE_S = 15.0  # a viewer that does not report a picture for this time is sent messages again
HISTORY_S = 2.0  # the samples of the past, which arrive first, are left out for this time
# A message of gRPC-Web after its header of 5 bytes: rows of a recording that are not static.
SAMPLES = re.compile(rb"\n[\x80-\xff]*.\x12[\x80-\xff]*.\n.\x08\x01.*8\0", re.DOTALL)
FOLDER = Path(__file__).parent
UNKNOWN = "There is no such page. The page of this cell is at /."
_OF_A_CONNECTION = {"connection", "keep-alive", "transfer-encoding", "content-length"}  # headers that are not passed on
_DROPPED_OF_REQUEST = {*_OF_A_CONNECTION, "host", "origin"}
_DROPPED_OF_ANSWER = {*_OF_A_CONNECTION, "date", "server"}


class Room:
    """A viewer's room for messages: samples are sent little ahead of its picture, or left out."""

    def __init__(self) -> None:
        self._left, self._sent_ms, self._due = 0, 0.0, time.monotonic() + HISTORY_S

    def _fill(self) -> None:
        self._left, self._due = A_PICTURE, time.monotonic() + PATIENCE_S

    def shown(self, at_ms: float) -> None:
        """Make room when the picture of this time [ms] is shown, unless that is far behind."""
        if not self._sent_ms - at_ms > BEHIND_MS:
            self._fill()

    def take(self) -> bool:
        """Take room for one more message; False if there is none."""
        if time.monotonic() > self._due:
            self._fill()
        self._left -= 1
        if self._left >= 0:
            self._sent_ms = 1000 * time.time()
        return self._left >= 0


class LivePage:
    """The page and its server."""

    def __init__(self, *, client: Client, latest: Latest, cell: str, viewer: Address) -> None:
        self._client, self._latest, self._cell, self._viewer = client, latest, cell, viewer
        self._page = secrets.token_hex(4)
        self._rooms: dict[str, Room] = {}  # by the viewer's address, which has a number
        routes = [
            web.get("/", self._front),
            web.get("/status", self._status),
            web.get("/viewer/", self._viewer_page),
            web.get("/viewer/{file:.+}", self._viewer_file),
            web.post("/viewer/shown", self._shown),
            web.post(STREAM, self._stream),
            web.post(f"/{{order:{'|'.join(ORDERS)}}}", self._order),
        ]
        self.server = WebServer(routes, unknown=UNKNOWN, around=[self._streams])

    async def _streams(self, _: web.Application) -> AsyncIterator[None]:
        """The context of connections to other servers of this machine."""
        # each browser's stream has a connection of its own, without end
        connector = aiohttp.TCPConnector(limit=0, force_close=True)
        async with aiohttp.ClientSession(connector=connector, auto_decompress=False) as self._session:
            yield

    async def _front(self, request: web.Request) -> web.Response:
        """The page, for a browser that reaches it by this host and port.

        The viewer is loaded under this machine's other name if it has one. For the browser that is
        another site, which runs in a process of its own, so that the buttons always respond.
        """
        viewer = f"http://{_other_name(request.host)}/viewer/"
        cell = html.escape(self._cell)
        text = filled(FOLDER / "live.html", token=self.server.token, page=self._page, viewer=viewer, cell=cell)
        policy = f"connect-src 'self'; frame-src {viewer}; {INLINE}; frame-ancestors 'none'"
        return answer(200, text, kind=HTML, policy=policy)

    async def _status(self, _: web.Request) -> web.Response:
        shown = self._latest.summary() | {"page": self._page}
        return answer(200, json.dumps(shown), kind=JSON)

    async def _viewer_page(self, request: web.Request) -> web.Response:
        sources = f"connect-src 'self'; worker-src 'self' blob:; {INLINE} 'self' 'wasm-unsafe-eval'"
        policy = f"{sources}; frame-ancestors http://{_other_name(request.host)}"
        return answer(200, filled(FOLDER / "live_viewer.html"), kind=HTML, policy=policy)

    async def _viewer_file(self, request: web.Request) -> web.StreamResponse:
        path = request.rel_url.raw_path_qs.removeprefix("/viewer")
        return await self._pass_on(request, self._viewer, path, lambda reply: reply.content.iter_chunked(PIECE))

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        page = request.headers.get("Referer", "")
        return await self._pass_on(request, self._latest.stream, STREAM, lambda reply: self._drawn(reply, page))

    async def _shown(self, request: web.Request) -> web.Response:
        """Note the time [ms] of the newest picture that a viewer has drawn."""
        with contextlib.suppress(KeyError, ValueError):
            self._rooms[request.headers.get("Referer", "")].shown(float(await request.read()))
        return answer(200, "")

    async def _order(self, request: web.Request) -> web.Response:
        """Carry out hold, resume or reset, even if the browser disconnects meanwhile."""
        if not self.server.has_token(request.headers.get("X-Thirdhand-Token", "")):
            return answer(403, "The token of the page is needed: reload it.")
        order = asyncio.to_thread(carried_out, self._client, request.match_info["order"])
        is_done, text = await asyncio.shield(order)
        return answer(200 if is_done else 502, text)

    async def _pass_on(
        self,
        request: web.Request,
        to: Address,
        path: str,
        pieces: Callable[[aiohttp.ClientResponse], AsyncIterator[bytes]],
    ) -> web.StreamResponse:
        """Pass on the answer of another server of this machine, piece by piece."""
        headers = {name: value for name, value in request.headers.items() if name.lower() not in _DROPPED_OF_REQUEST}
        body = await request.read()
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=TIMEOUT_S, sock_read=None if body else TIMEOUT_S)
        begun = web.StreamResponse()
        try:
            async with self._session.request(
                request.method,
                URL(f"http://{to}{path}", encoded=True),
                data=body or None,
                headers=headers,
                skip_auto_headers=("Accept", "Accept-Encoding", "Content-Type", "User-Agent"),
                timeout=timeout,
            ) as reply:
                begun.set_status(reply.status)
                for name, value in reply.headers.items():
                    if name.lower() not in _DROPPED_OF_ANSWER:
                        begun.headers[name] = value
                await begun.prepare(request)
                async for piece in pieces(reply):
                    await begun.write(piece)
        except (aiohttp.ClientError, OSError) as error:  # a TimeoutError too
            if not begun.prepared:
                return answer(502, f"{to} does not answer: {in_words(error, named=False)}")
            if request.transport is not None:
                request.transport.abort()  # so that the browser does not take the part for the whole
        return begun

    async def _drawn(self, reply: aiohttp.ClientResponse, page: str) -> AsyncIterator[bytes]:
        """The messages of a stream, without the samples that the page's viewer has no room for."""
        room = self._rooms[page] = Room()
        try:
            while True:
                header = await reply.content.readexactly(5)
                message = header + await reply.content.readexactly(int.from_bytes(header[1:], "big"))
                if not SAMPLES.fullmatch(message, 5) or room.take():
                    yield message
        except asyncio.IncompleteReadError:
            pass  # the stream has ended
        finally:
            if self._rooms.get(page) is room:
                del self._rooms[page]


def _other_name(host: str) -> str:
    """The host under this machine's other name, `localhost` or 127.0.0.1."""
    name, _, port = host.rpartition(":")
    other = {"127.0.0.1": "localhost", "localhost": "127.0.0.1"}.get(name)
    return f"{other}:{port}" if other else host


@contextlib.contextmanager
def web_viewer(program: Path, stream: str, port: int) -> Iterator[Address]:
    """The address of Rerun's web viewer, which its own program serves on a port of this machine
    while the context lasts. Raises OSError if it does not start.
    """
    command = [str(program), "--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), stream]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as viewer:
        try:
            until, connection = (
                time.monotonic() + START_S,
                http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S),
            )
            while True:
                with contextlib.closing(connection):
                    try:
                        connection.request("HEAD", "/")
                        connection.getresponse()
                        break
                    except OSError as error:
                        if viewer.poll() is not None or time.monotonic() > until:
                            raise OSError(
                                f"the web viewer did not start on port {port}: {in_words(error, named=False)}"
                            ) from None
                time.sleep(0.1)
            yield Address("127.0.0.1", port)
        finally:
            viewer.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                viewer.wait(TIMEOUT_S)
            viewer.kill()
