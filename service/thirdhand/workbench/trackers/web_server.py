"""The web server of this machine's pages: the live view, and hands from a browser.

It answers requests from its own pages only: `Host` must name this machine, and `Origin`, where a
browser sends it, must be the same host and port. What changes something also needs the token of
the server. Connections that are silent are closed, and there are not many at once. Every answer
has the headers that keep a browser from fetching anything elsewhere, and every refusal says why.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import re
import secrets
import signal
import socket
import ssl
import subprocess
import threading
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from aiohttp import web

from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.settings.whole_file import whole
from thirdhand.workbench.trackers.address import Address

HTML = "text/html; charset=utf-8"
JSON = "application/json"
JAVASCRIPT = "text/javascript; charset=utf-8"
INLINE = (
    "img-src 'self' data: blob:; font-src 'self' data:; style-src 'unsafe-inline'; script-src "
    "'unsafe-inline'"
)
MAX_BODY_BYTES = 4096  # limit of a request
MAX_CONNECTIONS = 256  # open at once, several for each page; often 1024 files are allowed
REQUEST_WITHIN_S = 5.0  # a handshake, and then the first request, must be complete after this time
FOREIGN = "This page answers at this machine's own address only, and only to itself."
MAX_PAGE_MESSAGE_BYTES = 256  # limit of a message on a websocket
CLOSE_CODE = 4000  # a websocket is refused with this close code plus the status of HTTP
MAX_CLOSE_REASON_BYTES = 123  # RFC 6455, section 5.5


class ServerCertificate(NamedTuple):
    """A certificate and key, loaded, the name or address under which the page is opened, and all
    that the certificate names, such as `*.lab.example`.
    """

    context: ssl.SSLContext
    name: str
    names: tuple[str, ...]

    def is_for(self, host: str) -> bool:
        """True if the certificate names a host, or one level above it by a wildcard (RFC 6125)."""
        first, _, domain = host.partition(".")
        return host in self.names or bool(first and domain and f"*.{domain}" in self.names)


def server_certificate(name: str, folder: Path) -> ServerCertificate:
    """A self-signed certificate for a host name or address, made by `openssl` at the first call and
    kept in a folder, so that a browser warns only once. Raises ExplainedError, also for a kept
    certificate that does not name the host.
    """
    name = name.lower()
    if not re.fullmatch(r"[\w.:-]+", name, re.ASCII):
        raise ExplainedError(f"--https {name!r}: a name in plain letters, or an address, needed")

    file = folder / f"{name}.pem"  # certificate and key
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        if not file.exists():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with whole(file) as part:
                part.touch(mode=0o600)
                part.write_bytes(self_signed(name))
        context.load_cert_chain(file)
        names = _names_in(file)
    except FileNotFoundError:
        raise ExplainedError(
            "no program `openssl`, which makes the page's certificate: install it"
        ) from None
    except (OSError, subprocess.CalledProcessError) as error:  # an SSLError too
        words = (
            error.stderr.decode().strip()
            if isinstance(error, subprocess.CalledProcessError)
            else in_words(error)
        )
        raise ExplainedError(
            f"no certificate for {name} in {file}: {words}; delete the file for a new one"
        ) from None
    certificate = ServerCertificate(context, name, names)
    if not certificate.is_for(_same_address(name)):
        raise ExplainedError(
            f"--https {name}: the certificate in {file} is for {', '.join(names) or 'no host'}; "
            "one of these needed, with any word for *; or delete the file for a new one"
        )
    return certificate


def _names_in(file: Path) -> tuple[str, ...]:
    """The hosts and addresses that a certificate names."""
    command = ["openssl", "x509", "-in", str(file), "-noout", "-ext", "subjectAltName"]
    text = subprocess.run(command, check=True, capture_output=True).stdout.decode()
    return tuple(map(_same_address, re.findall(r"(?:DNS|IP Address):([^,\s]+)", text)))


def _same_address(name: str) -> str:
    """A name in small letters, an address in its shortest form."""
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return name.lower()


def self_signed(name: str) -> bytes:
    """A new key and its certificate for a host name or address, in PEM."""
    try:
        subject = f"IP:{ipaddress.ip_address(name)}"
    except ValueError:
        subject = f"DNS:{name}"
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 "
        f"-subj /CN=thirdhand -addext subjectAltName={subject} -keyout -"
    )
    return subprocess.run(command.split(), check=True, capture_output=True).stdout


class _Listener(socket.socket):
    """A listening socket with MAX_CONNECTIONS accepted ones at once, those in a handshake among
    them; others are closed.
    """

    def __init__(self, listen: Address) -> None:
        super().__init__(socket.AF_INET6 if ":" in listen.host else socket.AF_INET)
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.setblocking(False)
        self._accepted: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        try:
            self.bind(socket.getaddrinfo(*listen, self.family)[0][4])
            self.listen()
        except OSError:
            self.close()
            raise

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection. Raises ConnectionAbortedError if it was closed at once."""
        connection, address = super().accept()
        if sum(client.fileno() >= 0 for client in self._accepted) >= MAX_CONNECTIONS:
            connection.close()
            raise ConnectionAbortedError
        self._accepted.add(connection)
        return connection, address


