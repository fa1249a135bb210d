"""The web server of this machine's pages: the live view, and hands from a browser.

It answers requests from its own pages only: `Host` must name this machine, and `Origin`, where a
browser sends it, must be the same host and port. What changes something also needs the token of
the server. Bodies are short; connections without a request, and those on which nothing is read, are
closed, and there are not many at once. Every answer has the headers that keep a browser from
fetching anything elsewhere, and every refusal says why.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import re
import secrets
import signal
import ssl
import threading
from collections.abc import AsyncIterator, Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError
from cryptography import x509

from service.client import CERTIFICATE, KEY, UnreachableError
from service.client.session import check_dates
from service.contract.explain import ExplainedError, in_words

HTML = "text/html; charset=utf-8"
JSON = "application/json"
JAVASCRIPT = "text/javascript; charset=utf-8"
INLINE = "img-src 'self' data: blob:; font-src 'self' data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
MAX_BODY_BYTES = 4096  # of a request
FROZEN_S = 30.0  # a browser that sends no request, or reads no answer, for this long is disconnected
MAX_CONNECTIONS = 256  # at once: some for each page; a process may often open 1024 files
UNREADABLE = "This is no request by HTTP"
FOREIGN = "This page answers at this machine's own address only, and only to itself."
MAX_PAGE_MESSAGE_BYTES = 256  # of a websocket
CLOSE_CODE = 4000  # a websocket is refused with this close code plus the status of HTTP
MAX_CLOSE_REASON_BYTES = 123  # RFC 6455, section 5.5


class Address(NamedTuple):
    """Host and port of a server."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class ServerCertificate(NamedTuple):
    """A certificate and key, loaded, and the names and addresses that the certificate is for."""

    context: ssl.SSLContext
    names: frozenset[str]


def server_certificate(folder: Path) -> ServerCertificate:
    """The certificate and key in a folder. Raises ExplainedError, also for one that has expired."""
    certificate, key = folder / CERTIFICATE, folder / KEY

    def locked() -> str:
        raise ExplainedError(f"{key} has a passphrase: a key without one needed")

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
        key.read_bytes()  # names the file if it cannot be read, which OpenSSL does not
        context.load_cert_chain(certificate, key, locked)
    except (OSError, ValueError) as error:  # an SSLError too
        mismatch = isinstance(error, ssl.SSLError) and "the key does not belong to the certificate"
        raise ExplainedError(
            f"cannot serve with {certificate} and {key}: {mismatch or in_words(error)}; a certificate and its key in "
            "PEM needed, as in the folder `headset` that `thirdhand certificates` makes"
        ) from None
    try:
        check_dates(certificate)
    except UnreachableError as error:
        raise ExplainedError(f"cannot serve with it: {error}") from None
    try:
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise ExplainedError(f"{certificate} names no host: a certificate for this machine's address needed") from None
    hosts = [*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))]
    return ServerCertificate(context, frozenset(host.lower() for host in hosts))


