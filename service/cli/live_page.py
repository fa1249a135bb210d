"""The page of `thirdhand view live --web`: mode and reason, buttons for hold, resume and reset, and
Rerun's web viewer, all at one address.

It is a proxy for the viewer's server and the daemon's stream on this machine. A request that
changes something needs the token in the page, which no other site can read.
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
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urlsplit

import zenoh

from service.client import Client
from service.contract import channels
from service.contract.explain import ExplainedError

ORDERS = ("hold", "resume", "reset")
STREAM = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"  # the path at which viewers request the stream
PIECE = 64 * 1024
MOST_BODY = 4096  # bytes of a request
TIMEOUT_S = 10.0
START_S = 15.0
_FOREIGN = re.compile(r"<link\b[^>]*https:[^>]*>")  # links of the viewer's page to other sites
_DROPPED = {"connection", "keep-alive", "transfer-encoding", "content-length", "date", "server"}


class Address(NamedTuple):
    """Host and port of a server."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Latest:
    """The newest status of the daemon, and its age."""

    def __init__(self, session: zenoh.Session, cell: str, first: dict[str, Any]) -> None:
        self._status, self._at = first, time.monotonic()
        self._subscriber = session.declare_subscriber(channels.key(cell, "status"), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        with contextlib.suppress(ValueError):
            self._status, self._at = json.loads(sample.payload.to_bytes()), time.monotonic()

    def summary(self) -> dict[str, Any]:
        """Mode, reason, cause, remedy, age [s], and further facts in one line."""
        now = self._status
        hands = ", ".join(f"{side} hand {age:.0f} ms old" for side, age in now["hand_age_ms"].items())
        near = f"{100 * now['hand_distance_m']:.0f} cm to the nearest, " if hands else ""
        facts = (
            f"{hands or 'no hands seen'}; {near}{now['rate_hz']:.0f} Hz, {now['missed']} missed; skill {now['skill']}"
        )
        told = {name: now[name] for name in ("mode", "reason", "because", "remedy")}
        return told | {"age_s": time.monotonic() - self._at, "facts": facts}


class _Handler(http.server.BaseHTTPRequestHandler):
    """One request to the page's server."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "thirdhand", ""
    server: LivePage

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Logs nothing."""

    def do_GET(self) -> None:
        if self._is_foreign():
            return self._respond(403, "This page is for this machine's own address, not for another name.")
        path = urlsplit(self.path).path
        if path == "/":
            return self._respond(200, self.server.html(self.headers["Host"]), kind="text/html; charset=utf-8")
        if path == "/status":
            return self._respond(200, json.dumps(self.server.latest.summary()), kind="application/json")
        if path.startswith("/viewer/"):
            return self._pass_on(self.server.viewer, "GET", path.removeprefix("/viewer"), None)
        return self._respond(404, "There is nothing of this name.")

    def do_POST(self) -> None:
        size = self.headers.get("Content-Length", "0")
        body = self.rfile.read(int(size)) if size.isdecimal() and int(size) <= MOST_BODY else None
        if body is None:
            self.close_connection = True
            return self._respond(413, f"A body of at most {MOST_BODY} bytes is accepted.")
        if self._is_foreign():
            return self._respond(403, "This page is for this machine's own address, not for another name.")
        if self.path == STREAM:
            return self._pass_on(self.server.stream, "POST", self.path, body)
        name = self.path.removeprefix("/")
        if name not in ORDERS:
            return self._respond(404, "There is nothing of this name.")
        if not hmac.compare_digest(self.headers.get("X-Thirdhand-Token", ""), self.server.token):
            return self._respond(403, "The token of the page is needed: reload it.")
        try:
            reply = self.server.client.ask(name)
        except ExplainedError as error:
            return self._respond(502, f"{name} was NOT carried out: {error}")
        return self._respond(200, f"{name} in force since tick {reply['tick']}")

    def _is_foreign(self) -> bool:
        """Whether the request is from another site, or to another host's name."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name not in ("localhost", self.server.address.host) and not ipaddress.ip_address(name)
        except ValueError:
            return True

    def _respond(
        self, code: int, text: str, *, kind: str = "text/plain; charset=utf-8", within: str = "'none'"
    ) -> None:
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
        """Passes on the answer of another server of this machine, piece by piece."""
        headers = {name: value for name, value in self.headers.items() if name.lower() not in ("host", "origin")}
        connection = http.client.HTTPConnection(to.host, to.port, timeout=None if body else TIMEOUT_S)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
        except OSError as error:
            connection.close()
            return self._respond(502, f"{to} does not answer: {error}")
        with contextlib.closing(connection), contextlib.suppress(OSError, http.client.HTTPException):
            if path == "/":
                host = self.headers["Host"]
                text = _FOREIGN.sub("", answer.read().decode())
                return self._respond(
                    answer.status, text, kind="text/html; charset=utf-8", within=f"http://{_other_name(host)}"
                )
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


def _other_name(host: str) -> str:
    """The host with this machine's other name, `localhost` or 127.0.0.1."""
    name, _, port = host.rpartition(":")
    other = {"127.0.0.1": "localhost", "localhost": "127.0.0.1"}.get(name)
    return f"{other}:{port}" if other else host


class LivePage(http.server.ThreadingHTTPServer):
    """The page's server, which listens at `address`. Raises OSError where it cannot."""

    def __init__(
        self, listen: Address, *, client: Client, latest: Latest, cell: str, stream: Address, viewer: Address
    ) -> None:
        super().__init__(listen, _Handler)
        self.address = Address(listen.host, self.server_port)
        self.client, self.latest, self._cell = client, latest, cell
        self.stream, self.viewer, self.token = stream, viewer, secrets.token_urlsafe(24)
        self._template = Path(__file__).with_name("live.html").read_text(encoding="utf-8")

    def html(self, host: str) -> str:
        """The page, for a browser that reaches it by this host and port.

        The viewer is loaded under this machine's other name if it has one. For the browser that is
        another site, which runs in a process of its own, so that the buttons always respond.
        """
        viewer_host = _other_name(host)
        url = quote(f"rerun+http://{viewer_host}/proxy", safe="")
        fields = {
            "__CELL__": html.escape(self._cell),
            "__TOKEN__": self.token,
            "__VIEWER__": f"http://{viewer_host}/viewer/?url={url}&amp;hide_welcome_screen=1&amp;persist=false&amp;theme=dark",
        }
        text = self._template
        for name, value in fields.items():
            text = text.replace(name, value)
        return text


@contextlib.contextmanager
def web_viewer(program: Path, stream: str, port: int) -> Iterator[Address]:
    """The address of Rerun's web viewer, served by its own program on a port of this machine while
    the context lasts. Raises OSError where it does not start.
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
                            raise OSError(f"the web viewer did not start on port {port}: {error}") from None
                time.sleep(0.1)
            yield Address("127.0.0.1", port)
        finally:
            viewer.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                viewer.wait(TIMEOUT_S)
            viewer.kill()
