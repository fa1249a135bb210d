"""The page of `thirdhand view live --web`: mode and reason, hold, resume and reset as buttons, and
Rerun's web viewer, all behind one address.

The viewer's program and the daemon's stream are passed on from where they are on this machine. A
request that changes something needs the token in the page, which no other site can read.
"""

from __future__ import annotations

import contextlib
import hmac
import html
import http.client
import http.server
import ipaddress
import json
import re
import secrets
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urlsplit

import zenoh

from service.client import Client
from service.contract import channels
from service.contract.explain import ExplainedError

ORDERS = ("hold", "resume", "reset")
STREAM = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"  # what a viewer asks of the daemon's stream
PIECE = 64 * 1024
MOST_ASKED = 4096  # bytes of a request's body
TIMEOUT_S = 10.0
START_S = 15.0
_FOREIGN = re.compile(r"<link\b[^>]*https:[^>]*>")  # what the viewer's page would fetch from elsewhere
_DROPPED = {"connection", "keep-alive", "transfer-encoding", "content-length", "date", "server"}


class Address(NamedTuple):
    """Where something listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Latest:
    """The newest status of the daemon, and how old it is."""

    def __init__(self, session: zenoh.Session, cell: str, first: dict[str, Any]) -> None:
        self._status, self._at = first, time.monotonic()
        self._subscriber = session.declare_subscriber(channels.key(cell, "status"), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        with contextlib.suppress(ValueError):
            self._status, self._at = json.loads(sample.payload.to_bytes()), time.monotonic()

    def told(self) -> dict[str, Any]:
        """Mode, reason, its cause and what to do about it, age [s], and the rest in one line."""
        now = self._status
        hands = ", ".join(f"{side} hand {age:.0f} ms old" for side, age in now["hand_age_ms"].items())
        near = f"{100 * now['hand_distance_m']:.0f} cm to the nearest, " if hands else ""
        facts = (
            f"{hands or 'no hands seen'}; {near}{now['rate_hz']:.0f} Hz, {now['missed']} missed; skill {now['skill']}"
        )
        return {
            "mode": now["mode"],
            "reason": now["reason"],
            "because": now["because"],
            "remedy": now["remedy"],
            "age_s": time.monotonic() - self._at,
            "facts": facts,
        }


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True


class _Handler(http.server.BaseHTTPRequestHandler):
    """One request to the page's server."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "thirdhand", ""

    def __init__(self, page: LivePage, *args: Any) -> None:
        self._page = page
        super().__init__(*args)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Says nothing of each request."""

    def do_GET(self) -> None:
        if self._is_foreign():
            return self._say(403, "This page is for this machine's own address, not for another name.")
        path = urlsplit(self.path).path
        if path == "/":
            return self._say(200, self._page.html(self.headers["Host"]), kind="text/html; charset=utf-8")
        if path == "/status":
            return self._say(200, json.dumps(self._page.latest.told()), kind="application/json")
        if path.startswith("/viewer/"):
            return self._pass_on(self._page.viewer, "GET", path.removeprefix("/viewer"), None)
        return self._say(404, "There is nothing of this name.")

    def do_POST(self) -> None:
        size = self.headers.get("Content-Length", "0")
        body = self.rfile.read(int(size)) if size.isdecimal() and int(size) <= MOST_ASKED else None
        if body is None:
            self.close_connection = True
            return self._say(413, f"A body of at most {MOST_ASKED} bytes is accepted.")
        if self._is_foreign():
            return self._say(403, "This page is for this machine's own address, not for another name.")
        if self.path == STREAM:
            return self._pass_on(self._page.stream, "POST", self.path, body)
        name = self.path.removeprefix("/")
        if name not in ORDERS:
            return self._say(404, "There is nothing of this name.")
        if not hmac.compare_digest(self.headers.get("X-Thirdhand-Token", ""), self._page.token):
            return self._say(403, "The token of the page is needed: load it anew.")
        try:
            return self._say(200, self._page.order(name))
        except ExplainedError as error:
            return self._say(502, f"{name} was NOT carried out: {error}")

    def _is_foreign(self) -> bool:
        """Whether another site asks, or by a name that somebody may have made point here."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name not in ("localhost", self._page.address.host) and not ipaddress.ip_address(name)
        except ValueError:
            return True

    def _say(self, code: int, text: str, *, kind: str = "text/plain; charset=utf-8", within: str = "'none'") -> None:
        data = text.encode()
        self.send_response(code)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(data))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Content-Security-Policy", f"frame-ancestors {within}"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def _pass_on(self, to: Address, method: str, path: str, body: bytes | None) -> None:
        """The answer of another server of this machine, piece by piece as it comes."""
        asked = {name: value for name, value in self.headers.items() if name.lower() not in ("host", "origin")}
        connection = http.client.HTTPConnection(to.host, to.port, timeout=None if body else TIMEOUT_S)
        try:
            connection.request(method, path, body, asked)
            answer = connection.getresponse()
        except OSError as error:
            connection.close()
            return self._say(502, f"{to} does not answer: {error}")
        with contextlib.closing(connection), contextlib.suppress(OSError, http.client.HTTPException):
            if path == "/":
                host = self.headers["Host"]
                text = _FOREIGN.sub("", answer.read().decode())
                return self._say(answer.status, text, kind="text/html; charset=utf-8", within=f"http://{_aside(host)}")
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in _DROPPED:
                    self.send_header(name, value)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            while piece := answer.read1(PIECE):
                self.wfile.write(f"{len(piece):x}\r\n".encode() + piece + b"\r\n")
            self.wfile.write(b"0\r\n\r\n")
        self.close_connection = True
        return None