class PageConnection(web.RequestHandler):
    """A connection of a browser. It is closed if what was written to it is not read in time. A
    request that cannot be parsed is answered, and is no error of this program.
    """

    transport: asyncio.Transport | None
    _unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Note each byte that waits to be read, not only many of them."""
        super().connection_made(transport)
        assert isinstance(transport, asyncio.Transport)
        self._written_to = transport  # aiohttp forgets its own one before that has been closed
        transport.set_write_buffer_limits(high=1, low=0)  # by TLS, a limit of 0 would pause for ever

    def pause_writing(self) -> None:
        """Something waits to be read."""
        super().pause_writing()
        self._unread = asyncio.get_running_loop().call_later(FROZEN_S, self._written_to.abort)

    def resume_writing(self) -> None:
        """All has been read."""
        super().resume_writing()
        self._end_timer()

    def connection_lost(self, exc: BaseException | None) -> None:
        """The connection has ended."""
        self._end_timer()
        super().connection_lost(exc)

    def _end_timer(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def log_exception(self, *args: Any, exc_info: Any = None, **more: Any) -> None:
        """Log an error of this program, but none of a request."""
        if not isinstance(exc_info, HttpProcessingError | web.RequestPayloadError):
            super().log_exception(*args, exc_info=exc_info, **more)

    def handle_error(
        self, request: web.BaseRequest, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.StreamResponse:
        """The answer to a request that cannot be parsed, or in which this program failed."""
        found = super().handle_error(request, status, exc, message)
        if not isinstance(exc, HttpProcessingError):
            return found
        response = answer(status, f"{UNREADABLE}: {(message or type(exc).__name__).splitlines()[0].rstrip(':')}")
        response.force_close()
        return response


class WebServer:
    """A server of some routes: by HTTPS with a certificate, else by HTTP.

    `unknown` is the answer to requests for anything else. `around` are contexts, as aiohttp's
    `cleanup_ctx` takes them, that last as long as the server. `token` is a new one by default.
    """

    def __init__(
        self,
        routes: Iterable[web.AbstractRouteDef],
        *,
        unknown: str,
        certificate: ServerCertificate | None = None,
        around: Iterable[Callable[[web.Application], AsyncIterator[None]]] = (),
        token: str = "",
    ) -> None:
        self.token = token or secrets.token_urlsafe(24)
        self.scheme = "https" if certificate else "http"
        self._unknown, self._certificate, self._host = unknown, certificate, ""
        self.end: Callable[[], object] = lambda: None  # ends the serving, from any thread
        self._idle: dict[web.RequestHandler, None] = {}  # connections without a request yet, the oldest first
        self._application = web.Application(client_max_size=MAX_BODY_BYTES, middlewares=[self._guarded])
        self._application.add_routes(routes)
        self._application.cleanup_ctx.extend(around)

    async def serve(self, listen: Address, listening: Callable[[Address], object]) -> None:
        """Serve until SIGTERM, SIGHUP or `end`; call `listening` with the address taken. Raises
        OSError if the address is not available.
        """
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        self.end = lambda: loop.call_soon_threadsafe(ended.set)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, lambda *_: self.end())
        runner = web.AppRunner(self._application, handler_cancellation=True, shutdown_timeout=0.1)
        await runner.setup()

        def connection() -> PageConnection:
            assert runner.server is not None
            return self._connection(runner.server)

        self._host, server, tls = listen.host, None, self._certificate
        try:
            server = await loop.create_server(
                connection,
                *listen,
                ssl=tls.context if tls else None,
                ssl_handshake_timeout=FROZEN_S if tls else None,
            )
            listening(Address(listen.host, server.sockets[0].getsockname()[1]))
            await ended.wait()
        finally:
            if server is not None:
                server.close()
            await runner.cleanup()

    def has_token(self, given: str) -> bool:
        """True for the token of this run."""
        return hmac.compare_digest(given.encode(errors="surrogateescape"), self.token.encode())

    def _connection(self, server: web.Server) -> PageConnection:
        """A new connection; it is closed if no request arrives in time. If there are too many, the
        one that has sent no request for longest is closed.
        """
        loop = asyncio.get_running_loop()
        unlogged: Any = None  # aiohttp's annotation lacks it
        new = PageConnection(server, loop=loop, access_log=unlogged, keepalive_timeout=FROZEN_S)
        self._idle[new] = None
        if len(server.connections) >= MAX_CONNECTIONS:
            self._close_idle(next(iter(self._idle)))
        loop.call_later(FROZEN_S, self._close_idle, new)
        return new

    def _close_idle(self, connection: web.RequestHandler) -> None:
        if connection in self._idle:
            del self._idle[connection]
            connection.force_close()

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Callable[[web.Request], Any]) -> web.StreamResponse:
        self._idle.pop(request.protocol, None)
        if self._is_foreign(request.headers.get("Host", ""), request.headers.get("Origin")):
            return await refused(request, 403, FOREIGN)
        try:
            async with asyncio.timeout(FROZEN_S):
                await request.read()
        except TimeoutError:
            return await refused(request, 408, f"The request was not complete within {FROZEN_S:g} s.")
        except web.HTTPRequestEntityTooLarge:
            return await refused(request, 413, f"A body of at most {MAX_BODY_BYTES} bytes is accepted.")
        except web.RequestPayloadError:
            return await refused(request, 400, f"{UNREADABLE}: its body cannot be decoded.")
        try:
            response: web.StreamResponse = await handler(request)
        except web.HTTPException as error:
            return await refused(request, error.status, self._unknown)
        return response

    def _is_foreign(self, host: str, origin: str | None) -> bool:
        """True for a request from another site, or to the name of another host."""
        try:
            if origin is not None and urlsplit(origin).netloc != host:
                return True
            name = (urlsplit(f"//{host}").hostname or "").lower()
            if not re.fullmatch(r"[\w.:\[\]-]+", host):
                return True
            if name in ("localhost", self._host) or (self._certificate and name in self._certificate.names):
                return False
            return not ipaddress.ip_address(name)
        except ValueError:
            return True


def answer(
    status: int, text: str, *, kind: str = "text/plain; charset=utf-8", policy: str = "frame-ancestors 'none'"
) -> web.Response:
    """An answer with the headers of all answers; `policy` is added to `default-src 'none'`."""
    headers = {
        "Content-Type": kind,
        "Server": "thirdhand",
        "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "same-origin",
        "Content-Security-Policy": f"default-src 'none'; {policy}",
    }
    return web.Response(status=status, body=text.encode(errors="replace"), headers=headers)


def page_socket() -> web.WebSocketResponse:
    """A websocket of a page. Messages of more bytes than a page sends close it."""
    return web.WebSocketResponse(max_msg_size=MAX_PAGE_MESSAGE_BYTES, compress=False, timeout=1.0)


async def refused(request: web.Request, status: int, reason: str) -> web.StreamResponse:
    """The refusal of a request. A websocket is opened and closed with CLOSE_CODE + `status`: a page
    cannot read the answer to a handshake that fails.
    """
    socket = page_socket()
    if not socket.can_prepare(request).ok:
        response = answer(status, reason)
        response.force_close()
        return response
    await socket.prepare(request)
    await close(socket, status, reason)
    return socket


async def close(socket: web.WebSocketResponse, status: int, reason: str) -> None:
    """Close a websocket with CLOSE_CODE + `status` and a reason, which may be cut at its end."""
    message = reason.encode()[:MAX_CLOSE_REASON_BYTES].decode(errors="ignore").encode()
    await socket.close(code=CLOSE_CODE + status, message=message)


def filled(path: Path, /, **fields: str) -> str:
    """The text of a page's file with `__NAME__` replaced by the field `name`."""
    text = path.read_text(encoding="utf-8")
    for name, value in fields.items():
        text = text.replace(f"__{name.upper()}__", value)
    return text