class WebServer:
    """A server of some routes: by HTTPS with a certificate, else by HTTP.

    `unknown` is the answer to requests for anything else. `token` is a new one by default.
    """

    def __init__(
        self,
        routes: Iterable[web.AbstractRouteDef],
        *,
        unknown: str,
        certificate: ServerCertificate | None = None,
        token: str = "",
    ) -> None:
        self.token = token or secrets.token_urlsafe(24)
        self.scheme = "https" if certificate else "http"
        self._unknown = unknown
        self._certificate = certificate
        self._host = ""
        self.end: Callable[[], object] = lambda: None  # ends the serving, from any thread
        self._silent: set[web.RequestHandler] = set()  # new connections without a request yet
        self._application = web.Application(
            client_max_size=MAX_BODY_BYTES, middlewares=[self._guarded]
        )
        self._application.add_routes(routes)

    async def serve(self, listen: Address, listening: Callable[[Address], object]) -> None:
        """Serve until SIGTERM, SIGHUP or `end`; call `listening` with the address taken. Raises
        OSError if the address is not available.
        """
        loop = asyncio.get_running_loop()
        ended = asyncio.Event()
        self.end = lambda: loop.call_soon_threadsafe(ended.set)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, lambda *_: self.end())
        runner = web.AppRunner(
            self._application, access_log=None, handler_cancellation=True, shutdown_timeout=0.1
        )
        await runner.setup()
        assert runner.server is not None
        answering = runner.server

        def connection() -> web.RequestHandler:
            handler = answering()
            self._silent.add(handler)
            loop.call_later(REQUEST_WITHIN_S, self._close_if_silent, handler)
            return handler

        self._host = listen.host
        server = None
        tls = self._certificate and self._certificate.context
        try:
            listener = _Listener(listen)
            limit_s = REQUEST_WITHIN_S if tls else None
            server = await loop.create_server(
                connection, sock=listener, ssl=tls, ssl_handshake_timeout=limit_s
            )
            listening(Address(listen.host, listener.getsockname()[1]))
            await ended.wait()
        finally:
            if server is not None:
                server.close()
            await runner.cleanup()

    def _close_if_silent(self, connection: web.RequestHandler) -> None:
        if connection in self._silent:
            self._silent.discard(connection)
            connection.force_close()

    def has_token(self, given: str) -> bool:
        """True for the token of this run."""
        return hmac.compare_digest(given.encode(errors="surrogateescape"), self.token.encode())

    @web.middleware
    async def _guarded(
        self, request: web.Request, handler: Callable[[web.Request], Any]
    ) -> web.StreamResponse:
        self._silent.discard(request.protocol)
        if self._is_foreign(request.headers.get("Host", ""), request.headers.get("Origin")):
            return await refused(request, 403, FOREIGN)
        try:
            await request.read()
        except web.HTTPRequestEntityTooLarge:
            return await refused(
                request, 413, f"A body of at most {MAX_BODY_BYTES} bytes is accepted."
            )
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
            if name in ("localhost", self._host) or (
                self._certificate and self._certificate.is_for(name)
            ):
                return False
            return not ipaddress.ip_address(name)
        except ValueError:
            return True


def answer(
    status: int,
    text: str,
    *,
    kind: str = "text/plain; charset=utf-8",
    policy: str = "frame-ancestors 'none'",
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