def _aside(host: str) -> str:
    """The other name of this machine, with the port."""
    name, _, port = host.rpartition(":")
    other = {"127.0.0.1": "localhost", "localhost": "127.0.0.1"}.get(name)
    return f"{other}:{port}" if other else host


class LivePage:
    """The page's server; `address` says where it listens. Raises OSError where that cannot be."""

    def __init__(
        self, listen: Address, *, client: Client, latest: Latest, cell: str, stream: Address, viewer: Address
    ) -> None:
        self._client, self.latest, self._cell = client, latest, cell
        self.stream, self.viewer, self.token = stream, viewer, secrets.token_urlsafe(24)
        self._template = Path(__file__).with_name("live.html").read_text(encoding="utf-8")
        self.address = listen
        self._server = _Server(listen, partial(_Handler, self))
        self.address = Address(listen.host, self._server.server_port)

    def html(self, host: str) -> str:
        """The page, for a browser that reaches it by this host and port.

        The viewer is fetched by this machine's other name where it has one: from another site, so
        that browsers run it in a process of its own, and the buttons answer however busy it is.
        """
        aside = _aside(host)
        url = quote(f"rerun+http://{aside}/proxy", safe="")
        fields = {
            "__CELL__": html.escape(self._cell),
            "__TOKEN__": self.token,
            "__VIEWER__": f"http://{aside}/viewer/?url={url}&amp;hide_welcome_screen=1&amp;persist=false&amp;theme=dark",
        }
        text = self._template
        for name, value in fields.items():
            text = text.replace(name, value)
        return text

    def order(self, name: str) -> str:
        """Has the daemon hold, resume or reset; what came of it. Raises ExplainedError."""
        reply = self._client.ask(name)
        return f"{name} in force since tick {reply['tick']}"

    def serve(self) -> None:
        """Answers until `close`."""
        self._server.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Ends the server."""
        self._server.shutdown()
        self._server.server_close()


@contextlib.contextmanager
def web_viewer(program: Path, stream: str, port: int) -> Iterator[Address]:
    """Rerun's web viewer, served by its own program on a port of this machine, while the context
    lasts. Raises OSError where it does not start.
    """
    command = [str(program), "--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), stream]
    viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + START_S
        while True:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
            try:
                connection.request("HEAD", "/")
                connection.getresponse()
                break
            except OSError as error:
                if viewer.poll() is not None or time.monotonic() > until:
                    raise OSError(f"the web viewer did not start on port {port}: {error}") from None
                time.sleep(0.1)
            finally:
                connection.close()
        yield Address("127.0.0.1", port)
    finally:
        viewer.terminate()
        try:
            viewer.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            viewer.kill()
            viewer.wait()
